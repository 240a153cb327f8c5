"""Measure what VRM's beliefs contain, with a linear map (ridge regression) from the belief to a hidden quantity.

    python benchmarks/results/beliefs.py cartpole RUN ...    # the state of CartPole
    python benchmarks/results/beliefs.py targets RUN ...     # the number of targets that were reached

RUN is the folder of a training of vrm on CartPole or on target-reaching, with its saved agent. The map is fitted to a
part of the episodes and tested on the others.
"""

import collections
import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.training.restore import restore_seed
from beliefrl.types import perception
from beliefrl.viewing.episodes import Player

# CartPole: episodes with mode actions
EPISODES, FITTED = 24, 18
STATE = ("x (m)", "x' (m/s)", "θ (rad)", "θ' (rad/s)")
STATE_PENALTY = 1.0  # on standardised inputs, for some thousands of timesteps

# Targets: episodes with sampled actions, fitted to every other one
TARGET_EPISODES = 300
TARGET_REWARD = 5.0  # only the reward of a target is larger
SINCE = (0, 4, 16, 48, 128)  # steps since the last target
TARGET_PENALTY = 30.0


def belief_function(agent, task, trained):
    """A function from an episode's timesteps to beliefs (time, belief), with samples of z or with its means."""

    def perceive(memory, inputs):
        step, key, sampled = inputs
        _, memory = agent.act(trained, memory, step, key, sampled)
        return memory, jnp.concatenate([perception(step), memory.first.d, memory.keep.d])

    @jax.jit
    def beliefs(steps, sampled):
        time = len(steps.reward)
        inputs = steps, jax.random.split(jax.random.key(0), time), jnp.full(time, sampled)
        return jax.lax.scan(perceive, agent.reset(task.spec), inputs)[1]

    def padded(steps, sampled):  # all episodes have the same length, so this is compiled once
        missing = task.spec.max_steps + 1 - len(steps.reward)
        longer = jax.tree.map(lambda leaf: np.pad(leaf, [(0, missing)] + [(0, 0)] * (leaf.ndim - 1)), steps)
        return np.asarray(beliefs(longer, sampled), float)[: len(steps.reward)]

    return padded


def fit(inputs, targets, penalty, weight=1.0):
    """The linear map from standardised inputs (time, size) to targets (time, size), by ridge regression."""
    mean, deviation = inputs.mean(0), inputs.std(0) + 1e-6

    def columns(inputs):
        return np.c_[(inputs - mean) / deviation, np.ones(len(inputs))]

    fitted = columns(inputs)
    gram = fitted.T @ (weight * fitted) + penalty * np.eye(fitted.shape[1])
    weights = np.linalg.solve(gram, fitted.T @ (weight * targets))
    return lambda others: columns(others) @ weights


def play_with_states(agent, task, trained):
    """The timesteps and the states (time, 4) of each episode."""
    with Player(agent, task, trained, rendered=True) as player:
        for episode in range(EPISODES):
            steps = player.play(episode).steps
            yield steps, np.array([[float(leaf) for leaf in state] for state in player.environment.unwrapped.states])


def state_errors(fitted, tested):
    """The root mean squared error of a linear map: both arguments are lists of (inputs, states) of episodes."""
    (inputs, states), (test_inputs, test_states) = (
        [np.concatenate(part) for part in zip(*pairs, strict=True)] for pairs in (fitted, tested)
    )
    predict = fit(inputs, states, STATE_PENALTY)
    return np.sqrt(np.mean((test_states - predict(test_inputs)) ** 2, 0))


def print_state(name, numbers):
    print(f"{name:22}", *(f"{entry} {number:.3f} " for entry, number in zip(STATE, numbers, strict=True)))


def cartpole(path):
    """Print the standard deviation of the state, and the errors of a linear map from three inputs."""
    agent, task, trained, _ = restore_seed(path)
    episodes, beliefs = list(play_with_states(agent, task, trained)), belief_function(agent, task, trained)
    print(path)
    print_state("standard deviation", np.concatenate([states for _, states in episodes[FITTED:]]).std(0))
    recurrent = np.concatenate([beliefs(steps, False) for steps, _ in episodes])[:, -2 * agent.d_size :]
    first, keep = (np.median(part.std(0)) for part in np.split(recurrent, 2, axis=1))
    print(f"median standard deviation of an entry of d: first-impression {first:.4f}, keep-learning {keep:.4f}")
    for name, inputs in (
        ("observation", lambda steps: np.asarray(perception(steps), float)),
        ("belief, means of z", lambda steps: beliefs(steps, False)),
        ("belief, samples of z", lambda steps: beliefs(steps, True)),
    ):
        pairs = [(inputs(steps), states) for steps, states in episodes]
        print_state(name, state_errors(pairs[:FITTED], pairs[FITTED:]))


def reached_targets(rewards):
    """The number of targets reached at each timestep, and the number of steps since the last one."""
    time, reached = np.arange(len(rewards)), rewards > TARGET_REWARD
    return np.cumsum(reached), time - np.maximum.accumulate(np.where(reached, time, 0))


def fit_number(inputs, reached):
    """A function from beliefs to the number of targets. The numbers 0, 1 and 2 have the same weight in the fit."""
    weight = 1 / np.bincount(reached, minlength=3)[reached]
    scores = fit(inputs, np.eye(3)[reached], TARGET_PENALTY, (weight / weight.mean())[:, None])
    return lambda beliefs: scores(beliefs).argmax(1)


def targets(path):
    """Print how episodes fail, and the fraction of timesteps at which the predicted number of targets is right."""
    agent, task, trained, _ = restore_seed(path)
    with Player(agent, task, trained) as player:
        played = [player.play(episode, sampled=True) for episode in range(TARGET_EPISODES)]
    beliefs = belief_function(agent, task, trained)
    episodes = [(beliefs(each.steps, True), *reached_targets(each.steps.reward)) for each in played]
    failed = collections.Counter(int(reached[-1]) for _, reached, _ in episodes if reached[-1] < 3)
    print(path, f"failed: {failed.total()} of {TARGET_EPISODES}, by number of targets: {dict(sorted(failed.items()))}")

    inputs, reached, _ = (np.concatenate(part) for part in zip(*episodes[::2], strict=True))
    predict = fit_number(inputs[reached < 3], reached[reached < 3])
    inputs, reached, since = (np.concatenate(part) for part in zip(*episodes[1::2], strict=True))
    right = predict(inputs) == reached
    for count in range(3):
        fractions = []
        for low, high in itertools.pairwise(SINCE):
            chosen = right[(reached == count) & (since >= low) & (since < high)]
            fractions.append(f"{low} to {high - 1}: {chosen.sum() / max(len(chosen), 1):.2f} of {len(chosen)}")
        print(f"  {count} reached; steps since the last one:", "; ".join(fractions))


MEASUREMENTS = {"cartpole": cartpole, "targets": targets}
if len(sys.argv) < 3 or sys.argv[1] not in MEASUREMENTS:
    sys.exit(__doc__)
for run in sys.argv[2:]:
    MEASUREMENTS[sys.argv[1]](run)
