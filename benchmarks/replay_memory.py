"""The memory of a replay of a million timesteps, divided by that of the data in it, with episodes of 1,000 steps.

python benchmarks/replay_memory.py
"""

import jax

from beliefrl import Options, make_agent
from beliefrl.training import phases, schedule
from beliefrl.training.bench import Noise

STEPS, EPISODE = 800_000, 1000  # with room for 1.25 timesteps a step, this is the largest replay by default


def main() -> None:
    for name in ("vrm", "sac-mlp", "sac-lstm", "slac"):
        agent, task = make_agent(name), Noise(6, 3)
        capacity = schedule.capacity(agent, Options(steps=STEPS))
        seed = phases.begin(agent, task, capacity, jax.random.key(0))
        ring = sum(leaf.nbytes for leaf in jax.tree.leaves(seed.replay.timesteps))
        data = ring / capacity * (STEPS + STEPS // EPISODE)
        print(f"{name}: {ring / 1e9:.2f} GB for {data / 1e9:.2f} GB of data, ratio {ring / data:.2f}")


if __name__ == "__main__":
    main()
