"""The loop of a sweep: start waiting trainings, collect finished ones, and continue after a stop."""

import contextlib
import dataclasses
import functools
import os
import pathlib
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

from beliefrl import agents
from beliefrl.errors import OfCallback, UserError, cause, one_line, short
from beliefrl.runs.folder import locked
from beliefrl.runs.given_files import as_path
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.sweeps import places, sources
from beliefrl.sweeps import plan as plans
from beliefrl.sweeps.experiments import Experiment
from beliefrl.sweeps.plan import Training
from beliefrl.sweeps.progress import SweepDisplay, SweepStatus, take
from beliefrl.training.checks import CHANGEABLE
from beliefrl.training.stop import Requests, Stopped
from beliefrl.types import check_whole, plain

LOOK_EVERY = 0.5  # seconds
OF_A_RUN = ("seed", "seeds")  # the plan divides the seeds into runs
ALL = 10_000  # seeds in one run, more than any experiment has


@runtime_checkable
class Launcher(Protocol):
    """Where trainings run: this machine (`places.Local`) or a Ray cluster (`places.Cluster`)."""

    @property
    def room(self) -> int: ...
    @property
    def has_gpus(self) -> bool: ...
    def start(self, training: Training) -> None: ...
    def ended(self) -> dict[str, int]: ...
    def stop(self) -> None: ...


Report = Callable[[SweepStatus], Any]


def sweep(
    experiments: Sequence[Experiment],
    out: str | os.PathLike[str],
    workers: int | None = None,
    seeds_per_run: int | None = None,
    ray: str | None = None,
    report: Report | None = None,
    progress: bool = True,
) -> SweepStatus:
    """Run all trainings of some experiments, several at a time. If one fails, the others continue.

    Args:
        experiments: `beliefrl.grid(...)`, or a list of `beliefrl.Experiment`. Empty: continue the sweep in `out`.
        out: the sweep's folder. Finished trainings in it are not repeated, stopped ones continue.
        workers: most trainings at a time, one per core or GPU. None: as many as there are cores or GPUs. 0: one at a
            time, with all cores (on a Ray cluster: one at a time).
        seeds_per_run: most seeds side by side in one program. None: all on a GPU, the fastest number on a CPU.
        ray: address of the head of a Ray cluster (HOST:PORT, or "auto"). None: run on this machine.
        report: called twice a second with the state of the sweep.
        progress: show the running trainings and the time left: live in a terminal or a notebook, otherwise as lines.

    Raises:
        UserError: a name, setting or value is impossible (raised before any training starts); another process runs this
            sweep; or a training has failed (raised after all others have ended).
        Stopped: Ctrl-C, SIGTERM or SIGHUP, after every training has written a checkpoint. It is a KeyboardInterrupt.
    """
    if not isinstance(experiments, Sequence) or not all(isinstance(each, Experiment) for each in experiments):
        raise UserError("experiments must be a list of beliefrl.Experiment: beliefrl.grid makes one.")
    check_whole("workers", workers, 0, optional=True)
    check_whole("seeds_per_run", seeds_per_run, 1, optional=True)
    if ray is not None and not isinstance(ray, str):
        raise UserError(f"ray={short(ray)} is impossible: give HOST:PORT of the head, or auto.")
    folder = as_path(out)
    plans.plan(experiments)  # raise errors before a folder is made
    with writing(folder), lock(folder):
        before = sources.read(folder)
        _check_named(folder, before, experiments)
        slots = [] if ray else [places.Slot()] if workers == 0 else places.slots(workers)
        launcher = places.Cluster(folder, ray, workers) if ray else places.Local(folder, slots)
        try:
            together = seeds_per_run or (ALL if launcher.has_gpus else None)
            trainings = plans.extended(before, experiments, together)
            _check_options(folder, trainings)
            sources.write(folder, trainings)
            status = _status(folder, trainings)
            with reporting(folder, report, progress) as listen, Requests(confirm) as requests:
                of_sweep = folder, status, launcher
                step, stop = functools.partial(_step, *of_sweep), functools.partial(_stop, *of_sweep)
                loop(status, step, listen, requests, stop, LOOK_EVERY)
        finally:
            launcher.stop()  # also closes the connection to a Ray cluster
    if status.failed:
        name, error = next(iter(status.failed.items()))
        raise UserError(
            f"{len(status.failed)} of {status.count} trainings failed, such as {name} ({error.rstrip('.')}): fix the "
            f"cause and run the command again; {folder}/logs has the output of each."
        )
    return status


@contextlib.contextmanager
def writing(folder: pathlib.Path) -> Iterator[None]:
    """Raise a UserError in place of an OSError, such as that of a full disk; not in place of one of `report`."""
    try:
        yield
    except OfCallback as error:
        raise error.__cause__ or error from None
    except ConnectionError:  # also BrokenPipeError: the reader of the output has closed it
        raise
    except OSError as error:
        raise UserError(
            f"{folder} cannot be written ({cause(error)}): fix that, then the same command continues."
        ) from None


def confirm() -> None:
    """Answer a signal: it can take minutes until every training has stopped."""
    stops = "stopping: every training finishes its block of steps and writes a checkpoint"
    print(f"beliefrl: {stops}; Ctrl-C again ends only this command", file=sys.stderr, flush=True)


@contextlib.contextmanager
def reporting(folder: pathlib.Path, report: Report | None, progress: bool) -> Iterator[Report]:
    """Yields a function to call with every state of the sweep. It calls `report`, and the display if `progress`."""
    with contextlib.ExitStack() as stack:
        listeners: list[Report] = [] if report is None else [functools.partial(_call, report)]
        if progress:
            from beliefrl.training.screen import screen

            listeners.insert(0, stack.enter_context(SweepDisplay(screen(), folder)))
        yield lambda status: [listen(status) for listen in listeners]


def _call(report: Report, status: SweepStatus) -> None:
    try:
        report(status)
    except OSError as error:
        raise OfCallback from error


def _check_named(folder: pathlib.Path, before: Sequence[Training], experiments: Sequence[Experiment]) -> None:
    """Raise a UserError if only the sweep's folder names an agent of the user: such an agent is not imported."""
    named = {experiment.agent for experiment in experiments}
    for training in before:
        if agents.is_own(training.agent) and training.agent not in named:
            shown = one_line(training.agent)
            raise UserError(f"{folder} trains {shown}: name that agent again, with --agents {shown} and its --tasks.")


def _check_options(folder: pathlib.Path, trainings: Sequence[Training]) -> None:
    """Raise a UserError if a training has begun with other options, except those that may change."""
    for training in trainings:
        try:
            run = Run(folder / training.name)
        except UserError:  # not begun, or damaged, which the training will say
            continue
        there = dataclasses.asdict(Options()) | run.config["options"]
        for name, value in dataclasses.asdict(plans.options_of(training)).items():
            if name not in (*CHANGEABLE, *OF_A_RUN) and plain(there[name]) != plain(value):
                raise UserError(
                    f"{run.shown} was trained with {name}={there[name]}, not {value}: give that value, or choose "
                    "another --out, in Python out=."
                )


def _status(folder: pathlib.Path, trainings: Sequence[Training]) -> SweepStatus:
    """The state of a sweep with these trainings."""
    finished = [training for training in trainings if training.is_finished(folder)]
    return SweepStatus(finished, [training for training in trainings if training not in finished])


def loop(
    status: SweepStatus,
    step: Callable[[], None],
    report: Report,
    requests: Requests,
    stop: Callable[[], str],
    every: float,
) -> None:
    """Call `step` and `report` every `every` seconds, until no training waits or runs.

    At a signal, `stop` stops the trainings and returns the sentence of the Stopped that is raised.
    """
    while True:
        step()
        report(status)
        if requests.number:
            raise Stopped(stop(), requests.number)
        if not (status.waiting or status.running):
            return
        time.sleep(every)


def _step(folder: pathlib.Path, status: SweepStatus, launcher: Launcher) -> None:
    """Start what there is room for, and collect what has ended."""
    while launcher.room > 0 and (training := take(status, folder)):
        launcher.start(training)
        status.running[training.name] = training
    for name, code in launcher.ended().items():
        training = status.running.pop(name)
        if code == 0:
            status.finished.append(training)
        else:
            status.failed[name] = reason(folder / "logs" / f"{name}.log", code)


def _stop(folder: pathlib.Path, status: SweepStatus, launcher: Launcher) -> str:
    launcher.stop()
    finished = status.finished + [each for each in status.running.values() if each.is_finished(folder)]
    done = f"{len(finished)} of {status.count}"  # some finish while they are asked to stop
    go_on = f"`beliefrl sweep --out {shlex.quote(str(folder))}` continues."
    return f"stopped with {done} trainings finished; {go_on}"


def reason(log: pathlib.Path, code: int) -> str:
    """Why a training failed: its last error message, a signal, or the last line of its output, in this session."""
    _, _, output = log.read_text(errors="replace").rpartition(places.BEGIN)
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    messages = [line.removeprefix("beliefrl: ") for line in lines if line.startswith("beliefrl: ")]
    if code < 0 and not messages:
        names = {each.value: each.name for each in signal.Signals}
        advice = " (often too little memory: give fewer --workers)" if -code == signal.SIGKILL else ""
        return f"it was killed by {names.get(-code, f'signal {-code}')}{advice}"
    return (messages or lines or [f"it ended with code {code} and printed nothing"])[-1]


def lock(folder: pathlib.Path) -> Any:
    """Make the folder of a sweep, and lock it against other processes.

    Raises:
        UserError: it cannot be made, or another process uses it.
    """
    try:
        (folder / "logs").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"The folder {folder} cannot be made ({cause(error)}): choose another --out.") from None
    return locked(folder, "is in use")
