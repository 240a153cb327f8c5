"""Compare agents on tasks over seeds: a sweep, its figure, and a page to hover.

    python examples/06_many_trainings.py                                # 12 seeds in all: 40 minutes on two cores
    python examples/06_many_trainings.py --steps 300 --seeds 1          # to see it run
    python examples/06_many_trainings.py --ray auto                     # on a Ray cluster

It can be stopped with Ctrl-C; the same command goes on, and what is finished is not done again.
"""

import pathlib

import tyro

import beliefrl


def main(steps: int = 15_000, seeds: int = 3, out: pathlib.Path = pathlib.Path("runs/many"), ray: str = "") -> None:
    """Train VRM, and an agent without memory, with `seeds` seeds on the pendulum that lacks a sensor."""
    experiments = beliefrl.grid(["vrm", "sac-mlp"], ["pendulum-v", "pendulum-p"], seeds=seeds, steps=steps)
    status = beliefrl.sweep(experiments, out, ray=ray or None, report=tell)
    print(f"{len(status.finished)} trainings are finished")
    print(f"the page: {beliefrl.write_report([out], out / 'report.html')}")


def tell(status: beliefrl.SweepStatus) -> None:
    """Called twice a second."""
    if status.running:
        print(f"\rrunning {', '.join(status.running)}; {len(status.waiting)} waiting", end="", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
