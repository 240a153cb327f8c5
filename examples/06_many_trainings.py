"""Compare agents on several tasks and seeds: run a sweep, and write an interactive report.

    pip install -c constraints.txt -e .                 # in a clone of the repository
    python examples/06_many_trainings.py                # 12 seeds in total: 40 minutes on two cores
    python examples/06_many_trainings.py --quick        # 2 seeds, agents without memory: 67 s of CPU time, on two cores
    python examples/06_many_trainings.py --ray auto     # on a Ray cluster

Ctrl-C stops the sweep. The same command continues it; finished trainings are not repeated.
"""

import pathlib

import tyro

import beliefrl


def main(quick: bool = False, ray: str = "") -> None:
    """Train VRM and an agent without memory on two pendulums, one with hidden angle and one with hidden velocity."""
    tasks = ["pendulum-v", "pendulum-p"]
    if quick:
        out, short = pathlib.Path("runs/many-quick"), {"steps": 600, "step_start_rl": 300, "pretrain_updates": 100}
        experiments = beliefrl.grid(["sac-mlp"], tasks, seeds=1, **short)
    else:
        out, experiments = pathlib.Path("runs/many"), beliefrl.grid(["vrm", "sac-mlp"], tasks, seeds=3, steps=15_000)
    status = beliefrl.sweep(experiments, out, ray=ray or None)
    print(f"{len(status.finished)} trainings are finished")
    print(f"report: {beliefrl.write_report([out], out / 'report.html')}")


if __name__ == "__main__":
    tyro.cli(main)
