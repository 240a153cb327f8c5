"""The JSON in a run's folder: logs, read line by line, checks of the content, and the provenance in config.json.

A damaged file must cause a UserError and no traceback. So the keys and types that readers need are checked here. The
ranges of options are checked by `Options`, and those of hyperparameters by the agents.
"""

import contextlib
import json
import pathlib
import platform
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from typing import Any

import jax
import numpy as np

from beliefrl.errors import UserError, cause
from beliefrl.types import LARGEST

PACKAGES = ("beliefrl", "jax", "jaxlib", "equinox", "optax", "numpy")
SIMULATORS = ("gymnasium", "mujoco", "pybullet")  # recorded where they are used; returns depend on their versions
Row = dict[str, Any]


def finite_mean(values: Any) -> float:
    """The mean of the finite values; NaN without any. A measure may be NaN in an episode."""
    numbers = np.asarray(values, float)
    return float(numbers[np.isfinite(numbers)].mean()) if np.isfinite(numbers).any() else float("nan")


def finite_or_none(value: Any) -> float | None:
    """The value; None if it is not finite, since JSON has no such numbers."""
    return float(value) if np.isfinite(value) else None


def parsed(path: pathlib.Path) -> Any:
    """The content of a JSON file; None if it cannot be read."""
    try:
        return _json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def _json(text: str) -> Any:
    """The value of a JSON text; None if the text is not JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def is_complete(config: Any) -> bool:
    """Whether a config.json contains everything that readers need. The values of its options are not checked."""
    kinds = {"agent": str, "hyperparameters": dict, "task": str, "constants": dict, "options": dict}
    if not isinstance(config, dict) or not all(isinstance(config.get(key), kind) for key, kind in kinds.items()):
        return False
    if not ({"seed", "seeds"} <= config["options"].keys() and isinstance(config.get("observe"), list | None)):
        return False
    resumed = config.get("resumed", [])
    if not all(isinstance(config.get(name, {}), dict) for name in ("faults", "initial")):
        return False
    return isinstance(resumed, list) and all(map(_is_session, [config, *resumed]))


def steps_per_action(config: Row) -> int:
    """The action repeat in config.json, which is one of the task's constants if it is not 1."""
    return config["constants"].get("steps_per_action", 1)


def sessions(config: Row) -> list[Row]:
    """The records of a training's sessions (`provenance`), the first one with the rest of the config."""
    return [config, *config.get("resumed", ())]


def _is_session(session: Any) -> bool:
    """Whether the value can be a record of `provenance`."""
    if not isinstance(session, dict):
        return False
    return isinstance(session.get("versions", {}), dict) and isinstance(session.get("command", []), list)


def lines(log: pathlib.Path) -> Iterator[tuple[int, Row | None]]:
    """Every line of a log with its number, or None if the line is damaged. Empty if there is no log.

    An incomplete last line is left out: a training is writing it, or was killed while it wrote it.

    Raises:
        UserError: the log cannot be read.
    """
    if not log.exists():
        return
    try:
        with log.open(encoding="utf-8", errors="replace", newline="\n") as file:
            for number, line in enumerate(file, 1):
                if line.endswith("\n"):
                    yield number, _row(line)
    except OSError as error:
        raise UserError(f"{log} cannot be read ({cause(error)}): restore it from a copy.") from None


def last_rows(log: pathlib.Path) -> list[Row]:
    """The entries in the last 32 KiB of a log; damaged ones are left out.

    Raises:
        UserError: the log cannot be read.
    """
    if not log.exists():
        return []
    try:
        with log.open("rb") as file:
            start = max(0, log.stat().st_size - 32_768)
            file.seek(start)
            parts = file.read().decode(errors="replace").split("\n")
    except OSError as error:
        raise UserError(f"{log} cannot be read ({cause(error)}): restore it from a copy.") from None
    rows = map(_row, parts[1:-1] if start else parts[:-1])
    return [row for row in rows if row is not None]


def damage(log: pathlib.Path, shown: pathlib.Path) -> str | None:
    """A sentence about the damaged lines of a log, which it calls `shown`; None if there are none.

    Raises:
        UserError: the log cannot be read.
    """
    damaged = [number for number, row in lines(log) if row is None]
    if not damaged:
        return None
    if len(damaged) == 1:
        return f"Line {damaged[0]} of {shown} is damaged and left out."
    return f"{len(damaged)} lines of {shown} are damaged and left out, the first is line {damaged[0]}."


def _row(line: str) -> Row | None:
    """The entry in a line of a log; None if the line is damaged."""
    row = _json(line)
    if not isinstance(row, dict) or not isinstance(row.get("kind"), str) or not _is_step(row.get("step")):
        return None
    if row["kind"] == "evaluation" and not (isinstance(row.get("sampled"), list) and isinstance(row.get("mode"), list)):
        return None
    return row if all(map(_is_value, row.values())) else None


def _is_step(value: Any) -> bool:
    return isinstance(value, int) and 0 <= value <= LARGEST


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and abs(value) <= LARGEST)


def _are_numbers(values: Any) -> bool:
    return isinstance(values, list) and len(values) > 0 and all(map(_is_number, values))


def _is_value(value: Any) -> bool:
    """Whether the value is a text, a number, or a list of numbers."""
    return isinstance(value, str) or _is_number(value) or _are_numbers(value)


def best_evaluations(text: str, seeds: int) -> list[dict[str, Any] | None] | None:
    """The best evaluations of `seeds` seeds (`best.evaluations`) in a JSON text; None if it has anything else."""
    found = _json(text)
    if not isinstance(found, list) or len(found) != seeds or not all(each is None or _is_best(each) for each in found):
        return None
    return found


def _is_best(value: Any) -> bool:
    return isinstance(value, dict) and _is_step(value.get("step")) and _is_number(value.get("return"))


def is_summary(results: Any, seeds: int) -> bool:
    """Whether `results` is empty, or the summary of an evaluation (`summary.summary`) of `seeds` seeds."""
    if results == {}:
        return True
    if not isinstance(results, dict) or not _is_step(results.get("step")):
        return False
    if not all(_is_mode(results.get(mode), seeds) for mode in ("sampled", "mode")):
        return False
    return (results["sampled"]["success"] is None) == (results["mode"]["success"] is None)


def _is_mode(mode: Any, seeds: int) -> bool:
    """Whether `mode` is the part of a summary for one kind of actions."""
    if not isinstance(mode, dict) or not {"mean", "sem", "seeds", "success", "seeds_success"} <= mode.keys():
        return False
    returns = mode["seeds"]
    if not isinstance(returns, list) or len(returns) != seeds or not _is_number(mode["mean"]):
        return False
    for name in (key.removeprefix("seeds_") for key in mode if key.startswith("seeds_")):
        of_seeds, mean = mode[f"seeds_{name}"], mode.get(name)
        if of_seeds is None and mean is None:
            continue
        if not (isinstance(of_seeds, list) and _are_known(of_seeds) and len(of_seeds) == seeds):
            return False
        if not (_is_number(mean) or (mean is None and not any(map(_is_number, of_seeds)))):  # in no episode a number
            return False
    return _are_known([mode["sem"], *returns])


def _are_known(values: Any) -> bool:
    """Whether this is a list of numbers, or None for what a seed does not have."""
    return isinstance(values, list) and all(value is None or _is_number(value) for value in values)


def provenance() -> dict[str, Any]:
    """The record of this process in a run's config."""
    versions = {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES}
    for name in (name for name in SIMULATORS if name in sys.modules):
        with contextlib.suppress(metadata.PackageNotFoundError):  # another module may have this name
            versions[name] = metadata.version(name)
    return {
        "versions": versions,
        "device": str(jax.devices()[0].device_kind),
        "git_commit": _git_commit(),
        "command": [pathlib.Path(sys.argv[0]).name, *sys.argv[1:]],
        "started": now(),
    }


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _git_commit() -> str | None:
    """The commit of the running code, with a + if there are uncommitted changes; None outside its git checkout.

    Inside of another project's checkout git finds that project, which does not track this package.
    """
    file = pathlib.Path(__file__)
    ask = partial(subprocess.run, cwd=file.parent, capture_output=True, text=True, timeout=10)
    try:
        if ask(["git", "ls-files", "--error-unmatch", file.name]).returncode:
            return None
        found = ask(["git", "describe", "--always", "--abbrev=40", "--dirty=+", "--match="])
    except (OSError, subprocess.TimeoutExpired):
        return None
    return found.stdout.strip() or None
