"""Deploying: what a run has learned as a function in your own loop, and as one file that jax alone can load.

    pip install beliefrl
    beliefrl train vrm gym:Pendulum-v1 --observe 2 --steps 10000 --out runs/pendulum
    python examples/04_deploying.py runs/pendulum

Numpy goes in and comes out. The recurrent memory is the `state`: pass it to the next call, and say where an episode
starts. The reward of the last step is an input, as beliefs are formed of it too. A reading that is not a finite number
is a `beliefrl.UserError` that names the entry; the state is as it was, so a control loop can continue from it.
"""

import pathlib

import jax
import jax.export
import numpy as np
import tyro

import beliefrl


def main(run: tyro.conf.Positional[str], episodes: int = 3) -> None:
    """Play in the environment that the run was trained on; then export, load, and play again."""
    policy = beliefrl.load(run)
    print(policy)  # agent, task, sizes, seed
    task = beliefrl.task_of(run)
    environment = task.environment()  # as the agent saw it: its entries of the observation, actions in [-1, 1]
    totals = []
    for episode in range(episodes):
        obs, _ = environment.reset(seed=episode)
        reward, state, total, done = 0.0, None, 0.0, False
        while not done:
            action, state = policy.predict(obs, reward, state, deterministic=True)
            obs, reward, terminated, truncated, _ = environment.step(action)
            total, done = total + reward, terminated or truncated
        totals.append(round(total, 1))
    print("returns in your own loop:", totals)

    file = pathlib.Path(run) / "policy.jax"
    policy.export(file)
    exported = jax.export.deserialize(bytearray(file.read_bytes()))  # needs nothing of this library
    obs, _ = environment.reset(seed=0)
    state = policy.initial_state(1)  # zeros
    start, seed, deterministic = np.array([True]), np.uint32(0), np.bool_(True)
    action, state = exported.call(obs[None], np.zeros(1, np.float32), state, start, seed, deterministic)
    print("the file's first action:", np.asarray(action)[0], "and the policy's:", policy.predict(obs)[0])


if __name__ == "__main__":
    tyro.cli(main)
