"""Measure the cost of a checkpoint every 2,000 steps, at the sizes of velocities-only Hopper.

    python benchmarks/checkpoint.py            # about ten minutes

Stretches of 2,000 steps with and without a checkpoint alternate. The difference of their times includes the time that
the training waits for a checkpoint, and the slowdown while a thread writes it.
"""

import pathlib
import statistics
import tempfile
import time

import jax
import numpy as np
import tyro

from beliefrl import agents
from beliefrl.runs.checkpoint import Checkpoints
from beliefrl.training import phases
from beliefrl.training.bench import Noise


def main(name: str = "vrm", steps: int = 2_000, capacity: int = 200_000, rounds: int = 3) -> None:
    """Time `steps` steps of the agent, `rounds` times with a checkpoint at their start and `rounds` times without."""
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
    tyro.cli(main)
