"""What a training keeps in memory and on the disk, and whether killed trainings resume exactly.

    python benchmarks/storage.py replay             # the memory of a full replay
    python benchmarks/storage.py checkpoint         # the cost of checkpoints
    python benchmarks/storage.py kill-and-resume    # whether killed trainings end as an uninterrupted one

`--help` after one of these words describes what is measured, and its options.
"""

import os
import pathlib
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

import jax
import numpy as np
import tyro

from beliefrl import Options, agents
from beliefrl.runs.checkpoint import Checkpoints
from beliefrl.training import phases, schedule
from beliefrl.training.bench import Noise

STEPS, EPISODE = 800_000, 1000  # with room for 1.25 timesteps a step, this is the largest replay by default


def replay() -> None:
    """The memory of a replay of a million timesteps, divided by that of the data in it.

    Episodes have 1,000 steps.
    """
    for name in ("vrm", "predictive-sac", "sac-mlp", "sac-lstm", "slac"):
        agent, task = agents.make(name), Noise(6, 3)
        capacity = schedule.capacity(agent, Options(steps=STEPS))
        seed = phases.begin(agent, task, capacity, jax.random.key(0))
        ring = sum(leaf.nbytes for leaf in jax.tree.leaves(seed.replay.timesteps))
        data = ring / capacity * (STEPS + STEPS // EPISODE)
        print(f"{name}: {ring / 1e9:.2f} GB for {data / 1e9:.2f} GB of data, ratio {ring / data:.2f}")


def checkpoint(name: str = "vrm", steps: int = 2_000, capacity: int = 200_000, rounds: int = 3) -> None:
    """Measure the cost of a checkpoint every 2,000 steps, at the sizes of velocities-only Hopper: about ten minutes.

    Stretches of `steps` steps with and without a checkpoint alternate. The difference of their times includes the time
    that the training waits for a checkpoint, and the slowdown while a thread writes it.

    Args:
        name: the agent.
        steps: steps of a stretch.
        capacity: timesteps of the replay.
        rounds: stretches of each kind that are timed.
    """
    agent, every = agents.make(name), 100
    program = phases.compile_program(agent, Noise(6, 3), capacity, 1)
    seeds = program.begin(jax.random.split(jax.random.key(0), 1))
    for first in range(0, 1000, every):
        seeds, _ = program.explore(seeds, first, every)
    seeds, _ = program.learn(seeds, 1000, every // agent.cycle)  # compiles
    times: tuple[list[float], list[float]] = ([], [])
    waited = []
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(pathlib.Path(folder), keep=2)
        for number in range(2 * rounds + 2):
            first = 1000 + every + number * steps
            before = time.perf_counter()
            if number % 2:
                replay = seeds.replay
                rest = seeds._replace(replay=replay._replace(timesteps=()))
                checkpoints.save(first, {}, rest, replay.timesteps, np.asarray(replay.added))
                waited.append(time.perf_counter() - before)
            for step in range(first, first + steps, every):
                seeds = jax.block_until_ready(program.learn(seeds, step, every // agent.cycle)[0])
            if number > 1:  # the first checkpoint writes all earlier timesteps
                times[number % 2].append(time.perf_counter() - before)
        checkpoints.close()
        size = sum(path.stat().st_size for path in pathlib.Path(folder).rglob("*") if path.is_file())
    without, with_one = (statistics.median(each) for each in times)
    print(f"{steps} steps: {without:.2f} s without a checkpoint, {with_one:.2f} s with: {with_one / without - 1:+.2%}")
    print(f"the training waits {1e3 * statistics.median(waited[1:]):.0f} ms for it; two hold {size / 1e6:.0f} MB")


# kill-and-resume

SETTINGS = {
    "steps": 3000,
    "seeds": 2,
    "eval-every": 500,
    "eval-episodes": 1,
    "checkpoint-steps": 50,
    "step-start-rl": 200,
    "pretrain-updates": 200,
    "batch-size": 32,
}


def command(*words: str) -> list[str]:
    """A `beliefrl` command."""
    return [sys.executable, "-m", "beliefrl.cli", *words]


def training(folder: pathlib.Path) -> list[str]:
    """The command that starts the training."""
    options = [word for name, value in SETTINGS.items() for word in (f"--{name}", str(value))]
    return command("train", "sac-mlp", "pendulum-v", *options, "--out", str(folder))


def is_writing(folder: pathlib.Path) -> bool:
    """Whether a checkpoint is being written."""
    return any(folder.glob("checkpoints/.*.tmp")) or any(folder.glob("checkpoints/replay/.*.tmp"))


def killed(arguments: list[str], folder: pathlib.Path, in_writing: bool, seconds: float) -> bool | None:
    """Run and kill; returns whether a checkpoint was being written, or None if the training had already ended."""
    newest = max(folder.glob("checkpoints/0*"), default=None)
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while process.poll() is None and max(folder.glob("checkpoints/0*"), default=None) == newest:
            time.sleep(0.001)
        until = time.monotonic() + seconds
        while process.poll() is None and time.monotonic() < until + 60 * in_writing:
            if in_writing and time.monotonic() > until and is_writing(folder):
                break
        if process.poll() is not None:
            _, err = process.communicate()
            if process.returncode:
                raise SystemExit(f"the training failed: {err.decode()}")
            return None
        process.kill()
        process.wait()
    return is_writing(folder)


def learned(folder: pathlib.Path) -> dict[str, bytes]:
    """The files that must be equal: logs, networks, results."""
    paths = [*sorted((folder / "metrics").iterdir()), folder / "agent.safetensors", folder / "results.json"]
    return {path.name: path.read_bytes() for path in paths}


def kill_and_resume(kills: int = 50, seed: int = 0) -> None:
    """Kill a training at random times, half of them while a checkpoint is being written, and resume it each time.

    This takes about ten minutes. The signal is SIGKILL. At the end, the metrics and the networks must be byte-identical
    to those of an uninterrupted training. If a training ends before the last kill, it is compared, and a new training
    starts.

    Args:
        kills: how often a training is killed.
        seed: of the random times.
    """
    times, folder = random.Random(seed), pathlib.Path(tempfile.mkdtemp())
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "compiled")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    reference, run = folder / "whole", folder / "run"
    subprocess.run(training(reference), check=True, stdout=subprocess.DEVNULL)
    expected, done, writing, finished = learned(reference), 0, 0, 0
    arguments = training(run)
    while done < kills or arguments is not None:
        if done == kills:
            subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
            found = None
        else:
            found = killed(arguments, run, in_writing=done % 2 == 1, seconds=times.uniform(0, 0.6))
        if found is None:
            finished += 1
            if learned(run) != expected:
                raise SystemExit(f"training {finished} differs from the uninterrupted one: see {folder}")
            print(f"{done} kills: training {finished} is equal to the uninterrupted one", flush=True)
            shutil.rmtree(run)
            arguments = training(run) if done < kills else None
            continue
        done, writing = done + 1, writing + found
        arguments = command("resume", str(run))
    print(f"{done} kills, {writing} of them while a checkpoint was written; {finished} trainings, all byte-identical")
    shutil.rmtree(folder)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {"replay": replay, "checkpoint": checkpoint, "kill-and-resume": kill_and_resume}
    )
