"""Train VRM on the pendulum that is seen by its speed only, and look at what came of it.

    pip install beliefrl
    python examples/00_quick_start.py                           # 15,000 steps, three seeds: 15 to 25 minutes
    python examples/00_quick_start.py --steps 300 --seeds 1     # to see it run

Random play gets a return of about -1200 an episode; -200 is a pendulum that is swung up and held.
"""

import tyro

import beliefrl


def main(steps: int = 15_000, seeds: int = 3, out: str = "runs/quick-start") -> None:
    """Train for `steps` environment steps with `seeds` seeds side by side; the run is left in `out`."""
    run = beliefrl.train("vrm", "pendulum-v", out, report=tell, steps=steps, seeds=seeds)

    results = beliefrl.evaluate(run, episodes=20)
    for mode in ("sampled", "mode"):
        print(f"return with {mode} actions: {results[mode]['mean']:.1f}, of each seed {results[mode]['seeds']}")
    print(
        f"the curve: {run.folder / 'curve.png'}; the log of a seed, a line of JSON an entry: {run.folder / 'metrics'}"
    )


def tell(event: beliefrl.Event) -> None:
    """Called whenever something has happened in the training."""
    if event.evaluation is not None:
        print(f"step {event.step}: return {event.evaluation.episode_return[:, 0].mean():.1f}")


if __name__ == "__main__":
    tyro.cli(main)
