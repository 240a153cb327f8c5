"""Runs written by hand, to be read by what is drawn and told of them."""

import json

from beliefrl.runs import Run


def a_run(folder, seeds, agent="vrm", task="pendulum-v", steps=None, first=0, settings=None, updates=None, **config):
    """A run whose seeds have these evaluations: for each a list of (step, returns with sampled actions).

    `updates` are rows of every seed's learning: (step, {name: value}).
    """
    (folder / "metrics").mkdir(parents=True)
    last = max((rows[-1][0] for rows in seeds if rows), default=0)
    options = {"seed": first, "seeds": len(seeds), "steps": last if steps is None else steps}
    written = {
        "agent": agent,
        "hyperparameters": settings or {},
        "task": task,
        "constants": {},
        "options": options,
        **config,
    }
    (folder / "config.json").write_text(json.dumps(written))
    for seed, rows in enumerate(seeds, first):
        lines = [{"step": step, "kind": "update", **values} for step, values in updates or ()]
        lines += [{"step": step, "kind": "evaluation", "sampled": returns, "mode": [0.0]} for step, returns in rows]
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics" / f"seed-{seed}.jsonl").write_text(text)
    return Run(folder)


def flat(*returns):
    """Evaluations at 10, 20, ... steps with one episode each."""
    return [(10 * (index + 1), [value]) for index, value in enumerate(returns)]
