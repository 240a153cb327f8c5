"""The content of a report, as plain values for JSON. Numbers that are not finite become None."""

import json
import os
import pathlib
import shlex
from collections.abc import Sequence
from typing import Any
from urllib.parse import quote

import numpy as np

from beliefrl import agents
from beliefrl.analysis.figures import standard_error
from beliefrl.analysis.groups import Curve, Group, groups, has_begun, is_finished, last_step, shortened_by
from beliefrl.analysis.labels import as_text, task_label
from beliefrl.analysis.panels import colours, dashes
from beliefrl.analysis.results import changed
from beliefrl.analysis.tables import wall_clock
from beliefrl.runs.records import sessions
from beliefrl.runs.run import Run
from beliefrl.training.summary import MODES

MEDIA = (".mp4", ".webm", ".gif")
PICTURE = "curve.png"
INTERVAL = 0.95


def page_data(runs: Sequence[Run], page_folder: pathlib.Path, unfinished: bool = False) -> dict[str, Any]:
    """Everything that the page shows about `runs`; paths of files are relative to the folder `page_folder`.

    Curves and final returns include finished runs only. With `unfinished` they also include runs in which each seed has
    an evaluation or has diverged; the curve of a group then ends at the last step that all its seeds have reached.
    """
    counted = [run for run in runs if is_finished(run) or (unfinished and has_begun(run))]
    grouped = groups(counted, agents.defaults(), agents.before())
    lines = [group for group in grouped if not group.why_no_curve]
    group_of = {(run.folder, seed): index for index, group in enumerate(lines) for run, seed in group.seeds}
    placed = {(run.folder, seed) for group in grouped for run, seed in group.seeds}
    elsewhere = {run.folder: [seed for seed in run.seeds if (run.folder, seed) not in placed] for run in counted}
    palette = colours([group.label for group in lines])
    dash = dashes(list(palette))
    return {
        "tasks": list(dict.fromkeys(group.task for group in lines)),
        "labels": [{"name": label, "colour": colour, "dash": dash[label]} for label, colour in palette.items()],
        "groups": [_group(group) for group in lines],
        "without_curve": [
            f"{each.label} on {each.task} has no curve: {why}" for each in grouped if (why := each.why_no_curve)
        ]
        + [why for each in lines if (why := shortened_by(each))],
        "runs": [
            _run(run, page_folder, [group_of.get((run.folder, seed)) for seed in run.seeds])
            | {"elsewhere": elsewhere.get(run.folder, [])}
            for run in runs
        ],
    }


def _group(group: Group) -> dict[str, Any]:
    suffixes = ("", "_success") if "success" in group.measures else ("",)
    names = [mode + suffix for suffix in suffixes for mode in MODES]
    curves = {name: group.curve(name) for name in names}
    diverged = {seed: row["step"] for run, seed in group.seeds for row in run.rows(seed, "diverged")}
    return {
        "task": group.task,
        "label": group.label,
        "axis": group.axis,
        "seeds": [seed for _, seed in group.seeds],
        "diverged": diverged,
        "unfinished": not all(map(is_finished, group.runs)),
        "steps": int(group.curve().steps[-1]),
        "curves": {name: _curve(curve) for name, curve in curves.items()},
        "final": {name: statistics(group.final(name)) for name, curve in curves.items() if curve.steps.size},
    }


def _curve(curve: Curve) -> dict[str, Any]:
    """The steps of a curve, the values of each seed, and the mean, S.E.M. and number of seeds at each step."""
    columns = [statistics(column) for column in curve.seeds.T]
    return {
        "steps": curve.steps.tolist(),
        "seeds": [[number(value) for value in seed] for seed in curve.seeds],
        **{name: [column[name] for column in columns] for name in ("mean", "sem", "count")},
    }


def statistics(seeds: np.ndarray) -> dict[str, Any]:
    """Count, mean, S.E.M. and Student's 95 % interval of the mean, over the finite values of `seeds` (seed,).

    With one finite value, S.E.M. and interval are None; without any, the mean is None as well.
    """
    finite = seeds[np.isfinite(seeds)]
    if finite.size < 2:
        return {"count": finite.size, "mean": number(finite[0]) if finite.size else None, "sem": None, "interval": None}
    from scipy.special import stdtrit

    mean, error = float(finite.mean()), float(standard_error(finite))
    half = float(stdtrit(finite.size - 1, (1 + INTERVAL) / 2)) * error
    return {
        "count": finite.size,
        "mean": number(mean),
        "sem": number(error),
        "interval": [number(mean - half), number(mean + half)],
    }


def number(value: float) -> float | None:
    """The value with seven significant digits; None if it is not finite, since JSON has no such numbers."""
    return float(f"{value:.7g}") if np.isfinite(value) else None


def _run(run: Run, page_folder: pathlib.Path, groups_of: Sequence[int | None]) -> dict[str, Any]:
    config = run.config
    steps = {seed: last_step(run, seed) for seed in run.seeds}
    return {
        "folder": run.shown,
        "agent": config["agent"],
        "task": task_label(run),
        "group": next((index for index in groups_of if index is not None), None),
        "finished": is_finished(run),
        "seeds": run.seeds,
        "steps": max(steps.values(), default=0),
        "of": run.options.steps,
        "diverged": [f"seed {seed}: {row.get('why')}" for seed in run.seeds for row in run.rows(seed, "diverged")],
        "seconds": wall_clock(run),
        "settings": settings(config),
        "sessions": [_session(session) for session in sessions(config)],
        "config": json.dumps(config, indent=2),
        "media": [_link(page_folder, path) for path in _media(run.folder)],
    }


def settings(config: dict[str, Any]) -> list[str]:
    """NAME=VALUE of the hyperparameters that differ from the agent's defaults; all if no agent of this name is known.

    An own agent is never known, since it would have to be imported.
    """
    defaults = agents.defaults().get(config["agent"], {})
    known = agents.before().get(config["agent"], {}) | config["hyperparameters"]
    return [f"{name}={as_text(value)}" for name, value in changed(known, defaults).items()]


def _session(session: dict[str, Any]) -> dict[str, str]:
    """Time, device, commit, command and versions of a session of a training, as text."""
    return {
        "started": str(session.get("started", "?")),
        "ended": str(session.get("ended", "?")),
        "device": str(session.get("device", "?")),
        "commit": str(session.get("git_commit") or "?"),
        "command": shlex.join(map(str, session.get("command", ()))),
        "versions": ", ".join(f"{name} {of}" for name, of in session.get("versions", {}).items()) or "?",
    }


def _media(folder: pathlib.Path) -> list[pathlib.Path]:
    """The videos and the curve in a run's folder. Its checkpoints are not read, since a training may remove them."""
    found = []
    for inside, folders, names in os.walk(folder):  # unlike `rglob`, it passes over folders that are removed meanwhile
        folders[:] = [name for name in folders if name != "checkpoints"]
        found += [pathlib.Path(inside, name) for name in names]
    return sorted(path for path in found if path.suffix in MEDIA or path == folder / PICTURE)


def _link(folder: pathlib.Path, path: pathlib.Path) -> dict[str, str]:
    """A file's name, and its address relative to a page in `folder`."""
    try:
        address = quote(os.path.relpath(path, folder).replace(os.sep, "/"))
    except ValueError:  # on Windows: another drive
        address = path.absolute().as_uri()
    return {"name": path.name, "address": address}
