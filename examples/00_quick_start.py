"""Train VRM on the pendulum with only its speed observed, and evaluate the result.

    pip install beliefrl
    python examples/00_quick_start.py             # 15,000 steps, three seeds: 15 to 25 minutes on two cores
    python examples/00_quick_start.py --quick     # 600 steps, one seed, to see it run: 52 s of CPU time

The return of an episode is about -1200 for a random policy, and -200 if the pendulum is swung up and held. Each start
makes a new folder, runs/vrm-pendulum-v-1 and so on.
"""

import tyro

import beliefrl


def main(quick: bool = False) -> None:
    """Train three seeds side by side, and play new episodes with what they have learned."""
    if quick:
        agent = beliefrl.make_agent("vrm", models="keep", step_start_rl=300)  # without the model that is pre-trained
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
