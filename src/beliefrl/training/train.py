"""Train an agent and record it: the run's folder, its log and checkpoints; stopping and resuming.

`schedule.stages` trains and yields events; the code here records them.
"""

import contextlib
import dataclasses
import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl import agents, tasks
from beliefrl.agents import Agent, hyperparameters
from beliefrl.analysis.curves import draw_curve
from beliefrl.runs import trackers
from beliefrl.runs.checkpoint import Checkpoints, listed, was_ever_written
from beliefrl.runs.folder import free_folder
from beliefrl.runs.provenance import provenance
from beliefrl.runs.run import Recorder, Run
from beliefrl.tasks import Task
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import log
from beliefrl.training.compilation import keep_compiled
from beliefrl.training.evaluation import agent_of, as_argument, task_of, tuples
from beliefrl.training.phases import SeedState
from beliefrl.training.schedule import Event, Options, Phase, Snapshot, TrainingProgress, capacity, stages
from beliefrl.training.stop import Requests, Stopped
from beliefrl.types import UserError

Report = Callable[[Event], None]
RENAMED = {".actor.episode_return": ".actor.total"}  # arrays in checkpoints: the present name, the old one


def train(
    agent: Agent | str,
    task: Task | GymnasiumTask | str,
    out: str | os.PathLike[str] | None = None,
    report: Report | None = None,
    own_process: bool = False,
    **options: Any,
) -> Run:
    """Train an agent on a task and record it in a folder.

    Args:
        agent: an agent, or the name of one with its default hyperparameters (`make_agent`).
        task: a task, or the name of one.
        out: the run's folder; None is runs/AGENT-TASK-1, or the next free number. It must not exist, unless it is empty
            or a training left it that ended before it saved an agent or a checkpoint; then it is used again.
        report: called with every Event as it happens, to show progress. Urgent notes come from another thread.
        own_process: True says that this process only trains, and that it guards its main module (`if __name__ == ...`).
            Then processes="auto" may start processes, and training on a Gymnasium environment lets the C library keep
            freed memory. The command line says so.
        options: the fields of `Options`: steps, seeds, seed, eval_every, eval_episodes, replay_capacity, processes,
            checkpoint_steps, checkpoint_minutes, keep_checkpoints, precision, track.

    Returns:
        The finished run: its results, its log, its files (`runs`).

    Raises:
        UserError: an unknown name or option, an impossible value, `out` exists, a tracker cannot be opened, the disk is
            full, or a Gymnasium environment is faulty; then what was learned and logged until that step is saved.
        Stopped: Ctrl-C or SIGTERM, once a checkpoint is written; `resume` goes on. It is a KeyboardInterrupt.
    """
    agent = agents.make(agent) if isinstance(agent, str) else agent
    made: Any = tasks.make(task) if isinstance(task, str) else task
    known = [field.name for field in dataclasses.fields(Options)]
    for name in options:
        if name not in known:
            raise UserError(f"Training has no option {name!r}: it has {', '.join(known)}.")
    chosen = Options(**options)
    _ = capacity(agent, chosen), made.spec, trackers.check(chosen.track)  # raise before the folder is made
    config = {
        "agent": agents.name_of(agent),
        "hyperparameters": hyperparameters.of(agent),
        **tasks.describe(made),
        "options": dataclasses.asdict(chosen),
        **provenance(),
    }
    recorder = Recorder(out or free_folder(f"{config['agent']}-{config['task']}"), config)
    return _Training(recorder, agent, made, chosen, report, own_process).run()


def resume(
    run: Run | str | os.PathLike[str],
    steps: int | None = None,
    task: Task | GymnasiumTask | None = None,
    report: Report | None = None,
    agent: Agent | type | None = None,
    own_process: bool = False,
) -> Run:
    """Go on with a training from its last checkpoint.

    On one machine and kind of device, metrics and networks are bit-identical to those of an uninterrupted training
    (measured on CPU, not on a GPU). A Gymnasium environment cannot be saved: a new episode begins there. A training
    that was stopped before its first checkpoint begins again from step 0.

    Args:
        run: a run, or its folder.
        steps: train for so many environment steps in all; None: as many as before. They may only grow.
        task: needed only where the run was trained on a task of your own.
        report, own_process: as in `train`.
        agent: needed only where an agent of your own was trained: its class, or an instance.

    Raises:
        UserError: there is no such run, none of its checkpoints is good or left, another process trains it, or `steps`
            are too few.
        Stopped: Ctrl-C or SIGTERM, once a checkpoint is written.
    """
    run = run if isinstance(run, Run) else Run(run)
    folder, made_by = run.folder, agent_of(run, agent)
    begins_again = not was_ever_written(folder) and not (folder / "results.json").exists()
    if not (begins_again or listed(folder)):
        raise UserError(f"{folder} has no checkpoint to go on from any more: train again, with another --out.")
    with contextlib.ExitStack() as stack:
        recorder = stack.enter_context(Recorder(folder, None))
        made = task_of(recorder) if task is None else task
        before = _options(recorder)
        if steps is not None and steps < before["steps"]:
            raise UserError(f"steps={steps} is impossible: {folder} trains for {before['steps']}, and may only grow.")
        options = dataclasses.replace(Options(**before), **({} if steps is None else {"steps": steps}))
        trackers.check(options.track)
        recorder.amend({"options": dataclasses.asdict(options)}, provenance())
        training = _Training(recorder, made_by, made, options, report, own_process)
        if begins_again:
            training.begin_again()
        stack.pop_all()
    return training.run(None if begins_again else training.restore)


def _options(run: Run) -> dict[str, Any]:
    """The options that a run was trained with."""
    known = {field.name for field in dataclasses.fields(Options)}
    for name in run.config["options"]:
        if name not in known:
            raise UserError(f"{run.folder} was trained by another version: this one has no option {name!r}.")
    return {"steps": Options.steps} | tuples(run.config["options"])


class _Training:
    """One training while it runs."""

    def __init__(
        self,
        recorder: Recorder,
        agent: Agent,
        task: Any,
        options: Options,
        report: Report | None,
        own_process: bool,
    ):
        self.recorder, self.agent, self.task, self.options = recorder, agent, task, options
        self.own_process = own_process
        self.report = report or (lambda event: None)
        self.has_success = task.spec.has_success
        self.checkpoints = Checkpoints(recorder.folder, options.keep_checkpoints)
        self.last, self.saved_at = TrainingProgress(), time.monotonic()
        self.results = recorder.results()
        self.lost: set[int] = set()  # indices of the seeds that have diverged
        self.step = 0
        self.requests = Requests(partial(self._note, "stopping after this stretch; Ctrl-C again ends at once"))

    def run(self, restore: Callable[[SeedState], Snapshot] | None = None) -> Run:
        """Train to the end, or until a signal."""
        keep_compiled(self._note)
        try:
            with self.recorder, jax.default_matmul_precision(self.options.precision):
                self._train(restore)
        except BrokenPipeError:  # the reader of the output has closed it
            raise
        except OSError as error:
            raise UserError(
                f"{self.recorder.folder} cannot be written ({error.strerror}): fix that, then "
                f"`beliefrl resume {as_argument(self.recorder)}` goes on."
            ) from None
        return self.recorder

    def _train(self, restore: Callable[[SeedState], Snapshot] | None) -> None:
        try:
            with self.checkpoints, self.requests:
                for event in stages(self.agent, self.task, self.options, restore, self._note, self.own_process):
                    self._listen(event)
            self.recorder.finish(self.results or {})
            draw_curve(self.recorder)
        finally:
            self.recorder.note_end()

    def begin_again(self) -> None:
        """Clear the log and begin at step 0, for want of a checkpoint."""
        self.recorder.rewind(dict.fromkeys(self.recorder.seeds, 0))
        self._note("no checkpoint was written: begins again from step 0")

    def restore(self, shapes: SeedState) -> Snapshot:
        """Restore the last undamaged checkpoint, and truncate the log to its length at that time."""
        ring = shapes.replay
        like = shapes._replace(replay=ring._replace(moments=()))
        found = self.checkpoints.restore(like, ring.moments, RENAMED)
        for why in found.passed_over:
            self.report(Event(Phase.RESUMING, found.step, note=f"{why} The checkpoint before it is used."))
        self.recorder.rewind({int(seed): length for seed, length in found.progress["metrics"].items()})
        self.last, self.lost = TrainingProgress(*found.progress["progress"]), set(found.progress["lost"])
        self.report(Event(Phase.RESUMING, found.step, note=f"goes on from the checkpoint of step {found.step:,}"))
        if isinstance(self.task, GymnasiumTask):
            self.report(Event(Phase.RESUMING, found.step, note="a new episode begins: an environment cannot be saved"))
        seeds = found.tree._replace(replay=found.tree.replay._replace(moments=found.timesteps))
        return Snapshot(self.last, jax.tree.map(jnp.asarray, seeds))

    def _listen(self, event: Event) -> None:
        self.step = event.step
        self._look_for_divergence(event)
        if event.evaluation is not None and self.lost:
            event = event._replace(evaluation=log.without(event.evaluation, self.lost))
        if event.states is not None:
            event = event._replace(states=self.agent.networks(event.states))
        self.results = log.record(self.recorder, event, self.has_success, self.lost) or self.results
        self.report(event)
        if event.snapshot is not None:
            self._consider(event.snapshot)

    def _note(self, note: str) -> None:
        """Report a note at once, from any thread."""
        self.report(Event(Phase.TRAINING, self.step, note=note))

    def _look_for_divergence(self, event: Event) -> None:
        """Drop seeds whose losses or networks are no longer finite; the others go on."""
        losses = {
            name: event.metrics[name] for name in event.metrics if name.removeprefix("pretrain_") in self.agent.losses
        }
        for name, values in losses.items():
            self._lose(np.flatnonzero(~np.isfinite(values)), event, f"{name} is not finite")
        states = event.states
        if event.snapshot is not None and self._is_due(event.snapshot):
            states = event.snapshot.seeds.state
        if states is not None:
            self._lose(np.flatnonzero(~np.asarray(log.finite(states))), event, "its networks are not finite")

    def _lose(self, indices: np.ndarray, event: Event, why: str) -> None:
        for index in indices:
            if index in self.lost:
                continue
            seed = self.recorder.seeds[index]
            self.lost.add(int(index))
            self.recorder.log(seed, "diverged", event.step, {"why": why})
            kept = self.checkpoints.keep_for(f"seed-{seed}")
            where = f"its last good checkpoint stays in {kept}" if kept else "it had no checkpoint yet"
            note = f"seed {seed} diverged by step {event.step:,}: {why}; {where}."
            if len(self.lost) == len(self.recorder.seeds):
                raise UserError(f"All seeds have diverged; {note} Try smaller learning rates.")
            self.report(Event(event.phase, event.step, note=note))

    def _is_due(self, snapshot: Snapshot) -> bool:
        """Whether a checkpoint is due."""
        progress, options = snapshot.progress, self.options
        steps = progress.step - self.last.step >= options.checkpoint_steps > 0
        minutes = time.monotonic() - self.saved_at >= 60 * options.checkpoint_minutes > 0
        refreshed = progress.refreshed and not self.last.refreshed
        return bool(steps or minutes or refreshed or self._has_ended(progress) or self.requests.number)

    def _has_ended(self, progress: TrainingProgress) -> bool:
        return progress.step >= self.options.steps and progress.evaluated == progress.step

    def _consider(self, snapshot: Snapshot) -> None:
        """Write a checkpoint if one is due; stop if a signal asked for it."""
        if not self._is_due(snapshot):
            return
        progress, asked = snapshot.progress, self.requests.number
        if progress.refreshed and not self.last.refreshed:
            self.checkpoints.forget_timesteps()
        self._save(snapshot)
        if asked and not self._has_ended(progress):
            self.checkpoints.wait()
            run = as_argument(self.recorder)
            raise Stopped(f"stopped at step {progress.step:,}; `beliefrl resume {run}` goes on from there.", asked)

    def _save(self, snapshot: Snapshot) -> None:
        replay = snapshot.seeds.replay
        rest = snapshot.seeds._replace(replay=replay._replace(moments=()))
        lost = sorted(self.lost)
        progress = {"progress": list(snapshot.progress), "metrics": self.recorder.lengths(), "lost": lost}
        self.checkpoints.save(snapshot.progress.step, progress, rest, replay.moments, np.asarray(replay.added))
        self.last, self.saved_at = snapshot.progress, time.monotonic()
