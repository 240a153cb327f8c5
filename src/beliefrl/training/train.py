"""`train` and `resume`: check the arguments and open the folder. `session` runs the training."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator
from typing import Any, Literal

from beliefrl import agents, tasks
from beliefrl.agents import Agent, hyperparameters
from beliefrl.errors import OfCallback, UserError
from beliefrl.runs.checkpoint import listed, was_ever_written
from beliefrl.runs.folder import free_folder
from beliefrl.runs.options import OPTION_NAMES, Options
from beliefrl.runs.recorder import Recorder
from beliefrl.runs.records import provenance
from beliefrl.runs.run import Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import checks, initial, initial_replay
from beliefrl.training.restore import agent_of, check_bits, check_interface, task_of
from beliefrl.training.schedule import Event, capacity
from beliefrl.training.session import Callback, Session


def train(
    agent: Agent | str,
    task: Task | GymnasiumTask | str | type,
    out: str | os.PathLike[str] | None = None,
    callback: Callback | None = None,
    own_process: bool = False,
    progress: bool = True,
    resume: bool = False,
    **options: Any,
) -> Run:
    """Train an agent on a task and record it in a folder.

    Args:
        agent: an agent, or the name of one with its default hyperparameters (`make_agent`).
        task: a task, the name of one, or a class of Gymnasium environments.
        out: the run's folder; None is runs/AGENT-TASK-1, or the next free number. It must not exist, unless it is empty
            or a training left it that ended before it saved an agent or a checkpoint. Such a folder is used again.
        callback: called with every Event when it happens. If it returns True, the training writes a checkpoint after
            its current block of about 100 steps and stops; `resume` continues. Any other value, such as None, changes
            nothing. (In Stable-Baselines3 a callback returns False to stop.) Urgent notes come from another thread.
            An exception of the callback ends the training. Saved files are kept.
        own_process: True says that this process only trains, and that it guards its main module (`if __name__ == ...`).
            Then processes="auto" may start processes, and training on a Gymnasium environment lets the C library keep
            freed memory. The command line sets it to True.
        progress: show the progress: live in a terminal, live with the learning curve in a notebook, elsewhere a line
            for each phase and each evaluation, and at least one per minute. False shows nothing.
        resume: continue the training in `out`, if there is one already. It must have been started with the same
            agent, task (with its time limit, if it had one) and options. `steps` may be larger. These may be different,
            and are then changed: stop_at, stop_patience, step_timeout, processes, checkpoint_steps,
            checkpoint_minutes, keep_checkpoints and track.
        options: the fields of `Options`: steps, seeds, seed, envs, overlap, share_env, eval_every,
            eval_episodes, stop_at, stop_patience, init_from, init_best, init_replay, replay_capacity, processes,
            step_timeout, checkpoint_steps, checkpoint_minutes, keep_checkpoints, precision, track. init_from may be a
            Run.

    Returns:
        The run: its results, its log, its files (`runs`). It is finished, unless the callback has stopped it.

    Raises:
        UserError: an unknown name or option, an impossible value, `out` exists (with `resume`: and was trained with
            other settings), a tracker cannot be opened, the disk is full, or a Gymnasium environment fails. Then
            everything until that step is saved, unless nothing was learned yet.
        Stopped: Ctrl-C, SIGTERM or SIGHUP, after a checkpoint is written; `resume` continues. It is a
            KeyboardInterrupt.
    """
    checks.callback(callback)
    check_bits()
    agent = agents.given(agent)
    made: Any = tasks.given(task)
    chosen = _chosen(options)
    _ = capacity(agent, chosen), made.spec  # raise before the folder is made
    checks.possible(chosen, made, own_process)
    config = {
        "agent": agents.name_of(agent),
        "hyperparameters": hyperparameters.of(agent),
        **tasks.describe(made),
        "options": dataclasses.asdict(chosen),
        **(_about_environment(made) if isinstance(made, GymnasiumTask) else {}),
        **provenance(),
    }
    if resume and out is not None and os.path.exists(os.path.join(out, "config.json")):  # noqa: PTH110, PTH118 - pathlib's raises where a name is too long
        run, own = Run(out), agent if agents.is_own(config["agent"]) else None
        checks.same(run, config, hyperparameters.values_before(agent))
        changes = {name: getattr(chosen, name) for name in checks.CHANGEABLE}
        return _go_on(run, changes, made, callback, own, own_process, progress)
    files = {}
    if chosen.init_from is not None:
        source = Run(chosen.init_from)
        files[initial.FILE], config["initial"] = initial.taken(source, chosen, agent, made.spec)
        if chosen.init_replay:
            seeds = initial.seeds_there(source, chosen)
            files[initial_replay.FILE], about = initial_replay.taken(source, chosen, agent, made, seeds)
            config["initial"] |= about
    recorder = Recorder(out or free_folder(f"{config['agent']}-{config['task']}"), config)
    with _reporting(recorder, callback, progress) as listen:
        return Session(recorder, agent, made, chosen, listen, own_process).run(files=files)


def resume(
    run: Run | str | os.PathLike[str],
    steps: int | None = None,
    task: Task | GymnasiumTask | type | None = None,
    callback: Callback | None = None,
    agent: Agent | type | None = None,
    own_process: bool = False,
    progress: bool = True,
    stop_at: float | Literal["same"] | None = "same",
    step_timeout: float | Literal["same"] | None = "same",
    stop_patience: int | None = None,
) -> Run:
    """Continue a training from its last checkpoint.

    On one machine and kind of device, metrics and networks are bit-identical to those of an uninterrupted training
    (measured on a CPU, not on a GPU). A Gymnasium environment cannot be saved, so a new episode begins. A training that
    was stopped before its first checkpoint starts again from step 0.

    Args:
        run: a run, or its folder.
        steps: the total number of environment steps; None: as many as before. It cannot be reduced.
        task: needed only if the run was trained on a task of your own: that task, or the class of its environments,
            which then have the time limit of the training.
        callback, own_process, progress: as in `train`.
        agent: needed only if an agent of your own was trained: its class, or an instance.
        stop_at: the option `stop_at` from now on; None: train for all steps; "same": as before. A training that has
            reached its `stop_at` is finished, and continues only with a higher one or None.
        step_timeout: the option `step_timeout` from now on; None: no limit; "same": as before.
        stop_patience: the option `stop_patience` from now on; None: as before.

    Raises:
        UserError: there is no such run, it has no undamaged checkpoint, another process trains it, `steps` is too
            small, or `task` is another one.
        Stopped: Ctrl-C, SIGTERM or SIGHUP, after a checkpoint is written.
    """
    checks.callback(callback)
    check_bits()
    limits = {"stop_at": stop_at, "step_timeout": step_timeout}
    numbers = {"steps": steps, "stop_patience": stop_patience}
    changes: dict[str, Any] = {name: value for name, value in limits.items() if value != "same"}
    changes |= {name: value for name, value in numbers.items() if value is not None}
    run = run if isinstance(run, Run) else Run(run)
    return _go_on(run, changes, task, callback, agent, own_process, progress)


def _about_environment(task: GymnasiumTask) -> dict[str, Any]:
    """What `load` needs to know of an environment that is not there."""
    return {"interface": task.interface._asdict(), "max_steps": task.spec.max_steps}


def _go_on(
    run: Run,
    changes: dict[str, Any],
    task: Any,
    callback: Callback | None,
    agent: Any,
    own_process: bool,
    progress: bool,
) -> Run:
    """Continue a training; `changes` are its new options. Nothing in the folder changes before `Session.run`."""
    folder, shown, made_by = run.folder, run.shown, agent_of(run, agent)
    if all(map(run.has_diverged, run.seeds)):  # another try would select the seeds that survive
        raise UserError(f"All seeds of {shown} have diverged: train with other settings, and with another --out.")
    begins_again = not was_ever_written(folder) and not run.is_complete(run.options)
    if not (begins_again or listed(folder)):
        raise UserError(f"{shown} has no usable checkpoint left: train again, with another --out.")
    _ = dataclasses.replace(_options(run), **changes)  # raise before the folder is locked
    with contextlib.ExitStack() as showing, contextlib.ExitStack() as stack:
        recorder = stack.enter_context(Recorder(folder, None))
        recorder.given = run.given
        made = task_of(recorder, task)
        if task is not None:
            checks.same_task(recorder, made)
        check_interface(run, made)
        before = _options(recorder)
        options = dataclasses.replace(before, **changes)
        if options.steps < before.steps:
            raise UserError(
                f"steps={options.steps} is impossible: {shown} trains for {before.steps}, and may only grow."
            )
        if options.stop_at is None and "stop_patience" not in changes:
            options = dataclasses.replace(options, stop_patience=1)
        checks.patience(options)
        checks.higher(recorder, options)
        _ = capacity(made_by, options)  # raise before the run's config changes
        checks.possible(options, made, own_process)
        amended: dict[str, Any] = {"options": dataclasses.asdict(options)}
        amended |= {"max_steps": made.spec.max_steps} if isinstance(made, GymnasiumTask) else {}  # it may be another
        recorder.amend(amended, provenance())
        listen = showing.enter_context(_reporting(recorder, callback, progress))
        training = Session(recorder, made_by, made, options, listen, own_process)
        stack.pop_all()
        return training.run(None if begins_again else training.restore, begins_again=begins_again)


@contextlib.contextmanager
def _reporting(run: Run, callback: Callback | None, progress: bool) -> Iterator[Callback]:
    """A function that calls the display (unless `progress` is False) and `callback`, and returns what this returns."""
    with contextlib.ExitStack() as stack:
        display: Callback | None = None
        if progress:
            from beliefrl.training.display import TrainingDisplay
            from beliefrl.training.screen import screen

            display = stack.enter_context(TrainingDisplay(screen(), run))

        def listen(event: Event) -> Any:
            if display is not None:
                display(event)
            try:
                return None if callback is None else callback(event)
            except OSError as error:
                raise OfCallback from error

        try:
            yield listen
        except OfCallback as error:
            raise error.__cause__ or error from None


def _chosen(options: dict[str, Any]) -> Options:
    """The options that were given by name."""
    for name in options:
        if name not in OPTION_NAMES:
            raise UserError(
                f"Training has no option {name!r}: it has {', '.join(OPTION_NAMES)}. Give hyperparameters to "
                "make_agent, and observe to make_task."
            )
    source = options.get("init_from")
    path = source.shown if isinstance(source, Run) else source
    chosen: dict[str, Any] = options | {"init_from": str(path) if isinstance(path, os.PathLike) else path}
    made = Options(**chosen)
    checks.patience(made)
    return made


def _options(run: Run) -> Options:
    """The options that a run was trained with. Raise a UserError if this version lacks one of them."""
    for name in run.config["options"]:
        if name not in OPTION_NAMES:
            raise UserError(f"{run.shown} was trained by another version: this one has no option {name!r}.")
    return run.options
