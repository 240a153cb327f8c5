"""Deploy a trained policy: as a function in your own loop, and as one file that jax loads without this library.

    pip install -c constraints.txt -e .             # in a clone of the repository
    beliefrl train predictive-sac gym:Pendulum-v1 --observe 2 --steps 8000 --out runs/pendulum
    python examples/04_deploying.py runs/pendulum     # 12 s of CPU time
    python examples/04_deploying.py --quick           # trains a small agent first: 25 s of CPU time

Inputs and outputs are numpy arrays. `state` is the recurrent memory: pass it to the next call, or None at the start of
an episode. The reward of the last step is an input, since the belief depends on it (not with `--no-perceive-reward`).
If a sensor value is not finite, `predict` raises a `beliefrl.UserError` that names the entry. The state stays valid, so
the control loop can continue.
"""

import pathlib

import jax
import jax.export
import numpy as np
import tyro

import beliefrl


def main(run: tyro.conf.Positional[str] = "runs/pendulum", episodes: int = 3, quick: bool = False) -> None:
    """Play in the run's environment; then export the policy, load the file, and compare the first actions."""
    if quick:
        agent = beliefrl.make_agent("predictive-sac", step_start_rl=200, pretrain_updates=50, d_size=32)
        run, task = "runs/pendulum-quick", beliefrl.make_task("gym:Pendulum-v1", observe=2)
        beliefrl.train(agent, task, run, resume=True, steps=300)
    policy = beliefrl.load(run)
    print(policy)  # shows agent, task, sizes, seed
    environment = beliefrl.make_env(run)  # as in training: only the observed entries, actions in [-1, 1]
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
    policy.export(file, overwrite=True)  # "policy.onnx" gives a file for onnxruntime
    exported = jax.export.deserialize(bytearray(file.read_bytes()))  # does not need this library
    obs, _ = environment.reset(seed=0)
    state = policy.initial_state(1)  # zeros
    start, seed, deterministic = np.array([True]), np.uint32(0), np.bool_(True)
    action, state = exported.call(obs[None], np.zeros(1, np.float32), state, start, seed, deterministic)
    print("the file's first action:", np.asarray(action)[0], "and the policy's:", policy.predict(obs)[0])


if __name__ == "__main__":
    tyro.cli(main)
