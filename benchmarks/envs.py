"""Steps per second with a slow Gymnasium environment, by the number of environments (--envs): python benchmarks/envs.py

A step of the environment sleeps for 20 ms, as if it waited for a simulator or a robot. Each environment has a process
of its own. The steps are those of the exploration, without updates.
"""

import tempfile
import time

import gymnasium
import numpy as np

from beliefrl import make_agent, train
from beliefrl.tasks.gymnasium import GymnasiumTask

STEPS = 800


class Waiting(gymnasium.Env):
    """An environment that waits."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        time.sleep(0.02)
        self.steps += 1
        return np.zeros(3, np.float32), 0.0, False, self.steps == 200, {}


def steps_per_second(envs):
    """The rate between the first and the last report of the exploration."""
    agent, reports = make_agent("sac-mlp", step_start_rl=2 * STEPS), []

    def listen(event):
        if event.phase == "exploring":
            reports.append((time.monotonic(), event.step))

    options = {"steps": STEPS, "eval_every": 10 * STEPS, "eval_episodes": 1, "processes": "always", "track": ()}
    with tempfile.TemporaryDirectory() as folder:
        train(agent, GymnasiumTask(Waiting), f"{folder}/run", listen, envs=envs, progress=False, **options)
    (began, first), *_, (ended, last), _ = reports
    return (last - first) / (ended - began)


if __name__ == "__main__":
    for number in (1, 2, 4, 8):
        print(f"{number} environments: {steps_per_second(number):.1f} steps per second", flush=True)
