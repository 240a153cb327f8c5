"""Show how long VRM's belief knows how many targets were reached: `python benchmarks/results/remembers.py RUN ...`.

RUN is a training of vrm on target-reaching, with its saved agent. Of each run 300 episodes are played with sampled
actions. A linear map from the belief to the number of targets reached (ridge regression on each of 0, 1 and 2, which
weigh the same) is fitted to every other episode and tried on the rest.
"""

import collections
import itertools
import sys

import numpy as np
from probe import fit, perceiver

from beliefrl.training.evaluation import restore_seed
from beliefrl.viewing.episodes import Player

EPISODES = 300
PRIZE = 5.0  # a larger reward is a target's
SINCE = (0, 4, 16, 48, 128)  # steps since the last target
PENALTY = 30.0  # on standardised inputs, beside some thousands of moments


def counted(rewards):
    """How many targets were reached at each moment, and how many steps ago the last one was."""
    time, reached = np.arange(len(rewards)), rewards > PRIZE
    return np.cumsum(reached), time - np.maximum.accumulate(np.where(reached, time, 0))


def teller(inputs, reached):
    """A function from beliefs to the number of targets."""
    weight = 1 / np.bincount(reached)[reached]
    shares = fit(inputs, np.eye(3)[reached], PENALTY, (weight / weight.mean())[:, None])
    return lambda beliefs: shares(beliefs).argmax(1)


def main():
    """Of each run how episodes fail, and the share of moments at which the map tells the number of targets."""
    for path in sys.argv[1:]:
        agent, task, trained, _ = restore_seed(path)
        with Player(agent, task, trained) as player:
            played = [player.play(episode, sampled=True) for episode in range(EPISODES)]
        beliefs = perceiver(agent, task, trained)
        told = [(beliefs(each.steps, True), *counted(each.steps.reward)) for each in played]
        failed = collections.Counter(int(reached[-1]) for _, reached, _ in told if reached[-1] < 3)
        print(path, f"failed: {failed.total()} of {EPISODES}, with so many targets: {dict(sorted(failed.items()))}")

        inputs, reached, _ = (np.concatenate(part) for part in zip(*told[::2], strict=True))
        tell = teller(inputs[reached < 3], reached[reached < 3])
        inputs, reached, since = (np.concatenate(part) for part in zip(*told[1::2], strict=True))
        right = tell(inputs) == reached
        for count in range(3):
            shares = []
            for low, high in itertools.pairwise(SINCE):
                chosen = right[(reached == count) & (since >= low) & (since < high)]
                shares.append(f"{low} to {high - 1}: {chosen.sum() / max(len(chosen), 1):.2f} of {len(chosen)}")
            print(f"  {count} reached; so many steps ago:", "; ".join(shares))


main()
