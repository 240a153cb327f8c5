"""Files of results: the runs of an experiment in one small file, NAME.json.gz. Figures read it like folders of runs.

    {"format": 1, "defaults": {AGENT: {NAME: value}}, "runs": [{"name", "config", "lacks", "rows": {SEED: [row]}}]}

`config` is the run's config.json, but only with the hyperparameters that differ from the agent's `defaults` in the
file. A run that is older than some hyperparameters has their names under `lacks`: their values are not known, because a
default may have changed since. The rows are the evaluations, the divergences, and the means of `SERIES` over the
updates between evaluations. Numbers have six significant digits.
"""

import gzip
import json
import pathlib
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from beliefrl.errors import UserError
from beliefrl.runs.given_files import write_given
from beliefrl.runs.run import Row, Run

ENDING = ".json.gz"
FORMAT = 1
DIGITS = 6  # significant
KINDS = ("evaluation", "diverged")  # rows that are stored unchanged
MODEL_LOSSES = ("negative_elbo", "prediction_error", "loss_model")  # names of a model's loss in the logs
SERIES = (*MODEL_LOSSES, "q")


class KeptRun(Run):
    """A run from a file of results: it has settings, evaluations and means of the updates, but no trained agent."""

    def __init__(self, folder: pathlib.Path, config: dict[str, Any], rows: Mapping[int, Sequence[Row]]):
        """`folder` identifies the run: the path of the file, and the name of the run's original folder."""
        self.folder, self.given, self.config, self._rows = folder, folder, config, rows

    def rows(self, seed: int, kind: str | None = None) -> Iterator[Row]:
        return (row for row in self._rows[seed] if kind in (None, row["kind"]))


def cut(run: Run, until: int) -> KeptRun:
    """The run with only the rows up to `until` environment steps. Its time is then unknown.

    Rows of the pre-training are left out, because they count updates.
    """
    rows = {seed: [row for row in run.rows(seed) if row["kind"] != "pretrain"] for seed in run.seeds}
    is_cut = any(row["step"] > until for of_seed in rows.values() for row in of_seed)
    rows = {seed: [row for row in of_seed if row["step"] <= until] for seed, of_seed in rows.items()}
    timeless = {name: value for name, value in run.config.items() if name not in ("ended", "resumed")}
    return KeptRun(run.folder, timeless if is_cut else run.config, rows)


def read(path: pathlib.Path) -> list[KeptRun]:
    """The runs in a file of results, with the hyperparameters that they had.

    Raises:
        UserError: there is no such file, or it is not a file of results.
    """
    try:
        content = json.loads(gzip.decompress(path.read_bytes()))
        if content["format"] != FORMAT:
            raise UserError(f"{path} has format {content['format']}, which this version cannot read: update beliefrl.")
        return [_unpacked(path, entry, content["defaults"]) for entry in content["runs"]]
    except FileNotFoundError:
        raise UserError(f"There is no file {path}: give a file of results, or folders of runs.") from None
    except (OSError, EOFError, ValueError, zlib.error, KeyError, TypeError, AttributeError):
        raise UserError(f"{path} cannot be read as a file of results: restore it from a copy.") from None


def _unpacked(path: pathlib.Path, entry: dict[str, Any], defaults: Mapping[str, Row]) -> KeptRun:
    config = entry["config"]
    known, lacks = defaults.get(config["agent"], {}), entry.get("lacks", ())
    usual = {name: value for name, value in known.items() if name not in lacks}
    config["hyperparameters"] = usual | config["hyperparameters"]
    run = KeptRun(path / entry["name"], config, {int(seed): rows for seed, rows in entry["rows"].items()})
    if not all("step" in row and "kind" in row for seed in run.seeds for row in run.rows(seed)):
        raise ValueError("a row lacks its step or kind")
    return run


def write(path: pathlib.Path, runs: Sequence[Run], defaults: Mapping[str, Row]) -> None:
    """Write runs, finished or not, to one file. The same runs give the same bytes.

    Args:
        path: the file, NAME.json.gz. An existing file is replaced: to extend it, give its runs as well.
        runs: runs from folders or from files of results. If a training occurs twice, the later one is written.
        defaults: the hyperparameters of agents by name (`agents.defaults`).

    Raises:
        UserError: two different trainings have folders of the same name, or the file cannot be written.
    """
    entries: dict[str, dict[str, Any]] = {}
    for run in runs:
        name, began = run.folder.name, run.config.get("started")
        if name in entries and entries[name]["config"].get("started") != began:
            raise UserError(f"Two trainings are called {name}: rename the folder of one, or use another file.")
        entries[name] = _packed(run, defaults.get(run.config["agent"], {}))
    used = sorted({run.config["agent"] for run in runs} & defaults.keys())
    content = {
        "format": FORMAT,
        "defaults": {agent: defaults[agent] for agent in used},
        "runs": [entries[name] for name in sorted(entries)],
    }
    write_given(path, gzip.compress(json.dumps(content, separators=(",", ":")).encode(), mtime=0))


def changed(hyperparameters: Row, defaults: Row) -> Row:
    """The hyperparameters that differ from their defaults, and those without a default. Both have JSON's types."""
    return {name: value for name, value in hyperparameters.items() if name not in defaults or defaults[name] != value}


def means_between(updates: Sequence[Row], name: str, steps: Sequence[int]) -> np.ndarray:
    """The mean of an entry over the updates since the previous one of `steps` (step,); NaN if there is no update."""
    rows = [row for row in updates if name in row]
    at, values = np.array([row["step"] for row in rows]), np.array([row[name] for row in rows], float)
    within = [values[(at > low) & (at <= high)] for low, high in zip([0, *steps], steps, strict=False)]
    return np.array([part.mean() if part.size else np.nan for part in within])


def _packed(run: Run, usual: Row) -> dict[str, Any]:
    own = run.config["hyperparameters"]
    ordered = {name: own[name] for name in (usual | own) if name in own}
    text = json.dumps(run.config | {"hyperparameters": changed(ordered, usual)})
    config = json.loads(re.sub(r'"/[^"]*/(runs/[^"]*)"', r'"\1"', text))  # cut absolute paths to runs/...
    lacks = [name for name in usual if name not in own]
    rows = {seed: _kept_rows(run, seed) for seed in run.seeds}
    return {"name": run.folder.name, "config": config, "lacks": lacks, "rows": rows}


def _kept_rows(run: Run, seed: int) -> list[Row]:
    updates = list(run.rows(seed, "update"))
    steps = [row["step"] for row in run.rows(seed, "evaluation")]
    means = {name: means_between(updates, name, steps) for name in SERIES}
    rows: list[Row] = []
    for index, step in enumerate(steps):
        known = {name: of[index] for name, of in means.items() if not np.isnan(of[index])}
        rows += [{"step": step, "kind": "update", **known}] if known else []
    rows += [row for row in run.rows(seed) if row["kind"] in KINDS]
    return [{name: _rounded(value) for name, value in row.items()} for row in sorted(rows, key=lambda row: row["step"])]


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(each) for each in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
