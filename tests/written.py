"""Folders of runs that are written by hand, as input for figures, tables and reports."""

import json

from beliefrl.runs.run import Run

EVIL = "</script><img src=x onerror=alert(1)>"
HOUR = {"started": "2026-01-01T10:00:00+00:00", "ended": "2026-01-01T11:00:00+00:00", "device": "cpu"}
TWO_SEEDS = [[(10, [1.0, 2.0]), (20, [3.0, 5.0])], [(10, [-1.0, 4.0]), (20, [7.0, 7.0])]]
ONE_UPDATE = [(1, {"loss": 0.0})]


def a_folder(
    folder, seeds, agent="vrm", task="pendulum-v", steps=20, first=0, diverged=(), updates=ONE_UPDATE, **config
):
    """A folder with these evaluations of each seed: (step, returns with sampled actions[, successes]).

    `updates` are rows of every seed's learning: (step, {name: value}).
    """
    (folder / "metrics").mkdir(parents=True)
    options = {"seed": first, "seeds": len(seeds), "steps": steps}
    whole = {"agent": agent, "hyperparameters": {}, "task": task, "constants": {}, "options": options} | config
    (folder / "config.json").write_text(json.dumps(whole))
    for seed, rows in enumerate(seeds, first):
        lines = [{"step": step, "kind": "update", **values} for step, values in updates]
        for step, returns, *success in rows:
            rates = {"sampled_success": success[0], "mode_success": [True]} if success else {}
            lines.append({"step": step, "kind": "evaluation", "sampled": returns, "mode": [7.0], **rates})
        if seed in diverged:
            lines.append({"step": lines[-1]["step"] + 5, "kind": "diverged", "why": "a loss is not finite"})
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics" / f"seed-{seed}.jsonl").write_text(text)
    return folder


def a_run(folder, seeds, steps=None, settings=None, updates=(), **rest):
    """The run in such a folder. It is finished, unless `steps` is higher than its last evaluation."""
    last = max((rows[-1][0] for rows in seeds if rows), default=1)
    steps = last if steps is None else steps
    return Run(a_folder(folder, seeds, steps=steps, hyperparameters=settings or {}, updates=updates, **rest))


def flat(*returns):
    """Evaluations at 10, 20, ... steps with one episode each."""
    return [(10 * (index + 1), [value]) for index, value in enumerate(returns)]


class Places:
    """The part of `sweeps.local.Local` that counts free slots, for fake trainings."""

    def __init__(self, folder, slots):
        self.folder, self.slots, self.running = folder, slots, {}

    @property
    def room(self):
        return len(self.slots) - len(self.running)
