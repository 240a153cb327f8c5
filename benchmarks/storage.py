"""What a training keeps, in memory and on the disk.

python benchmarks/storage.py replay        # the memory of a full replay
python benchmarks/storage.py checkpoint    # the cost of checkpoints
"""

import pathlib
import statistics
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
    for name in ("vrm", "sac-mlp", "sac-lstm", "slac"):
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


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"replay": replay, "checkpoint": checkpoint})
