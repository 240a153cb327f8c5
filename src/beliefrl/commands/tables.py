"""Tables that the commands print."""

import dataclasses
from typing import Any

from rich.table import Table
from rich.text import Text

from beliefrl.runs.best import evaluations
from beliefrl.runs.checkpoint import listed
from beliefrl.runs.run import Run
from beliefrl.training.screen import duration


def run_table(run: Run, agent: Any) -> Table:
    """The settings of a run, and its progress. Without an agent all of its settings are shown."""
    table = Table(title=Text(str(run.folder)), title_justify="left", show_header=False)

    def add(name: str, value: str) -> None:
        table.add_row(name, Text(value))  # without markup: it may contain brackets

    config = run.config
    own = {} if agent is None else {field.name: field.default for field in dataclasses.fields(agent)}
    changed = [f"{name}={value}" for name, value in config["hyperparameters"].items() if _differs(value, own.get(name))]
    constants = [f"{name}={value}" for name, value in config["constants"].items()]
    observed = [] if config.get("observe") is None else [f"observe={' '.join(map(str, config['observe']))}"]
    faults = [f"{name}={value}" for name, value in config.get("faults", {}).items()]
    steps = [max((row["step"] for row in run.rows(seed) if row["kind"] != "pretrain"), default=0) for seed in run.seeds]
    add("agent", config["agent"])
    add("settings", ", ".join(changed) or "the agent's defaults")
    add("task", " ".join([config["task"], *constants, *observed, *faults]))
    add("seeds", ", ".join(map(str, run.seeds)))
    add("steps", f"{max(steps):,} of {run.options.steps:,}")
    for seed in run.seeds:
        for entry in run.rows(seed, "diverged"):
            add("diverged", f"seed {seed} by step {entry['step']:,}: {entry.get('why', '?')}")
    if config.get("initial"):
        add("initial networks", _origin(config["initial"]))
    for seed, found in zip(run.seeds, evaluations(run.folder, len(run.seeds)), strict=True):
        if found is not None:
            add("best agent", f"seed {seed} at step {found['step']:,}: return {found['return']:.1f} sampled")
    add("checkpoints", ", ".join(path.name for path in listed(run.folder)) or "none")
    for index, session in enumerate([config, *config.get("resumed", ())]):
        began = f"{session.get('started', '?')} to {session.get('ended', '?')}, {session.get('device', '?')}"
        versions = " ".join(f"{name} {version}" for name, version in session.get("versions", {}).items())
        table.add_section()
        add("resumed" if index else "started", began)
        add("command", " ".join(map(str, session.get("command", ()))))
        add("commit", str(session.get("git_commit")))
        add("versions", versions)
    return table


def _origin(initial: dict[str, Any]) -> str:
    """Where the initial networks of a run come from."""
    which = "best" if initial.get("best") else "last"
    source = f"{initial.get('run')} ({initial.get('agent')} on {initial.get('task')})"
    return f"{which} agent of {source}, commit {initial.get('git_commit')}"


def _differs(value: Any, default: Any) -> bool:
    return value != (list(default) if isinstance(default, tuple) else default)


def scalability_table(results: dict[str, dict[str, Any]], obs: int, actions: int) -> Table:
    """The cost of each agent: the paper's scalability table (Appendix G), measured on this machine."""
    table = Table(title=f"{obs} observations, {actions} actions", title_justify="left")
    for heading in ("agent", "ms a step", "100,000 steps", "parameters", "share of matrix peak"):
        table.add_column(heading, justify="left" if heading == "agent" else "right")
    for name, result in results.items():
        milliseconds, share = result["ms_per_step"], result["share_of_peak"]
        numbers = (f"{milliseconds:.1f}", duration(100 * milliseconds), f"{result['parameters']:,}", f"{share:.0%}")
        table.add_row(name, *numbers)
    return table
