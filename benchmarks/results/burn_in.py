"""Measure how many timesteps of burn-in determine the recurrent states of trained VRM agents.

    python benchmarks/results/burn_in.py RUN ...

RUN is the folder of a training of vrm with its saved agent. Windows of its episodes (mode actions) are unrolled from
the empty state. Their states are compared with those of the whole episode, both with the posterior's mean of z. What is
printed is the squared difference after so many timesteps, divided by the variance of the states: 0 % is the same state,
and an unrelated state has about 200 %.
"""

import sys

import jax
import numpy as np

from beliefrl.models.window_loss import states
from beliefrl.training.restore import restore_seed
from beliefrl.types import Window
from beliefrl.viewing.episodes import Player

EPISODES = 10
TIMESTEPS = (1, 2, 4, 8, 16, 32, 64)
APART = 8  # timesteps between the starts of two windows


def differences(agent, vrm, episodes):
    """The relative squared difference of d after each of TIMESTEPS, over all windows with earlier timesteps."""

    @jax.jit
    def unroll(steps):
        exists = np.ones(steps.reward.shape, bool)
        return states(vrm, Window(steps, (), exists), np.zeros((*exists.shape, agent.z_size), np.float32)).d

    length, starts, true = max(TIMESTEPS), [], []
    for steps in episodes:
        whole = np.asarray(unroll(jax.tree.map(lambda leaf: leaf[:, None], steps)))[:, 0]
        for start in range(APART, len(whole) - length + 1, APART):
            starts.append(jax.tree.map(lambda leaf, start=start: leaf[start : start + length], steps))
            true.append(whole[start : start + length])
    if not true:
        sys.exit(f"All episodes are shorter than {length + APART} timesteps: take a run whose episodes are longer.")
    cut = np.asarray(unroll(jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *starts)))
    true = np.stack(true, axis=1)
    variance = np.var(true, axis=(0, 1)).sum()
    return [np.mean(np.sum((cut[k - 1] - true[k - 1]) ** 2, axis=-1)) / variance for k in TIMESTEPS], len(starts)


def main(folders):
    print(f"{'run':<28}{'model':<7}{'windows':>8}" + "".join(f"{k:>9}" for k in TIMESTEPS))
    for folder in folders:
        agent, task, state, precision = restore_seed(folder)
        with Player(agent, task, state, precision) as player:
            episodes = [player.play(number).steps for number in range(EPISODES)]
        for name in agent.predictors:
            found, windows = differences(agent, getattr(state, name), episodes)
            print(f"{folder[-27:]:<28}{name:<7}{windows:>8}" + "".join(f"{each:>9.2%}" for each in found), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
