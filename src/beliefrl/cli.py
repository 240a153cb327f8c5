"""The command line: parses, calls, prints. `beliefrl --help` shows the commands."""

import contextlib
import dataclasses
import difflib
import io
import json
import pathlib
import re
import sys
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NoReturn

import tyro

STARTED = time.time()

HELP = """usage: beliefrl COMMAND ...

Reinforcement learning for agents that do not see the whole state.

  beliefrl train AGENT TASK     train, with a live view, into a run's folder
  beliefrl evaluate RUN         play new episodes with what a run has learned
  beliefrl tasks                list the tasks
  beliefrl agents               list the agents
  beliefrl bench AGENT          time a training step on this machine, part by part
  beliefrl --version            print the version

for example

  beliefrl train vrm pendulum-v --steps 15000 --seeds 3 --out runs/first
  beliefrl evaluate runs/first --episodes 20
  beliefrl train vrm target-reaching --steps 60000 --gamma 0.98

COMMAND --help shows the options of a command; `beliefrl train AGENT --help` also the agent's hyperparameters,
with their defaults and where in the paper they stand.

A run's folder holds config.json, metrics/ (a line of JSON for every entry), tensorboard/, the trained agents,
results.json and curve.png. Mistakes end with one sentence and exit code 2.
"""


class UsageError(Exception):
    """A mistake on the command line, as a sentence."""


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """Play new episodes with what a run has learned, with sampled actions and with mode actions."""

    run: Annotated[tyro.conf.Positional[pathlib.Path], tyro.conf.arg(metavar="RUN")]
    """The run's folder."""
    episodes: int = 20
    """Episodes for each seed of the run and each mode."""
    seed: int = 0
    """Of these episodes: the same seed gives the same numbers."""
    json: bool = False
    """Print one JSON object: per mode the mean, S.E.M., every seed's mean, and success."""


@dataclasses.dataclass(frozen=True)
class ListOptions:
    """Print the names, one a line."""


def _agent_options(agent: Any, own: dict[str, Any]) -> type:
    """The options of a command on an agent: its own, (type, default) each, and the agent's hyperparameters."""
    fields = [(name, kind, dataclasses.field(default=default)) for name, (kind, default) in own.items()]
    hyperparameters = Annotated[type(agent), tyro.conf.arg(name="", help="Hyperparameters of the agent.")]
    fields.append(("agent", hyperparameters, dataclasses.field(default=agent)))
    return dataclasses.make_dataclass("Options", fields, frozen=True)


def train(argv: Sequence[str]) -> None:
    """`beliefrl train AGENT TASK ...`."""
    from rich.console import Console

    from beliefrl import agents, tasks
    from beliefrl.display import TrainingDisplay, results_table
    from beliefrl.train import Options
    from beliefrl.train import train as run_training

    name, rest = _agent_name(argv, "train", "TASK")
    options_type = _agent_options(
        agents.find(name),
        {
            "task": (
                Annotated[
                    tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK", help="`beliefrl tasks` lists them.")
                ],
                dataclasses.MISSING,
            ),
            "training": (Annotated[Options, tyro.conf.arg(name="", help="How long, how often.")], Options()),
            "out": (
                Annotated[
                    pathlib.Path | None,
                    tyro.conf.arg(help="The run's folder, which must not exist. None: runs/AGENT-TASK-1, or the next."),
                ],
                None,
            ),
        },
    )
    options = _parse(options_type, rest, f"beliefrl train {name}")
    task = tasks.make(options.task)
    console = Console()
    with TrainingDisplay(console, options.training.steps) as display:
        run = run_training(options.agent, task, options.out, display, **dataclasses.asdict(options.training))
    results = run.results() or {}
    title = f"{name} on {options.task} after {results['step']:,} steps"
    console.print(results_table(results, run.seeds, title))
    told = f"saved in {run.folder}: see curve.png; `beliefrl evaluate {run.folder}` plays more episodes"
    console.print(told, markup=False, highlight=False, soft_wrap=True)


def evaluate(argv: Sequence[str]) -> None:
    """`beliefrl evaluate RUN ...`."""
    options = _parse(EvaluateOptions, argv, "beliefrl evaluate")
    from rich.console import Console

    from beliefrl.display import results_table
    from beliefrl.evaluation import evaluate as play
    from beliefrl.runs import Run

    run = Run(options.run)
    results = play(run, options.episodes, options.seed)
    if options.json:
        print(json.dumps(results))
        return
    title = f"{run.config['agent']} on {run.config['task']}, {options.episodes} episodes a seed"
    Console().print(results_table(results, run.seeds, title))


def list_tasks(argv: Sequence[str]) -> None:
    """`beliefrl tasks`."""
    _parse(ListOptions, argv, "beliefrl tasks")
    from beliefrl import tasks

    _print_names(tasks.names())


def list_agents(argv: Sequence[str]) -> None:
    """`beliefrl agents`."""
    _parse(ListOptions, argv, "beliefrl agents")
    from beliefrl import agents

    _print_names(agents.names())


def bench(argv: Sequence[str]) -> None:
    """`beliefrl bench AGENT ...`."""
    from beliefrl import agents

    name, rest = _agent_name(argv, "bench")

    def option(kind: Any, default: Any, help: str) -> tuple[Any, Any]:
        return Annotated[kind, tyro.conf.arg(help=help)], default

    own = {
        "obs": option(int, 6, "Numbers in an observation; the default is velocities-only Hopper's."),
        "actions": option(int, 3, "Degrees of freedom; the default is Hopper's."),
        "seeds": option(int, 1, "Seeds trained side by side in one program."),
        "json": option(bool, False, "Print one JSON object."),
    }
    options = _parse(_agent_options(agents.find(name), own), rest, f"beliefrl bench {name}")
    from beliefrl.bench import bench as run_bench

    result = run_bench(options.agent, options.obs, options.actions, options.seeds, STARTED)
    if options.json:
        print(json.dumps(result))
        return
    for key, value in result.items():
        print(f"{key:<28}{value:,.3f}" if isinstance(value, float) else f"{key:<28}{value}")


COMMANDS: dict[str, Callable[[Sequence[str]], None]] = {
    "train": train,
    "evaluate": evaluate,
    "tasks": list_tasks,
    "agents": list_agents,
    "bench": bench,
}


def _print_names(names: dict[str, str]) -> None:
    width = max(map(len, names)) + 2
    for name, about in names.items():
        print(f"{name:<{width}}{about}")


def _agent_name(argv: Sequence[str], command: str, more: str = "") -> tuple[str, Sequence[str]]:
    """The agent's name and what follows it."""
    usage = f"beliefrl {command} AGENT {more}".rstrip()
    if argv and argv[0] in ("-h", "--help"):
        print(f"usage: {usage} ...\n")
        print(f"`beliefrl agents` lists the agents; name one to see its options: beliefrl {command} vrm --help")
        raise SystemExit(0)
    if not argv or argv[0].startswith("-"):
        raise UsageError(f"No agent is named: write {usage}; `beliefrl agents` lists them.")
    return argv[0], argv[1:]


def _parse(options: Any, argv: Sequence[str], prog: str) -> Any:
    """Options from the command line; a mistake becomes a sentence instead of tyro's box."""
    if any(arg in ("-h", "--help") for arg in argv):
        return tyro.cli(options, prog=prog, args=argv)
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box), contextlib.redirect_stdout(box):
            parsed, unknown = tyro.cli(options, prog=prog, args=argv, return_unknown_args=True)
    except SystemExit:
        raise UsageError(f"{_sentence(box.getvalue())}; `{prog} --help` shows what can be given.") from None
    if unknown:
        raise UsageError(_unknown(options, unknown[0], prog))
    return parsed


WORDING = (  # tyro's, Python's, and ours
    (r"Missing from .*: (\w+) .*", r"\1 is missing"),
    (r"Error parsing (\S+): invalid literal for int\(\) with base 10: (.*)", r"\1 must be a whole number, not \2"),
    (r"Error parsing (\S+): could not convert string to float: (.*)", r"\1 must be a number, not \2"),
    (r"Error parsing (\S+): .* \[(.*)\]", r"\1 cannot be \2"),
    (r"invalid choice (.*) for argument '(\S+)'. Expected one of \((.*)\)", r"\2 must be one of \3, not \1"),
    (r"Missing value for argument '(\S+)'.*", r"\1 needs a value"),
)


def _sentence(box: str) -> str:
    """The first paragraph below the title of a box that tyro drew, on one line and in our words."""
    lines = [line.strip(" │|╭╮╰╯─-") for line in box.splitlines()[1:]]  # rules become empty
    paragraphs = " ".join(line or "\n" for line in lines).split("\n")
    message = next(filter(str.strip, paragraphs), "That command line cannot be understood").strip().rstrip(".")
    for theirs, ours in WORDING:
        message = re.sub(f"^{theirs}$", ours, message)
    return message


def _unknown(options: Any, given: str, prog: str) -> str:
    """What to say of an argument that no option takes."""
    if not given.startswith("-"):
        return f"There is one argument too many, {given!r}: `{prog} --help` shows what can be given."
    names = [f"--{name.replace('_', '-')}" for name in _option_names(options)]
    near = difflib.get_close_matches(given.split("=")[0], names, n=1)
    hint = f"did you mean {near[0]}?" if near else f"`{prog} --help` shows them."
    return f"There is no option {given}: {hint}"


def _option_names(options: Any) -> list[str]:
    """Every field of a dataclass and of the dataclasses in it."""
    names = []
    for field in dataclasses.fields(options):
        kind = getattr(field.type, "__origin__", field.type)
        names += _option_names(kind) if dataclasses.is_dataclass(kind) else [field.name]
    return names


def _fail(message: str) -> NoReturn:
    print("beliefrl:", " ".join(message.split()), file=sys.stderr)
    raise SystemExit(2)


def main(argv: Sequence[str] | None = None) -> None:
    """The program `beliefrl`. Exits with 2 and one sentence where the user made a mistake."""
    argv = sys.argv[1:] if argv is None else argv
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return
    if argv[0] == "--version":
        from importlib.metadata import version

        print(version("beliefrl"))
        return
    if argv[0] not in COMMANDS:
        near = difflib.get_close_matches(argv[0], COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(COMMANDS)}."
        _fail(f"There is no command {argv[0]!r}: {hint}")

    from beliefrl.types import UserError

    try:
        COMMANDS[argv[0]](argv[1:])
    except (UsageError, UserError) as error:
        _fail(str(error))
    except KeyboardInterrupt:
        print("beliefrl: stopped; what was logged and saved stays in the run's folder.", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
    except Exception as error:
        if isinstance(error, MemoryError | OverflowError) or "out of memory" in str(error).lower():
            _fail("There is not enough memory for this: lower the sizes, the seeds, the episodes or the replay.")
        raise


if __name__ == "__main__":
    main()
