"""Compare the throughput of one program on all cores with that of one program per core, as in a sweep.

    python benchmarks/cores.py [AGENT ...]

Prints for each agent the time of a training step (`beliefrl bench` at the sizes of velocities-only Pendulum): of one
program with all cores, and of one program per core at the same time. It also prints the ratio of the throughputs.
"""

import json
import os
import statistics
import subprocess
import sys

ROUNDS = 3
SIZES = ("--obs", "1", "--actions", "1", "--json")


def begin(core: str, agent: str, seeds: int = 1) -> subprocess.Popen[str]:
    """Start a benchmark in a process of its own, on one core, or on all of them (-)."""
    command = [sys.executable, "-m", "beliefrl.worker", core, "bench", agent, *SIZES, "--seeds", str(seeds)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def milliseconds(process: subprocess.Popen[str]) -> float:
    """The time of a training step of all the program's seeds."""
    out, _ = process.communicate()
    return json.loads(out.splitlines()[-1])["ms_per_step"]


def main(agents: list[str]) -> None:
    """Measure both ways in turn."""
    cores = [str(core) for core in sorted(os.sched_getaffinity(0))]
    for agent in agents:
        seeds = 2 if agent == "sac-mlp" else 1  # as in a sweep (`sweeps.plan.GAIN_SIDE_BY_SIDE`)
        ratios = []
        for _ in range(ROUNDS):
            alone = milliseconds(begin("-", agent))
            together = [milliseconds(process) for process in [begin(core, agent, seeds) for core in cores]]
            throughput = sum(alone * seeds / each for each in together)
            ratios.append(throughput)
            times = ", ".join(f"{each:.2f}" for each in together)
            print(f"{agent}: {alone:.2f} ms alone; {times} ms with one core each, {seeds} seeds each: {throughput:.2f}")
        print(f"{agent}: {statistics.median(ratios):.2f} times the throughput of one (median of {ROUNDS})")


if __name__ == "__main__":
    main(sys.argv[1:] or ["vrm", "sac-mlp", "sac-lstm", "slac"])
