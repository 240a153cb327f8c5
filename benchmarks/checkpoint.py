"""What checkpoints cost: a training with one every 2,000 steps beside one without, at velocities-only Hopper's sizes.

    python benchmarks/checkpoint.py            # about ten minutes

The replay has room for 100,000 steps. Stretches with and without a checkpoint alternate; the time of one is all that
the training waits for it and all that its writing slows down.
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
    """Time `rounds` times `steps` steps of the agent with, and without, a checkpoint at their beginning."""
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
                rest = seeds._replace(replay=replay._replace(moments=()))
                checkpoints.save(first, {}, rest, replay.moments, np.asarray(replay.added))
                waited.append(time.perf_counter() - before)
            for step in range(first, first + steps, every):
                seeds = jax.block_until_ready(program.learn(seeds, step, every // agent.cycle)[0])
            if number > 1:  # the first checkpoint writes all that came before
                times[number % 2].append(time.perf_counter() - before)
        checkpoints.close()
        size = sum(path.stat().st_size for path in pathlib.Path(folder).rglob("*") if path.is_file())
    without, with_one = (statistics.median(each) for each in times)
    print(f"{steps} steps: {without:.2f} s without a checkpoint, {with_one:.2f} s with: {with_one / without - 1:+.2%}")
    print(f"the training waits {1e3 * statistics.median(waited[1:]):.0f} ms for it; two hold {size / 1e6:.0f} MB")


if __name__ == "__main__":
    tyro.cli(main)
