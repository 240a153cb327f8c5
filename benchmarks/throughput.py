"""How fast trainings run: in both loops, with slow environments, with a program per core, with rounded products.

    python benchmarks/throughput.py host-loop          # the host loop and the compiled loop
    python benchmarks/throughput.py envs               # a slow Gymnasium environment, by the number of environments
    python benchmarks/throughput.py overlap            # a slow Gymnasium environment, with updates during its steps
    python benchmarks/throughput.py cores [AGENT ...]  # one program on all cores, and one per core
    python benchmarks/throughput.py precision [AGENT ...]  # products in float32 and in bfloat16
    python benchmarks/throughput.py burn-in            # vrm with shorter burn-ins

`--help` after one of these words describes what is measured, and its options.
"""

import json
import os
import statistics
import subprocess
import tempfile
import time
from functools import partial

import gymnasium
import jax
import numpy as np
import tyro
from gymnasium import spaces

from beliefrl import agents, train
from beliefrl.sweeps.places import worker
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import host_loop as loop
from beliefrl.training import phases
from beliefrl.training.bench import Noise
from beliefrl.training.lockstep import Lockstep
from beliefrl.training.rounds import stretch_length

NAMES = ("vrm", "predictive-sac", "sac-mlp", "sac-lstm", "slac")

# host-loop


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


def host_loop(
    names: tuple[str, ...] = NAMES,
    obs: int = 6,
    actions: int = 3,
    seeds: int = 1,
    rounds: int = 9,
    capacity: int = 125_000,
) -> None:
    """Compare the time of a step of the host loop and of the compiled loop, without the time of the environment.

    Both train the same agent on random observations of the same sizes, in turn. The environment measures the time of
    its own steps, which is subtracted. Prints medians in milliseconds per step, and their ratio.

    Args:
        names: the agents.
        obs: size of the observation.
        actions: size of the action.
        seeds: seeds that train at the same time.
        rounds: how often both are timed.
        capacity: timesteps that the replay has room for.
    """
    loop.keep_memory()  # as on the command line
    environment = GymnasiumTask(NoiseEnvironment, "noise", {"obs": obs, "actions": actions}, max_steps=1000)
    keys = jax.random.split(jax.random.key(0), seeds)
    print(f"{'agent':<16}{'compiled':>10}{'host':>10}{'ratio':>8}   ms/step without the environment; {seeds} seeds")
    for name in names:
        agent = agents.make(name)
        stretch = stretch_length(agent)
        programs = (
            phases.compile_program(agent, Noise(obs, actions), capacity, 1),
            loop.program(agent, environment, capacity, 1, range(seeds), partial(Lockstep, environment)),
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
        print(f"{name:<16}{compiled:>10.2f}{host:>10.2f}{host / compiled:>8.3f}", flush=True)
        programs[1].close()


# envs

EXPLORED = 800


class Waiting(gymnasium.Env):
    """An environment that waits in each step, as if for a simulator or a robot."""

    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        time.sleep(0.02)
        self.steps += 1
        return np.zeros(3, np.float32), 0.0, False, self.steps == 200, {}


def steps_per_second(number):
    """The rate between the first and the last report of the exploration."""
    agent, reports = agents.make("sac-mlp", step_start_rl=2 * EXPLORED), []

    def listen(event):
        if event.phase == "exploring":
            reports.append((time.monotonic(), event.step))

    options = {"steps": EXPLORED, "eval_every": 10 * EXPLORED, "eval_episodes": 1, "processes": "always", "track": ()}
    with tempfile.TemporaryDirectory() as folder:
        train(agent, GymnasiumTask(Waiting), f"{folder}/run", listen, envs=number, progress=False, **options)
    (began, first), *_, (ended, last), _ = reports
    return (last - first) / (ended - began)


def envs() -> None:
    """Steps per second with 1, 2, 4 and 8 environments (--envs) whose step sleeps for 20 ms.

    Each environment has a process of its own. The steps are those of the exploration, without updates.
    """
    for number in (1, 2, 4, 8):
        print(f"{number} environments: {steps_per_second(number):.1f} steps per second", flush=True)


# overlap


class SlowEnvironment(NoiseEnvironment):
    """Waits in each step, as if for a robot."""

    def __init__(self, obs: int, actions: int, wait: float):
        super().__init__(obs, actions)
        self.wait = wait

    def step(self, action):
        time.sleep(self.wait)
        return super().step(action)


def overlap(
    names: tuple[str, ...] = ("vrm", "predictive-sac", "sac-mlp"),
    waits: tuple[float, ...] = (0.0, 0.005, 0.02),
    rounds: int = 5,
) -> None:
    """Compare the time of a step with and without --overlap, in environments that wait in each step.

    Both train in turn, at the sizes of velocities-only Hopper. Prints medians in milliseconds per step, which include
    the time of the environment, and their ratio.

    Args:
        names: the agents.
        waits: the time of a step of the environment, in seconds.
        rounds: how often both are timed.
    """
    loop.keep_memory()  # as on the command line
    keys = jax.random.split(jax.random.key(0), 1)
    print(f"{'agent':<16}{'wait':>8}{'without':>10}{'with':>10}{'ratio':>8}   ms/step with the environment")
    for name in names:
        agent = agents.make(name)
        stretch = stretch_length(agent)
        for wait in waits:
            environment = GymnasiumTask(SlowEnvironment, "slow", {"obs": 6, "actions": 3, "wait": wait}, max_steps=1000)
            place = agent, environment, 125_000, 1, range(1), partial(Lockstep, environment)
            programs = [loop.program(*place, overlap=overlapping) for overlapping in (False, True)]
            states = [program.explore(program.begin(keys), 0, stretch)[0] for program in programs]
            times: tuple[list[float], list[float]] = ([], [])
            for number in range(rounds + 1):
                for index, program in enumerate(programs):
                    before, first = time.perf_counter(), stretch * (number + 1)
                    learned, _ = program.learn(states[index], first, stretch // agent.cycle)
                    states[index] = jax.block_until_ready(learned)
                    times[index].append(1e3 * (time.perf_counter() - before) / stretch)
            without, overlapped = (statistics.median(each[1:]) for each in times)  # the first compiles
            row = f"{1e3 * wait:>8.0f}{without:>10.2f}{overlapped:>10.2f}{overlapped / without:>8.3f}"
            print(f"{name:<16}{row}", flush=True)
            for program in programs:
                program.close()


# cores

REPEATED = 3
SIZES = ("--obs", "1", "--actions", "1", "--json")


def begin(core: str, agent: str, seeds: int = 1) -> subprocess.Popen[str]:
    """Start a benchmark in a process of its own, on one core, or on all of them (-)."""
    command = worker(core, ["bench", agent, *SIZES, "--seeds", str(seeds)])
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def milliseconds(process: subprocess.Popen[str]) -> float:
    """The time of a training step of all the program's seeds."""
    out, _ = process.communicate()
    return json.loads(out.splitlines()[-1])["ms_per_step"]


def cores(names: tyro.conf.Positional[tuple[str, ...]] = NAMES) -> None:
    """Compare the throughput of one program on all cores with that of one program per core, as in a sweep.

    Prints for each agent the time of a training step (`beliefrl bench` at the sizes of velocities-only Pendulum): of
    one program with all cores, and of one program per core at the same time; and the ratio of the throughputs.

    Args:
        names: the agents.
    """
    places = [str(core) for core in sorted(os.sched_getaffinity(0))]
    for agent in names:
        seeds = 2 if agent == "sac-mlp" else 1  # as in a sweep (`sweeps.plan.GAIN_SIDE_BY_SIDE`)
        ratios = []
        for _ in range(REPEATED):
            alone = milliseconds(begin("-", agent))
            together = [milliseconds(process) for process in [begin(core, agent, seeds) for core in places]]
            throughput = sum(alone * seeds / each for each in together)
            ratios.append(throughput)
            times = ", ".join(f"{each:.2f}" for each in together)
            print(f"{agent}: {alone:.2f} ms alone; {times} ms with one core each, {seeds} seeds each: {throughput:.2f}")
        print(f"{agent}: {statistics.median(ratios):.2f} times the throughput of one (median of {REPEATED})")


# precision, burn-in


def times_in_turn(trainings, rounds: int, seeds: int = 1) -> list[list[float]]:
    """Milliseconds per step (round, training) of trainings (agent, precision) that make their steps in turn."""
    keys = jax.random.split(jax.random.key(0), seeds)
    programs = {agent: phases.compile_program(agent, Noise(6, 3), 125_000, 1) for agent, _ in trainings}
    states, times = [], []
    for agent, _ in trainings:
        program, stretch = programs[agent], stretch_length(agent)
        states.append(program.explore(program.begin(keys), 0, stretch)[0])
    for number in range(rounds + 1):
        times.append([])
        for index, (agent, kind) in enumerate(trainings):
            stretch = stretch_length(agent)
            with jax.default_matmul_precision(kind):
                before, first = time.perf_counter(), stretch * (number + 1)
                learned, _ = programs[agent].learn(states[index], first, stretch // agent.cycle)
                states[index] = jax.block_until_ready(learned)
            times[-1].append(1e3 * (time.perf_counter() - before) / stretch)
    return times[1:]  # the first round compiles


def ratio(times: list[list[float]], index: int) -> float:
    """The median of the time of one training divided by that of the first one in the same round."""
    return statistics.median(each[index] / each[0] for each in times)


def precision(names: tyro.conf.Positional[tuple[str, ...]] = NAMES, seeds: int = 1, rounds: int = 9) -> None:
    """Compare the time of a training step with `--precision float32` and with `--precision bfloat16`.

    Both train in turn, at the sizes of velocities-only Hopper. Prints medians in milliseconds per step, and the median
    ratio of two times that were measured one after the other.

    Args:
        names: the agents.
        seeds: seeds that train at the same time.
        rounds: how often both are timed.
    """
    print(f"{'agent':<16}{'float32':>10}{'bfloat16':>10}{'ratio':>8}   ms/step; {seeds} seeds")
    for name in names:
        agent = agents.make(name)
        times = times_in_turn([(agent, "float32"), (agent, "bfloat16")], rounds, seeds)
        single, rounded = (statistics.median(each) for each in zip(*times, strict=True))
        print(f"{name:<16}{single:>10.2f}{rounded:>10.2f}{ratio(times, 1):>8.3f}", flush=True)


def burn_in(rounds: int = 9) -> None:
    """Compare the time of a training step of `vrm` with shorter burn-ins to that with the default settings.

    All train in turn, at the sizes of velocities-only Hopper. Prints medians in milliseconds per step, and the median
    ratio of two times of the same round.

    Args:
        rounds: how often each is timed.
    """
    default, short = agents.make("vrm"), agents.make("vrm", burn_in=16)
    stored = agents.make("vrm", burn_in=16, store_state=True)
    trainings = {
        "the defaults": (default, "float32"),
        "--burn-in 16": (short, "float32"),
        "--burn-in 16 --store-state": (stored, "float32"),
        "--burn-in 16 --store-state --precision bfloat16": (stored, "bfloat16"),
    }
    times = times_in_turn(list(trainings.values()), rounds)
    print(f"{'vrm':<50}{'ms/step':>8}{'ratio':>8}")
    for index, name in enumerate(trainings):
        median = statistics.median(each[index] for each in times)
        print(f"{name:<50}{median:>8.2f}{ratio(times, index):>8.3f}", flush=True)


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict(
        {
            "host-loop": host_loop,
            "envs": envs,
            "overlap": overlap,
            "cores": cores,
            "precision": precision,
            "burn-in": burn_in,
        }
    )
