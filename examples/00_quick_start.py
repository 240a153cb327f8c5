"""Train predictive SAC on the pendulum, observing only the angular velocity, and evaluate the result.

    pip install -c constraints.txt -e .           # in a clone of the repository
    python examples/00_quick_start.py             # 6,000 steps, three seeds: one to two minutes on two cores
    python examples/00_quick_start.py --quick     # 1,200 steps, one seed, to see it run: 33 s of CPU time

The return of an episode is about -1200 for a random policy, and -150 if the pendulum is swung up and held. Each start
makes a new folder, runs/predictive-sac-pendulum-v-1 and so on. For the paper's agent, replace the name by "vrm" and the
number of steps by 15,000.
"""

import tyro

import beliefrl


def main(quick: bool = False) -> None:
    """Train seeds side by side, and play new episodes with the trained agents."""
    steps, seeds = (1_200, 1) if quick else (6_000, 3)
    run = beliefrl.train("predictive-sac", "pendulum-v", steps=steps, seeds=seeds)

    results = beliefrl.evaluate(run, episodes=20)
    for mode in ("sampled", "mode"):
        print(f"return with {mode} actions: {results[mode]['mean']:.1f}, per seed {results[mode]['seeds']}")
    print(f"learning curve: {run.folder / 'curve.png'}")
    print(f"logs, one file of JSON lines per seed: {run.folder / 'metrics'}")


if __name__ == "__main__":
    tyro.cli(main)
