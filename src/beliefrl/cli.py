"""The command line: finds the command, shows help, and turns errors into exit codes."""

import contextlib
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from beliefrl.commands import COMMANDS, find
from beliefrl.errors import UserError, one_line

HELP = """usage: beliefrl COMMAND ...

Reinforcement learning under partial observability: the agent observes only a part of the state.

  beliefrl demo [TASK]          watch a small trained agent that comes with the package
  beliefrl check TASK           a task's observations, actions and rewards, and whether you can train on it
  beliefrl train AGENT TASK     train, with a live view, into a run's folder
  beliefrl resume RUN           continue a training that was stopped or killed, or train it longer
  beliefrl sweep --preset NAME  many trainings: agents x tasks x settings x seeds, on all cores or a Ray cluster
  beliefrl tune AGENT TASK      search for good hyperparameters with Optuna, in many trainings
  beliefrl figure KIND RUNS     the paper's figures and tables from finished runs: curves, ablation, elbo, ...
  beliefrl show RUN             the settings, progress and results of a run
  beliefrl evaluate RUN         play new episodes with the trained agent of a run
  beliefrl export RUN FILE      write the trained policy to one file, for jax or (.onnx) for onnxruntime
  beliefrl report RUNS          one page for the browser: curves, final returns, settings, time
  beliefrl predict RUN          draw its model's predictions of an episode, open loop and closed loop, and the truth
  beliefrl video RUN FILE       record episodes, as mp4 or gif
  beliefrl film RUN ...         draw a film strip of an episode, a row for each run
  beliefrl tasks                list the tasks
  beliefrl agents               list the agents
  beliefrl bench AGENT          time a training step on this machine, part by part; `all` compares the agents
  beliefrl --version            print the version

for example

  beliefrl train predictive-sac pendulum-v --steps 15000 --seeds 3 --out runs/pendulum
  beliefrl evaluate runs/pendulum --episodes 20
  beliefrl train vrm target-reaching --steps 60000 --gamma 0.98
  beliefrl train predictive-sac gym:MountainCarContinuous-v0 --observe 0 --seeds 2
  beliefrl train my_module:MyAgent pendulum-p

COMMAND --help shows the options of a command; `beliefrl train AGENT --help` also the agent's hyperparameters,
with their defaults and where the paper gives them (table or appendix). AGENT is a name that `beliefrl agents` lists, or
MODULE:CLASS, an agent of your own in this folder or on the Python path. Commands that read its runs need --agent
MODULE:CLASS.

A run's folder contains config.json, metrics/ (a line of JSON for every entry), tensorboard/, checkpoints/, the trained
agents, results.json and curve.png. Ctrl-C writes a checkpoint first. A mistake ends the command with an error message
and exit code 2.
"""


def _say(message: str) -> None:
    with contextlib.suppress(BrokenPipeError):  # the exit code tells, too
        print("beliefrl:", message, file=sys.stderr)


def _fail(message: str) -> NoReturn:
    _say(message)
    raise SystemExit(2)


def main(argv: Sequence[str] | None = None) -> None:
    """The program `beliefrl`. Exits with 2 and one sentence on a UserError."""
    try:
        _run(sys.argv[1:] if argv is None else argv)
    except BrokenPipeError:  # the reader of the output has closed it
        raise SystemExit(0) from None
    finally:
        _flush()


def _flush() -> None:
    """Write what is buffered, or drop it if its reader has closed the pipe: Python would complain when it ends."""
    if sys.stdout is None or sys.stdout.closed:
        return
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(argv: Sequence[str]) -> None:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(HELP, end="")
        return
    if argv[0] == "--version":
        from importlib.metadata import version

        print(version("beliefrl"))
        return
    if argv[0] not in COMMANDS:
        import difflib

        near = difflib.get_close_matches(argv[0], COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there is {', '.join(COMMANDS)}."
        _fail(f"There is no command {argv[0]!r}: {hint}")

    if "" not in sys.path:
        sys.path.insert(0, "")  # as `python -m` does: finds my_module:MyAgent and gym:my_module:MyEnv-v0 here
    try:
        find(argv[0])(argv[1:])
    except UserError as error:
        _fail(one_line(str(error)))
    except KeyboardInterrupt as stopped:
        _say(str(stopped) or "stopped; what was logged and saved until now is kept.")
        raise SystemExit(getattr(stopped, "exit_code", 130)) from None
    except Exception as error:
        if isinstance(error, MemoryError | OverflowError) or "out of memory" in str(error).lower():
            _fail("There is not enough memory for this: lower the sizes, the seeds, the episodes or the replay.")
        raise


if __name__ == "__main__":
    main()
