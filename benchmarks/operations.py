"""Where the time of a training step goes, by kind of operation.

Profiles the learning of an agent with JAX's profiler, at the sizes of velocities-only Hopper, and adds up the times of
XLA's operations. It reads the names that XLA gives to operations on a CPU. On one core the times add up to a step:

    taskset -c 0 python benchmarks/operations.py [AGENT ...]

The profiler itself makes a step longer, above all with many short operations.
"""

import collections
import tempfile
from pathlib import Path

import jax
import tyro
from jax.profiler import ProfileData

from beliefrl import agents
from beliefrl.training import phases
from beliefrl.training.bench import Noise
from beliefrl.training.rounds import stretch_length

KINDS = {  # the beginning of an operation's name, and its kind; the first that fits
    "ynn_fusion": "products",  # XLA's library of kernels
    "dot": "products",
    "copy": "copies",  # mostly to transpose a factor of a product
    "wrapped_copy": "copies",
    "transpose": "copies",
    "while": "",  # contains other operations
    "call": "",
    "conditional": "",
    "ThunkExecutor": "",
    "end": "",
}
COLUMNS = ("products", "copies", "other")


def kind(operation: str) -> str:
    """One of COLUMNS, or "" if the time of the operation is counted elsewhere."""
    return next((each for name, each in KINDS.items() if operation.startswith(name)), "other")


def operations(folder: str) -> collections.Counter[str]:
    """Seconds by kind in the profile that was written to `folder`."""
    seconds: collections.Counter[str] = collections.Counter()
    for file in Path(folder).rglob("*.xplane.pb"):
        for plane in ProfileData.from_file(str(file)).planes:
            for line in plane.lines:
                if "XLAEigen" in line.name:  # the threads that compute
                    for event in line.events:
                        seconds[kind(event.name)] += event.duration_ns / 1e9
    return seconds


def main(
    names: tyro.conf.Positional[tuple[str, ...]] = ("vrm", "predictive-sac", "sac-mlp", "sac-lstm", "slac"),
) -> None:
    """Print how the time of a training step of each agent is divided.

    Args:
        names: the agents.
    """
    print(f"{'agent':<16}{'ms/step':>10}" + "".join(f"{each:>12}" for each in COLUMNS))
    for name in names:
        agent = agents.make(name)
        stretch = stretch_length(agent)
        program = phases.compile_program(agent, Noise(6, 3), 125_000, 1)
        seeds, _ = program.explore(program.begin(jax.random.split(jax.random.key(0), 1)), 0, stretch)
        cycles = stretch // agent.cycle
        seeds = jax.block_until_ready(program.learn(seeds, stretch, cycles)[0])
        with tempfile.TemporaryDirectory() as folder:
            with jax.profiler.trace(folder):
                jax.block_until_ready(program.learn(seeds, 2 * stretch, cycles)[0])
            seconds = operations(folder)
        times = [1e3 * seconds[each] / stretch for each in COLUMNS]
        shares = "".join(f"{time / sum(times):>12.0%}" for time in times)
        print(f"{name:<16}{sum(times):>10.1f}{shares}", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
