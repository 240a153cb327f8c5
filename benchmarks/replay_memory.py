"""The memory of the replay for a training of a million steps, as a ratio to the data that it stores.

python benchmarks/replay_memory.py
"""

import jax

from beliefrl import Options, make_agent
from beliefrl.training import phases, schedule
from beliefrl.training.bench import Noise

STEPS, EPISODE = 800_000, 1000  # with 1.25 timesteps a step the ring is as large as it gets by default


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
