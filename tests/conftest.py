"""Every test runs with the shapes in our signatures checked, and with no silent broadcasting between ranks."""

import importlib.metadata
import os
import shutil
import sys
import tempfile

# Most of a test's time is compilation. So little is optimised, and what one test has compiled the next ones read, and
# the programs that they start; a folder for each of pytest's processes, as JAX does not write its files in one piece.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Without XLA's fusion emitters programs compile in half the time, and run more slowly. An unknown flag ends a process.
if importlib.metadata.version("jaxlib").startswith(("0.10.", "0.11.")):
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")
# BELIEFRL_TEST_CACHE names a folder that stays, for tests that run again and again in one process at a time.
os.environ["JAX_COMPILATION_CACHE_DIR"] = os.environ.get("BELIEFRL_TEST_CACHE") or tempfile.mkdtemp(
    prefix="beliefrl-compiled-"
)
os.environ["BELIEFRL_CACHE"] = "off"  # nothing is written to the user's cache folder
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"

import jax
import jaxtyping
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_default_matmul_precision", "highest")  # a GPU would round the factors of products otherwise
jaxtyping.install_import_hook("beliefrl", "beartype.beartype")  # before the first import of beliefrl


@pytest.fixture(autouse=True)
def path(monkeypatch):
    """The command line adds "" to sys.path. A test must not depend on one before it that called the command line."""
    monkeypatch.setattr(sys, "path", sys.path.copy())


@pytest.fixture
def unchecked(monkeypatch):
    """The types in our signatures are not checked, as in a user's program: a wrong one must be a UserError there."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def pytest_unconfigure():
    if not os.environ.get("BELIEFRL_TEST_CACHE"):
        shutil.rmtree(os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
