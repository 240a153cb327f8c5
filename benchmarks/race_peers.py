"""Race against other libraries: which agent needs the fewest steps and seconds to learn a task with hidden entries?

One race is one agent, task and seed, in a process of its own on one core. It ends at the first evaluation with a mean
return over the task's line, or when its seconds are spent. An evaluation is 20 episodes with mode actions. Its time is
not counted; the time of compilation is. benchmarks/README.md says what the agents have in common and what they do not.

    python -m venv /tmp/torch && /tmp/torch/bin/pip install torch==2.13.0 sb3-contrib==2.9.2 .
    python -m venv /tmp/memorax && /tmp/memorax/bin/pip install memorax==1.0.1 .
    git clone https://github.com/twni2016/pomdp-baselines /tmp/pomdp-baselines
    git -C /tmp/pomdp-baselines checkout 28cb5dd
    python -m venv /tmp/pomdp && /tmp/pomdp/bin/pip install torch==2.13.0 gym==0.26.2 future_fstrings tensorboard .
    python benchmarks/race_peers.py --out runs/peers.jsonl --cores 0,1 --minutes 10 --torch /tmp/torch/bin/python \
        --memorax /tmp/memorax/bin/python --pomdp-baselines /tmp/pomdp/bin/python /tmp/pomdp-baselines

Without the Python of a library its races are left out. Each race appends a line to --out when it ends. The same command
goes on after an interruption and runs only the races that are not in the file. At the end it prints a table of
everything in the file.
"""

import argparse
import json
import os
import pathlib
import queue
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import peers

SEEDS = range(3)


def read(out: pathlib.Path) -> list[dict[str, Any]]:
    """The results so far."""
    return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []


def outcome(result: dict[str, Any] | None) -> str:
    """A cell of the table: steps and seconds to the line, or the best return."""
    if result is None:
        return "not run"
    steps, seconds, mean = max(result["evaluations"], key=lambda each: each[2], default=(0, 0.0, float("-inf")))
    if mean > peers.LINES[result["task"]]:
        return f"{steps:,} steps, {seconds:.0f} s"
    if not result["evaluations"]:
        return f"-- (no evaluation by {result['steps']:,} steps)"
    return f"-- ({mean:.0f} at {steps:,} of {result['steps']:,} steps)"


def table(results: list[dict[str, Any]], libraries: list[str]) -> str:
    """The results in Markdown."""
    found = {(each["library"], each["task"], each["seed"]): each for each in results}
    rows = [["task", "agent", *(f"seed {seed}" for seed in SEEDS)], ["---"] * (2 + len(SEEDS))]
    for task in peers.LINES:
        for library in libraries:
            cells = [outcome(found.get((library, task, seed))) for seed in SEEDS]
            rows.append([f"`{task}`", library, *cells])
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description="Race BeliefRL's agents against other libraries.")
    parser.add_argument(
        "--out", type=pathlib.Path, required=True, help="file of results, one line of JSON for each race"
    )
    parser.add_argument("--cores", default="0", help="cores for the races, one for each race that runs: 0,1")
    parser.add_argument("--minutes", type=float, default=10.0, help="budget of a race, without its evaluations")
    parser.add_argument("--torch", help="Python with sb3-contrib")
    parser.add_argument("--memorax", help="Python with memorax")
    parser.add_argument("--pomdp-baselines", nargs=2, metavar=("PYTHON", "CHECKOUT"), help="Python with torch and gym")
    parser.add_argument("--only", nargs="+", help="only these agents, such as vrm RecurrentPPO")
    parser.add_argument("--tasks", nargs="+", choices=peers.LINES, default=list(peers.LINES), help="only these tasks")
    parser.add_argument("--seeds", type=int, nargs="+", choices=SEEDS, default=list(SEEDS), help="only these seeds")
    args = parser.parse_args()
    python, checkout = args.pomdp_baselines or (None, "")
    pythons = {"vrm": sys.executable, "predictive-sac": sys.executable, "RecurrentPPO": args.torch}
    pythons |= {"memorax SAC": args.memorax, "pomdp-baselines TD3": python}
    pythons = {name: path for name, path in pythons.items() if path and (not args.only or name in args.only)}
    source = str(pathlib.Path(__file__).resolve().parent.parent / "src")
    surroundings = os.environ | {"PYTHONPATH": source, "OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    surroundings |= {"BELIEFRL_CACHE": "off", "JAX_COMPILATION_CACHE_DIR": ""}  # each race compiles
    cores: queue.Queue[str] = queue.Queue()
    for core in args.cores.split(","):
        cores.put(core)

    def race(name: str, task: str, seed: int) -> str:
        core = cores.get()
        command = [pythons[name], peers.__file__, name, task, str(seed), str(60 * args.minutes), core, checkout]
        try:
            ended = subprocess.run(command, env=surroundings, capture_output=True, text=True)
        finally:
            cores.put(core)
        if ended.returncode:
            return f"{name} on {task}, seed {seed}, failed: {(ended.stderr.strip().splitlines() or ['?'])[-1]}"
        line = ended.stdout.splitlines()[-1]
        with args.out.open("a") as file:
            file.write(line + "\n")
        return f"{name} on {task}, seed {seed}: {outcome(json.loads(line))}"

    args.out.parent.mkdir(parents=True, exist_ok=True)
    done = {(each["library"], each["task"], each["seed"]) for each in read(args.out)}
    wanted = [(name, task, seed) for seed in args.seeds for task in args.tasks for name in pythons]
    with ThreadPoolExecutor(cores.qsize()) as pool:
        try:
            for line in pool.map(lambda each: race(*each), [each for each in wanted if each not in done]):
                print(line, file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            sys.exit("Stopped. The same command goes on with the races that are not finished.")
    print(table(read(args.out), list(pythons)))


if __name__ == "__main__":
    main()
