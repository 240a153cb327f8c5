"""Environments by Gymnasium id, including the robots of the paper, and the indices of their velocities.

The robots are those of pybullet_envs_gymnasium, the successor of the paper's Roboschool (Appendix B, Table 4). The
observations are the same: 8 numbers of the body, then angle and speed of every joint, then the contacts of the feet.
MuJoCo's and the classic environments are Gymnasium's own.
"""

import contextlib
import ctypes
import dataclasses
import difflib
import importlib
import os
import pathlib
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium
from gymnasium import error

from beliefrl.catalogue import BULLET, KNOWN, PREFIX
from beliefrl.errors import UserError, one_line, said
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.settings import settings_kept
from beliefrl.types import check_whole


def ids() -> list[str]:
    """The registered ids of Gymnasium, except for this library's tasks, which have their own names."""
    return [id for id in gymnasium.registry if not id.startswith("BeliefRL/")]


def similar(id: str) -> str | None:
    """The task with the most similar Gymnasium id, `Id` or `package:Id`; the newest of several versions."""
    package, colon, name = id.rpartition(":")
    near = difflib.get_close_matches(name, ids(), n=1, cutoff=0.8)
    return f"{PREFIX}{package}{colon}{near[0]}" if near else None


def make(id: str, arguments: dict[str, Any], name: str | None = None) -> GymnasiumTask:
    """The task with a Gymnasium id, `Id` or `package:Id`; the package is imported, to register the environment.

    `arguments` are those of gymnasium.make: max_episode_steps, and the environment's own. One more, `measures`, names
    the entries of its info that are recorded (`GymnasiumTask.measures`), one or several.

    Raises:
        UserError: there is no such environment, a package is missing, or an argument is impossible.
    """
    name = name or PREFIX + id
    package, _, _ = id.rpartition(":")
    if package:
        _import(package, id)

    try:
        gymnasium.spec(id.rpartition(":")[2])
    except error.Error as found:
        near = similar(id)
        hint = f"did you mean {near}?" if near else "an environment of another package is named gym:PACKAGE:ID."
        raise UserError(f"Gymnasium has no environment {id!r} ({_first_sentence(found)}): {hint}") from None
    check_whole("max_episode_steps", arguments.get("max_episode_steps"), 1, optional=True)
    own = dict(arguments)
    measures = own.pop("measures", ())
    measures = (measures,) if isinstance(measures, str) else measures
    measures = tuple(measures) if isinstance(measures, list) else measures
    return GymnasiumTask(_Registered(id), name, own, measures=measures)


def _import(package: str, id: str) -> None:
    try:
        with settings_kept(), _quiet(package):
            importlib.import_module(package)
    except ModuleNotFoundError as found:
        raise UserError(_missing(id, found)) from None
    except (Exception, SystemExit) as found:  # a module may raise anything
        raise UserError(f"The module {package} cannot be imported: {said(found)}.") from None


@dataclasses.dataclass(frozen=True)
class _Registered:
    """Makes an environment from its id. Unlike a closure, it can be sent to another process."""

    id: str

    def __call__(self, **arguments: Any) -> gymnasium.Env[Any, Any]:
        package, _, name = self.id.rpartition(":")
        try:
            with _quiet(package):
                if package:
                    importlib.import_module(package)  # a new process has not imported it yet
                environment = gymnasium.make(name, disable_env_checker=True, **arguments)
                if package == BULLET:
                    environment.reset()  # PyBullet starts only now, and prints a message
        except (ImportError, error.DependencyNotInstalled) as found:
            raise UserError(_missing(self.id, found)) from None
        return environment


def _missing(id: str, found: Exception) -> str:
    known = KNOWN.get(id)
    if known and known.extra:
        return f"{PREFIX}{id} needs packages that are not installed: pip install 'beliefrl[{known.extra}]'."
    lacks = _first_sentence(found)
    return f"{PREFIX}{id} needs something that is not installed ({lacks}): install it with pip, or go to its folder."


def _first_sentence(found: Exception) -> str:
    return one_line(str(found)).split(". ")[0].rstrip(".")


@contextlib.contextmanager
def _quiet(package: str) -> Iterator[None]:
    """Suppress all output of PyBullet, which prints from C when it is imported and when an environment starts."""
    if package != BULLET:  # it may ask something
        yield
        return
    streams = (1, 2)
    sys.stdout.flush()
    kept = [os.dup(stream) for stream in streams]
    try:
        with pathlib.Path(os.devnull).open("wb") as devnull:
            for stream in streams:
                os.dup2(devnull.fileno(), stream)
        yield
    finally:
        sys.stdout.flush()
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # output that C has buffered
        for stream, original in zip(streams, kept, strict=True):
            os.dup2(original, stream)
            os.close(original)
