"""Changes the source in small ways, and says which changes no test notices: python tests/mutation.py [MODULE ...].

Needs `pip install cosmic-ray` in an environment of its own, whose `cosmic-ray` is found on the PATH. It works on a
copy of the repository. A mutant is one change; it is killed where a test of its module fails.
"""

import argparse
import ast
import os
import pathlib
import random
import re
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import tomllib

ROOT = pathlib.Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutation"]


def behaviour(source, leave_out):
    """The lines and columns where a change is none of annotations, docstrings and the functions left out."""
    tree = ast.parse(source)
    outside = [node for node in ast.walk(tree) if re.fullmatch(leave_out, getattr(node, "name", " "))]
    for node in ast.walk(tree):
        outside += [getattr(node, name, None) for name in ("annotation", "returns")]
    spans = [((o.lineno, o.col_offset), (o.end_lineno, o.end_col_offset)) for o in outside if o is not None]
    return lambda at: not any(begin <= at < end for begin, end in spans)


def session(module, folder, sample, seed):
    """A session of cosmic-ray with the mutants of a module, of which `sample` are drawn (0: all)."""
    settings, path = SETTINGS["modules"][module], f"src/beliefrl/{module}.py"
    test = [sys.executable, "-m", "pytest", "-qx", "-n", "0", "-p", "no:cacheprovider", *settings["tests"]]
    config = folder / "config.toml"
    config.write_text(
        f"[cosmic-ray]\nmodule-path = '{path}'\ntimeout = 600.0\nexcluded-modules = []\n"
        f"test-command = '{' '.join(test)}'\n[cosmic-ray.distributor]\nname = 'local'\n"
    )
    subprocess.run(["cosmic-ray", "init", config, folder / "session.sqlite"], cwd=folder, check=True)
    counts = behaviour((folder / path).read_text(), settings.get("leave-out", ""))
    with sqlite3.connect(folder / "session.sqlite") as database:
        rows = database.execute("select job_id, operator_name, start_pos_row, start_pos_col from mutation_specs")
        jobs = [(job, counts((row, col)) and re.fullmatch(SETTINGS["operators"], name)) for job, name, row, col in rows]
        kept = sorted(job for job, fits in jobs if fits)
        random.Random(seed).shuffle(kept)
        kept = set(kept[: sample or len(kept)])
        for job, _ in jobs:
            if job not in kept:
                database.execute("delete from mutation_specs where job_id = ?", (job,))
                database.execute("delete from work_items where job_id = ?", (job,))
    return config


def run(module, sample, seed):
    """Run the mutants of a module and print those that survive."""
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        for part in ("src", "tests", "pyproject.toml"):
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, folder / part)
        os.environ["PYTHONPATH"] = str(folder / "src")
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # of an earlier mutant of the same length
        os.environ["BELIEFRL_TEST_CACHE"] = str(folder / "compiled")
        config = session(module, folder, sample, seed)
        test = tomllib.loads(config.read_text())["cosmic-ray"]["test-command"]
        subprocess.run(test.split(), cwd=folder, check=True)  # without a change they pass; what it compiles is kept
        subprocess.run(["cosmic-ray", "exec", config, folder / "session.sqlite"], cwd=folder, check=True)
        with sqlite3.connect(folder / "session.sqlite") as database:
            results = database.execute("select test_outcome, diff from work_results").fetchall()
    survivors = [diff for outcome, diff in results if outcome != "KILLED"]
    print(*survivors, f"{module}: {len(results)} mutants, {len(results) - len(survivors)} killed", sep="\n", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", default=list(SETTINGS["modules"]))
    parser.add_argument("--sample", type=int, default=0, help="how many mutants of each module are drawn (0: all)")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for each in given.modules:
        run(each, given.sample, given.seed)
