"""Keep what a sweep's runs have measured: `python docs/results/keep.py runs/sweep docs/results/NAME`.

Of each run its config, its results and its metrics: every evaluation and episode, but of the updates only those of
every thousandth step, so that a run of 80,000 steps takes 100 kB. The commands that read runs read these folders too.
"""

import json
import pathlib
import re
import shutil
import sys

EVERY = 1_000  # environment steps


def is_kept(row: dict) -> bool:
    """Whether a row of the metrics stays."""
    return row["kind"] not in ("update", "pretrain") or row["step"] % EVERY == 0


def keep(run: pathlib.Path, to: pathlib.Path) -> None:
    """Copy what stays of one run."""
    (to / "metrics").mkdir(parents=True, exist_ok=True)
    config = (run / "config.json").read_text()  # where the sweep lay on this machine concerns nobody
    (to / "config.json").write_text(re.sub(r'"/[^"]*/(runs/[^"]*)"', r'"\1"', config))
    if (run / "results.json").exists():
        shutil.copy(run / "results.json", to / "results.json")
    for log in (run / "metrics").iterdir():
        lines = [line for line in log.read_text().splitlines(keepends=True) if is_kept(json.loads(line))]
        (to / "metrics" / log.name).write_text("".join(lines))


if __name__ == "__main__":
    source, target = map(pathlib.Path, sys.argv[1:])
    target.mkdir(parents=True, exist_ok=True)
    for made in sorted(source.glob("*/config.json")):
        keep(made.parent, target / made.parent.name)
