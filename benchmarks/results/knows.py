"""Show how well VRM's beliefs know CartPole's hidden state: `python benchmarks/results/knows.py RUN ...`.

RUN is a training of vrm on CartPole, with its saved agent. Of each run 24 episodes are played with mode actions, and
perceived twice: with the mean of every z, and with a sample of it. A linear map from the belief to the state (ridge
regression) is fitted to 18 episodes and tried on the others.
"""

import sys

import numpy as np
from probe import fit, perceiver

from beliefrl.training.evaluation import restore_seed
from beliefrl.types import perception
from beliefrl.viewing.episodes import Player

EPISODES, FITTED = 24, 18
STATE = ("x (m)", "x' (m/s)", "θ (rad)", "θ' (rad/s)")
PENALTY = 1.0  # on standardised inputs, beside some thousands of moments


def play(agent, task, trained):
    """The steps and the states (time, 4) of each episode."""
    with Player(agent, task, trained, rendered=True) as player:
        for episode in range(EPISODES):
            steps = player.play(episode).steps
            yield steps, np.array([[float(leaf) for leaf in state] for state in player.environment.unwrapped.states])


def unknown(fitted, tried):
    """Root mean square of what a linear map, fitted to (inputs, states), does not tell of other states."""
    (inputs, states), (others, to_tell) = (
        [np.concatenate(part) for part in zip(*pairs, strict=True)] for pairs in (fitted, tried)
    )
    tell_states = fit(inputs, states, PENALTY)
    return np.sqrt(np.mean((to_tell - tell_states(others)) ** 2, 0))


def tell(name, numbers):
    """One line."""
    print(f"{name:18}", *(f"{what} {number:.3f} " for what, number in zip(STATE, numbers, strict=True)))


def main():
    """Of each run the deviation of the state, and what three ways to perceive leave of it."""
    for path in sys.argv[1:]:
        agent, task, trained, _ = restore_seed(path)
        episodes, perceived = list(play(agent, task, trained)), perceiver(agent, task, trained)
        ways = {
            "what is seen": lambda steps: np.asarray(perception(steps), float),
            "belief, z's means": lambda steps, perceived=perceived: perceived(steps, False),
            "belief, samples": lambda steps, perceived=perceived: perceived(steps, True),
        }
        print(path)
        tell("deviation", np.concatenate([states for _, states in episodes[FITTED:]]).std(0))
        remembered = np.concatenate([perceived(steps, False) for steps, _ in episodes])[:, -2 * agent.d_size :]
        first, keep = (np.median(part.std(0)) for part in np.split(remembered, 2, axis=1))
        print(f"median deviation of an entry of d: first-impression {first:.4f}, keep-learning {keep:.4f}")
        for name, way in ways.items():
            pairs = [(way(steps), states) for steps, states in episodes]
            tell(name, unknown(pairs[:FITTED], pairs[FITTED:]))


main()
