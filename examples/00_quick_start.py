"""Train VRM on the pendulum, observing only the angular velocity, and evaluate the result.

    pip install -c constraints.txt -e .           # in a clone of the repository
    python examples/00_quick_start.py             # 15,000 steps, three seeds: 15 to 30 minutes on two cores
    python examples/00_quick_start.py --quick     # 600 steps, one seed, to see it run: 52 s of CPU time

The return of an episode is about -1200 for a random policy, and -150 if the pendulum is swung up and held. Each start
makes a new folder, runs/vrm-pendulum-v-1 and so on.
"""

import tyro

import beliefrl


def main(quick: bool = False) -> None:
    """Train three seeds side by side, and play new episodes with the trained agents."""
    if quick:
        agent = beliefrl.make_agent("vrm", models="keep", step_start_rl=300)  # without pre-training
        run = beliefrl.train(agent, "pendulum-v", steps=600)
    else:
        run = beliefrl.train("vrm", "pendulum-v", steps=15_000, seeds=3)

    results = beliefrl.evaluate(run, episodes=20)
    for mode in ("sampled", "mode"):
        print(f"return with {mode} actions: {results[mode]['mean']:.1f}, per seed {results[mode]['seeds']}")
    print(f"learning curve: {run.folder / 'curve.png'}")
    print(f"logs, one file of JSON lines per seed: {run.folder / 'metrics'}")


if __name__ == "__main__":
    tyro.cli(main)
