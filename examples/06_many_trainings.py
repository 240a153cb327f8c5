"""Compare agents on several tasks and seeds: run a sweep, and write an interactive report.

    python examples/06_many_trainings.py                                # 12 seeds in total: 40 minutes on two cores
    python examples/06_many_trainings.py --steps 300 --seeds 1          # a short test run
    python examples/06_many_trainings.py --ray auto                     # on a Ray cluster

Ctrl-C stops the sweep. The same command continues it; finished trainings are not repeated.
"""

import pathlib

import tyro

import beliefrl


def main(steps: int = 15_000, seeds: int = 3, out: pathlib.Path = pathlib.Path("runs/many"), ray: str = "") -> None:
    """Train VRM and an agent without memory on two pendulums, one without positions, one without velocity."""
    experiments = beliefrl.grid(["vrm", "sac-mlp"], ["pendulum-v", "pendulum-p"], seeds=seeds, steps=steps)
    status = beliefrl.sweep(experiments, out, ray=ray or None, report=print_status)
    print(f"{len(status.finished)} trainings are finished")
    print(f"report: {beliefrl.write_report([out], out / 'report.html')}")


def print_status(status: beliefrl.SweepStatus) -> None:
    """Called twice a second."""
    if status.running:
        print(f"\rrunning {', '.join(status.running)}; {len(status.waiting)} waiting", end="", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
