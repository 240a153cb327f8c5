"""Keep results or a trained agent of runs in the repository.

    python benchmarks/results/keep.py evaluations results/NAME.json.gz RUNS ...
    python benchmarks/results/keep.py demo RUN

`evaluations` writes the results of runs to a file. RUNS are runs, finished or not, folders that contain runs, or other
files of results. Runs that are already in the file stay there. If a run is given again, for example after more steps,
it replaces its earlier version. The format of the file is described in `beliefrl.analysis.results`.

`demo` packs an agent for `beliefrl demo`. docs/results/README.md has the commands that train the agents. Each seed of
RUN plays 100 episodes. The seed with the highest mean return (mode actions) is packed into the package, as a run of its
own. It plays 100 further episodes; their returns and those of all seeds are in its results.json.
"""

import json
import pathlib
import sys
import tempfile
import zipfile

import beliefrl
from beliefrl import agents
from beliefrl.analysis import groups, results
from beliefrl.runs import arrays
from beliefrl.viewing.demo import FOLDER

EPISODES = 100


def evaluations(file: pathlib.Path, *given: pathlib.Path) -> None:
    """Write the results of runs to a file, beside those that it has."""
    runs = groups.find([file, *given] if file.exists() else given).runs
    results.write(file, runs, agents.defaults())
    print(f"{file}: {len(results.read(file))} runs, {file.stat().st_size / 1000:.0f} kB")


def demo(path: pathlib.Path) -> None:
    """Pack the best seed of a run into the package."""
    with tempfile.TemporaryDirectory() as temporary:
        written = pack(beliefrl.Run(path), pathlib.Path(temporary))
    print(f"{written}: {written.stat().st_size / 1000:.0f} kB")


def pack(run: beliefrl.Run, folder: pathlib.Path) -> pathlib.Path:
    """Write the best seed of a run to `folder`, and that folder to a zip file in the package; returns its path."""

    def write(name: str, content: dict) -> None:
        (folder / name).write_text(json.dumps(content, indent=2) + "\n")

    evaluated = beliefrl.evaluate(run, EPISODES)
    returns = evaluated["mode"]["seeds"]
    best = returns.index(max(returns))
    seed = run.seeds[best]
    write("config.json", run.config | {"options": run.config["options"] | {"seed": seed, "seeds": 1}})
    networks = arrays.load(run.folder / "agent.safetensors")
    (folder / "agent.safetensors").write_bytes(arrays.packed({name: array[[best]] for name, array in networks.items()}))
    (folder / "metrics").mkdir()
    with (folder / "metrics" / f"seed-{seed}.jsonl").open("w") as log:  # six significant digits, as in files of results
        for row in run.rows(seed):
            rounded = json.loads(json.dumps(row), parse_float=lambda number: float(f"{float(number):.6g}"))
            log.write(json.dumps(rounded) + "\n")
    again = beliefrl.evaluate(folder, EPISODES, seed=1)
    write("results.json", {"step": run.results()["step"], **again, "chosen_from": {"seeds": run.seeds, **evaluated}})
    path = FOLDER / f"{run.config['task']}.zip"
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w") as packed:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            name = zipfile.ZipInfo(file.relative_to(folder).as_posix())  # without a date: the same bytes each time
            packed.writestr(name, file.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    return path


match sys.argv[1:]:
    case ["evaluations", file, *folders] if folders:
        evaluations(pathlib.Path(file), *map(pathlib.Path, folders))
    case ["demo", folder]:
        demo(pathlib.Path(folder))
    case _:
        sys.exit(__doc__)
