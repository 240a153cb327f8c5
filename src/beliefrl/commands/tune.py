"""`beliefrl tune`."""

import dataclasses
import pathlib
import shlex
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import tyro

from beliefrl import catalogue
from beliefrl.commands.arguments import named_values, parse, refuse_empty, value_lists
from beliefrl.errors import UserError

SHOWN = 5  # of the best trials
PICTURES = ("history.png", "importance.png")  # the second needs two complete trials with different objectives


@dataclasses.dataclass(frozen=True)
class TuneOptions:
    """Search for good hyperparameters of an agent on a task, with Optuna. Each trial is a training with other settings.
    It runs one trial per core or GPU at a time, and stops poor trials early. A stopped search continues with the same
    command. Needs the extra `tune`.
    """

    agent: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="AGENT")]
    """The agent's name, or MODULE:CLASS for an agent of your own."""
    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """The task's name."""
    trials: int = 40
    """Number of trials, with those that the folder already has."""
    seeds: int = 3
    """Seeds of each trial, side by side in one program. The objective is their mean."""
    seed: int = 0
    """Number of the first seed, and seed of the search."""
    steps: int | None = None
    """Environment steps of each seed. None: 20,000."""
    range: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=LOW..HIGH|A,B,C")] = ()
    """Ranges to try, for example lr_critic=1e-4..1e-2 or d_size=64,128. They replace or extend the agent's own. The
    scale is that of the agent's own range, or linear; LOW..HIGH:log and LOW..HIGH:horizon set it. horizon is
    logarithmic in 1 - value, as for gamma of vrm."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Hyperparameters to tune. None: all that have a range."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Fixed hyperparameters of the agent, training options, or faults of the sensors such as noise."""
    observe: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ENTRIES")] = ()
    """Entries of the observation that the agent sees, as in `beliefrl train`."""
    constants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """The task's constants, as in `beliefrl train`."""
    objective: Literal["last", "area"] = "last"
    """What is maximised, the mean return over the seeds: last, over the last 3 evaluations; area, over all evaluations
    (the area under the learning curve, divided by its length)."""
    actions: Literal["sampled", "mode"] = "sampled"
    """Maximise returns with sampled actions, or with the policy's mode."""
    prune: bool = True
    """Stop a trial if its best objective so far is below the median of the complete trials at the same evaluation. It
    begins after 5 complete trials and a quarter of the training."""
    out: pathlib.Path | None = None
    """The folder of the search and its runs. A search that is in it continues. None: runs/tune-AGENT-TASK."""
    workers: int | None = None
    """Maximum number of trials at a time. None: as many as there are cores (or GPUs)."""


def tune(argv: Sequence[str]) -> None:
    """`beliefrl tune AGENT TASK ...`."""
    options = parse(TuneOptions, argv, "beliefrl tune")
    refuse_empty(argv, "--range", "--only", "--set", "--observe", "--constants")
    catalogue.check_agent(options.agent)  # before JAX is imported
    from rich.console import Console

    from beliefrl.sweeps.tune import tune as search

    changed: dict[str, Any] = {
        "ranges": _ranges(options.range),
        "settings": _settings(options),
        "constants": named_values(options.constants, "--constants"),
    }
    same = {name: value for name, value in vars(options).items() if name not in ("range", "set", "steps")}
    tuned = search(**same | changed)
    console = Console()
    console.print(_table(tuned))
    for why, count in Counter(trial.why for trial in tuned.trials if trial.state == "failed").items():
        print(f"{count} failed: {why or 'stopped before the training began'}")
    folder = tuned.study.parent
    shows = f"`beliefrl report {shlex.quote(str(folder))} --unfinished` shows the trials"
    pictures = [name for name in PICTURES if (folder / name).exists()]
    print(f"{folder} has {' and '.join(pictures)}; {shows}")
    print("this trains the best settings with new seeds:\n")
    print(tuned.command)  # one line, to be copied


def _ranges(given: Sequence[str]) -> dict[str, Any]:
    """The ranges that --range gives."""
    from beliefrl.sweeps.ranges import from_text

    lists = value_lists(given, "--range").items()
    return {
        name: from_text(name, each.partition("=")[2]) or values
        for each, (name, values) in zip(given, lists, strict=True)
    }


def _settings(options: TuneOptions) -> dict[str, Any]:
    """The fixed settings of --set and --steps."""
    fixed = {}
    for name, values in value_lists(options.set, "--set").items():
        if len(values) > 1:
            raise UserError(f"--set {name} has several values: --range {name}=A,B,C tries them.")
        fixed[name] = values[0]
    return fixed if options.steps is None else fixed | {"steps": options.steps}


def _table(tuned: Any) -> Any:
    """The best trials."""
    from rich.table import Table
    from rich.text import Text

    states = [trial.state for trial in tuned.trials]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    table = Table(title=f"{len(states)} trials, {counts}", title_justify="left")
    for heading in ("trial", "objective", "settings"):
        table.add_column(heading, justify="right" if heading == "objective" else "left")
    for trial in tuned.trials[: states.count("complete")][:SHOWN]:
        settings = " ".join(f"{name}={value}" for name, value in trial.settings.items())
        table.add_row(trial.name, f"{trial.value:.1f}", Text(settings))
        table.add_section()
    return table
