"""Every test runs with the shapes in our signatures checked, and with no silent broadcasting between ranks."""

import os

os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # most of a test's time is compilation

import jax
import jaxtyping

jax.config.update("jax_numpy_rank_promotion", "raise")
jaxtyping.install_import_hook("beliefrl", "beartype.beartype")  # before the first import of beliefrl
