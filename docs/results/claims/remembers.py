"""Tell how long VRM's belief knows how many targets were reached: `python docs/results/claims/remembers.py RUN ...`.

Of each run 300 episodes are played with sampled actions. A linear map from the belief to the number of targets reached
(ridge regression on each of 0, 1 and 2, which weigh the same) is fitted to every other episode and tried on the rest.
"""

import collections
import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.episodes import Player
from beliefrl.evaluation import restore_seed
from beliefrl.types import perception

EPISODES = 300
PRIZE = 5.0  # a larger reward is a target's
SINCE = (0, 4, 16, 48, 128)  # steps since the last target
PENALTY = 30.0  # on standardised inputs, beside some thousands of moments


def perceiver(agent, task, trained):
    """A function that gives what both models make of an episode's steps: (time, belief)."""

    def perceive(memory, moment):
        _, memory = agent.act(trained, memory, *moment, True)
        return memory, jnp.concatenate([perception(moment[0]), memory.first.d, memory.keep.d])

    @jax.jit
    def beliefs(steps):
        keys = jax.random.split(jax.random.key(0), len(steps.reward))
        return jax.lax.scan(perceive, agent.reset(task.spec), (steps, keys))[1]

    def padded(steps):  # all episodes of one length: one compilation
        missing = task.spec.max_steps + 1 - len(steps.reward)
        longer = jax.tree.map(lambda leaf: np.pad(leaf, [(0, missing)] + [(0, 0)] * (leaf.ndim - 1)), steps)
        return np.asarray(beliefs(longer), float)[: len(steps.reward)]

    return padded


def counted(rewards):
    """How many targets were reached at each moment, and how many steps ago the last one was."""
    time, reached = np.arange(len(rewards)), rewards > PRIZE
    return np.cumsum(reached), time - np.maximum.accumulate(np.where(reached, time, 0))


def fit(inputs, reached):
    """A linear map from beliefs to the number of targets."""
    mean, deviation = inputs.mean(0), inputs.std(0) + 1e-6
    weight = 1 / np.bincount(reached)[reached]
    weight = (weight / weight.mean())[:, None]

    def columns(beliefs):
        return np.c_[(beliefs - mean) / deviation, np.ones(len(beliefs))]

    of_fit = columns(inputs)
    gram = of_fit.T @ (weight * of_fit) + PENALTY * np.eye(of_fit.shape[1])
    weights = np.linalg.solve(gram, of_fit.T @ (weight * np.eye(3)[reached]))
    return lambda beliefs: (columns(beliefs) @ weights).argmax(1)


def main():
    """Of each run how episodes fail, and the share of moments at which the map tells the number of targets."""
    for path in sys.argv[1:]:
        agent, task, trained = restore_seed(path)
        with Player(agent, task, trained) as player:
            played = [player.play(episode, sampled=True) for episode in range(EPISODES)]
        beliefs = perceiver(agent, task, trained)
        told = [(beliefs(each.steps), *counted(each.steps.reward)) for each in played]
        failed = collections.Counter(int(reached[-1]) for _, reached, _ in told if reached[-1] < 3)
        print(path, f"failed: {failed.total()} of {EPISODES}, with so many targets: {dict(sorted(failed.items()))}")

        inputs, reached, _ = (np.concatenate(part) for part in zip(*told[::2], strict=True))
        tell = fit(inputs[reached < 3], reached[reached < 3])
        inputs, reached, since = (np.concatenate(part) for part in zip(*told[1::2], strict=True))
        right = tell(inputs) == reached
        for count in range(3):
            shares = []
            for low, high in itertools.pairwise(SINCE):
                chosen = right[(reached == count) & (since >= low) & (since < high)]
                shares.append(f"{low} to {high - 1}: {chosen.sum() / max(len(chosen), 1):.2f} of {len(chosen)}")
            print(f"  {count} reached; so many steps ago:", "; ".join(shares))


main()
