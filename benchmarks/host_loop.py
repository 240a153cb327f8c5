"""Compare the time of a step of the host loop and of the compiled loop, without the time of the environment.

    python benchmarks/host_loop.py            # vrm, sac-mlp, sac-lstm, slac at Hopper's sizes

Both train the same agent on random observations of the same sizes, in turn. The environment measures the time of its
own steps, which is subtracted. Prints medians in milliseconds per step, and their ratio.
"""

import statistics
import time

import gymnasium
import jax
import numpy as np
import tyro
from gymnasium import spaces

from beliefrl import agents
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop, phases
from beliefrl.training.bench import Noise


class NoiseEnvironment(gymnasium.Env):
    """Random observations of a given size. `spent` is the time of all steps in seconds."""

    spent = 0.0

    def __init__(self, obs: int, actions: int):
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (actions,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.standard_normal(self.observation_space.shape), {}

    def step(self, action):
        before = time.perf_counter()
        obs = self.np_random.standard_normal(self.observation_space.shape)
        NoiseEnvironment.spent += time.perf_counter() - before
        return obs, float(np.mean(action)), False, False, {}


def main(
    names: tuple[str, ...] = ("vrm", "sac-mlp", "sac-lstm", "slac"),
    obs: int = 6,
    actions: int = 3,
    seeds: int = 1,
    rounds: int = 9,
) -> None:
    """Time the agents `names` with observations and actions of these sizes."""
    host_loop.keep_memory()  # as on the command line
    environment = GymnasiumTask(NoiseEnvironment, "noise", {"obs": obs, "actions": actions}, max_steps=1000)
    keys = jax.random.split(jax.random.key(0), seeds)
    print(f"{'agent':<10}{'compiled':>10}{'host':>10}{'ratio':>8}   ms/step without the environment; {seeds} seeds")
    for name in names:
        agent = agents.make(name)
        stretch = phases.stretch_length(agent)
        capacity = 4 * stretch * (rounds + 2)
        programs = (
            phases.compile_program(agent, Noise(obs, actions), capacity, 1),
            host_loop.program(agent, environment, capacity, 1, range(seeds), "never"),
        )
        state = [program.explore(program.begin(keys), 0, stretch)[0] for program in programs]
        times: tuple[list[float], list[float]] = ([], [])
        for number in range(rounds + 1):
            for index, program in enumerate(programs):
                NoiseEnvironment.spent, before = 0.0, time.perf_counter()
                first = stretch * (number + 1)
                state[index] = jax.block_until_ready(program.learn(state[index], first, stretch // agent.cycle)[0])
                seconds = time.perf_counter() - before - NoiseEnvironment.spent
                times[index].append(1e3 * seconds / stretch)
        compiled, host = (statistics.median(each[1:]) for each in times)  # the first compiles
        print(f"{name:<10}{compiled:>10.2f}{host:>10.2f}{host / compiled:>8.3f}", flush=True)
        programs[1].close()


if __name__ == "__main__":
    tyro.cli(main)
