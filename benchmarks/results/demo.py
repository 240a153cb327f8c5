"""Pack an agent for `beliefrl demo`: `python benchmarks/results/demo.py RUN`.

docs/viewing.md has the commands that train the agents. Each seed of RUN plays 100 episodes. The seed with the highest
mean return (mode actions) is packed into the package, as a run of its own. It plays 100 further episodes; their
returns and those of all seeds are in its results.json.
"""

import json
import pathlib
import shutil
import sys
import tempfile
import zipfile

import beliefrl
from beliefrl.runs import arrays
from beliefrl.viewing.demo import FOLDER

EPISODES = 100


def pack(run: beliefrl.Run, folder: pathlib.Path) -> pathlib.Path:
    """Write the best seed of a run to `folder`, and that folder to a zip file in the package; returns its path."""

    def write(name: str, content: dict) -> None:
        (folder / name).write_text(json.dumps(content, indent=2) + "\n")

    evaluated = beliefrl.evaluate(run, EPISODES)
    returns = evaluated["mode"]["seeds"]
    best = returns.index(max(returns))
    seed = run.seeds[best]
    write("config.json", run.config | {"options": run.config["options"] | {"seed": seed, "seeds": 1}})
    agents = arrays.load(run.folder / "agent.safetensors")
    (folder / "agent.safetensors").write_bytes(arrays.packed({name: array[[best]] for name, array in agents.items()}))
    (folder / "metrics").mkdir()
    shutil.copy(run.folder / "metrics" / f"seed-{seed}.jsonl", folder / "metrics")
    again = beliefrl.evaluate(folder, EPISODES, seed=1)
    write("results.json", {"step": run.results()["step"], **again, "chosen_from": {"seeds": run.seeds, **evaluated}})
    path = FOLDER / f"{run.config['task']}.zip"
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w") as packed:
        for file in sorted(file for file in folder.rglob("*") if file.is_file()):
            name = zipfile.ZipInfo(file.relative_to(folder).as_posix())  # without a date: the same bytes each time
            packed.writestr(name, file.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    return path


if len(sys.argv) != 2:
    sys.exit(__doc__)
with tempfile.TemporaryDirectory() as temporary:
    written = pack(beliefrl.Run(sys.argv[1]), pathlib.Path(temporary))
print(f"{written}: {written.stat().st_size / 1000:.0f} kB")
