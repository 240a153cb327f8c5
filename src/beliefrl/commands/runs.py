"""Commands on a run: `beliefrl show`, `evaluate` and `export`."""

import contextlib
import dataclasses
import json
import pathlib
import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from beliefrl.commands.arguments import (
    Best,
    OwnAgent,
    RunFolder,
    Seed,
    named_values,
    own_agent,
    parse,
    refuse_empty,
)
from beliefrl.errors import UserError, one_line

if TYPE_CHECKING:
    from beliefrl.runs.run import Run


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Evaluate a run's trained agent in new episodes, with sampled actions and with mode actions."""

    run: RunFolder
    episodes: int = 20
    """Number of episodes for each of the run's seeds and each kind of actions (sampled, mode)."""
    seed: int = 0
    """Random seed of the episodes. The same seed gives the same results."""
    json: bool = False
    """Print one JSON object: for each kind of actions the mean, S.E.M., mean of each seed, success rates, and the
    return and length of each episode."""
    constants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Constants of the task that differ from those of the training."""
    faults: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Faults of the sensors that differ from those of the training, such as noise=0.1."""
    best: Best = False
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write a run's policy to one file that runs without this library (`beliefrl.Policy.export`)."""

    run: RunFolder
    file: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="FILE")]
    """The file to write. NAME.onnx is an ONNX model (needs the extra `onnx`); any other name is for jax.export."""
    seed: Seed = None
    best: Best = False
    overwrite: bool = False
    """Replace an existing file."""
    agent: OwnAgent = None


@dataclasses.dataclass(frozen=True)
class ShowOptions:
    """Show the settings, the progress and the results of a run."""

    run: RunFolder


def show(argv: Sequence[str]) -> None:
    """`beliefrl show RUN`."""
    options = parse(ShowOptions, argv, "beliefrl show")
    from rich.console import Console

    from beliefrl.agents import is_own
    from beliefrl.analysis.groups import last_step
    from beliefrl.runs.run import Run
    from beliefrl.training.display import results_table, run_table
    from beliefrl.training.restore import agent_of

    run, console = Run(options.run), Console()
    agent, notes = None, [f"damaged: {sentence}" for sentence in run.damage()]
    if not is_own(run.config["agent"]):  # a user's own class is not needed
        try:
            agent = agent_of(run)
        except UserError as error:  # of another version, or of a package that is not installed
            notes.append(str(error))
    table, results = run_table(run, agent), run.results()
    console.print(table)
    last = max(last_step(run, seed) for seed in run.seeds)
    if last > ((results or {}).get("step") or 0):  # it still trains, or was killed
        command = f"`beliefrl figure table {shlex.quote(run.shown)} --unfinished`"
        notes.append(f"the log has an evaluation of step {last:,} that is not in results.json: {command} shows it")
    if results:
        console.print(results_table(results, run.seeds, f"after {results['step']:,} steps"))
    for note in notes:
        console.print(one_line(note), markup=False, highlight=False, soft_wrap=True)


def evaluate(argv: Sequence[str]) -> None:
    """`beliefrl evaluate RUN ...`."""
    options = parse(EvaluateOptions, argv, "beliefrl evaluate")
    refuse_empty(argv, "--constants", "--faults")
    from rich.console import Console

    from beliefrl.runs.run import Run
    from beliefrl.training.display import results_table
    from beliefrl.training.evaluation import evaluate as play

    run = Run(options.run)
    agent, shown, task = own_agent(options.agent), not options.json, _changed_task(run, options)
    elsewhere = contextlib.redirect_stdout(sys.stderr) if options.json else contextlib.nullcontext()
    with elsewhere:  # what an environment prints
        results = play(
            run, options.episodes, options.seed, task, agent, progress=shown, best=options.best, own_process=True
        )
    if options.json:
        print(json.dumps(json.loads(json.dumps(results), parse_constant=lambda _: None)))  # null for a diverged seed
        return
    which = ", best agents" if options.best else ""
    which += "".join(f", {change}" for change in (*options.constants, *options.faults))
    title = f"{run.config['agent']} on {run.config['task']}, {options.episodes} episodes per seed{which}"
    Console().print(results_table(results, run.seeds, title))
    for seed in run.seeds:
        for row in run.rows(seed, "diverged"):
            known = results["sampled"]["seeds"][run.seeds.index(seed)] is not None
            whose = "its agent is from an evaluation before that" if known else "it has no agent"
            print(f"seed {seed} diverged by step {row['step']:,}: {whose}")


def _changed_task(run: "Run", options: EvaluateOptions) -> Any:
    """The run's task with the constants and faults of the options; None if there are none."""
    from beliefrl import tasks
    from beliefrl.training.restore import task_of
    from beliefrl.types import tuples

    if not options.constants and not options.faults:
        return None
    task_of(run)  # raises the error of a run that has no registered task
    there, constants = run.config, named_values(options.constants, "--constants")
    faults = (there.get("faults") or {}) | named_values(options.faults, "--faults")
    constants = tuples(there["constants"] | constants)
    return tasks.make(there["task"], there.get("observe"), faults or None, **constants)


def export(argv: Sequence[str]) -> None:
    """`beliefrl export RUN FILE ...`."""
    options = parse(ExportOptions, argv, "beliefrl export")
    from beliefrl.policy import load

    policy = load(options.run, options.seed, agent=own_agent(options.agent), best=options.best)
    difference = policy.export(options.file, options.overwrite)
    if difference is None:
        print(f"written to {options.file}: jax.export.deserialize reads it")
    else:
        print(f"written to {options.file}: onnxruntime reads it")
        print(f"largest difference from the policy: {difference:.1g}")
