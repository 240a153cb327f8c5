"""Train VRM on the pendulum with only its speed observed, and evaluate the result.

    pip install beliefrl
    python examples/00_quick_start.py                           # 15,000 steps, three seeds: 15 to 25 minutes
    python examples/00_quick_start.py --steps 300 --seeds 1     # a short test run

The return of an episode is about -1200 for a random policy, and -200 if the pendulum is swung up and held.
"""

import tyro

import beliefrl


def main(steps: int = 15_000, seeds: int = 3, out: str = "runs/quick-start") -> None:
    """Train for `steps` environment steps with `seeds` seeds side by side; the run's folder is `out`."""
    run = beliefrl.train("vrm", "pendulum-v", out, report=print_return, steps=steps, seeds=seeds)

    results = beliefrl.evaluate(run, episodes=20)
    for mode in ("sampled", "mode"):
        print(f"return with {mode} actions: {results[mode]['mean']:.1f}, per seed {results[mode]['seeds']}")
    print(f"learning curve: {run.folder / 'curve.png'}")
    print(f"logs, one file of JSON lines per seed: {run.folder / 'metrics'}")


def print_return(event: beliefrl.Event) -> None:
    """Called after each stage of the training, such as an evaluation."""
    if event.evaluation is not None:
        print(f"step {event.step}: return {event.evaluation.episode_return[:, 0].mean():.1f}")


if __name__ == "__main__":
    tyro.cli(main)
