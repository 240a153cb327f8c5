"""A training while it runs: its log, its checkpoints, seeds that diverge, and reasons to end before the last step.

A signal or the user's callback stops it, and it can be resumed. With the option `stop_at` it is finished when the
returns are high enough.

`schedule.stages` trains and yields events; the code here records them.
"""

import contextlib
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.agents import Agent
from beliefrl.analysis.figures import draw_curve
from beliefrl.errors import Fault, UserError, cause
from beliefrl.runs.checkpoint import Checkpoints
from beliefrl.runs.folder import set_aside
from beliefrl.runs.options import Options
from beliefrl.runs.recorder import Recorder
from beliefrl.runs.run import Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import initial, log
from beliefrl.training import replay as ring
from beliefrl.training.compilation import keep_compiled
from beliefrl.training.phases import SeedState
from beliefrl.training.restore import as_argument
from beliefrl.training.schedule import Event, Phase, Snapshot, TrainingProgress, stages
from beliefrl.training.stop import Requests, Stopped

Callback = Callable[[Event], Any]  # returns True to stop the training
RENAMED = {".actor.episode_return": ".actor.total"}  # arrays in checkpoints: the present name, the old one


class Session:
    """One training while it runs."""

    def __init__(
        self,
        recorder: Recorder,
        agent: Agent,
        task: Any,
        options: Options,
        callback: Callback,
        own_process: bool,
    ):
        self.recorder, self.agent, self.task, self.options = recorder, agent, task, options
        self.own_process = own_process
        self.callback = callback
        self.checkpoints = Checkpoints(recorder.folder, options.keep_checkpoints)
        self.given = "initial" in recorder.config  # whether the first networks come from another run
        self.last, self.saved_at = TrainingProgress(refreshed=self.given), time.monotonic()
        self.results = recorder.results()
        self.lost: set[int] = set()  # indices of the seeds that have diverged
        self.step = 0
        self.is_stopped = False  # by the callback
        self.ended: str | None = None  # why the training is finished before its last step, a sentence
        self.was_finished = False  # before it was resumed
        self.failed = False  # whether the last checkpoint could not be written
        self.requests = Requests(partial(self._note, "stopping after this block of steps; Ctrl-C again ends at once"))

    def run(
        self,
        restore: Callable[[SeedState], Snapshot] | None = None,
        files: dict[str, dict[str, np.ndarray]] | None = None,
        begins_again: bool = False,
    ) -> Run:
        """Train to the last step, or until something ends the training before it.

        Args:
            restore: `Session.restore`, to continue from a checkpoint.
            begins_again: clear the log first, because there is no checkpoint.
            files: the arrays of a new training that come from another run, by the names of their files.
        """
        keep_compiled(self._note)
        try:
            with self.recorder, jax.default_matmul_precision(self.options.precision):
                if begins_again:
                    self._begin_again()
                initial.write(self.recorder.folder, files or {})
                self._train(restore)
        except OSError as error:
            raise UserError(
                f"{self.recorder.shown} cannot be written ({cause(error)}): fix that, then "
                f"`beliefrl resume {as_argument(self.recorder)}` goes on."
            ) from None
        return self.recorder

    def _train(self, restore: Callable[[SeedState], Snapshot] | None) -> None:
        try:
            initial_arrays = partial(initial.started, self.recorder.folder, self.agent, self.options.init_replay)
            start = initial_arrays if self.given else None
            settings = self.agent, self.task, self.options, restore, self._note, self.own_process, start
            events = stages(*settings, self.recorder.config.get("initial", {}).get("timesteps", 0))
            with self.checkpoints, self.requests, contextlib.closing(events):
                try:
                    for event in events:
                        if self.was_finished or self._listen(event):
                            break
                except (Stopped, Fault):  # a signal, or an environment that fails
                    with contextlib.suppress(OSError, UserError):  # the checkpoint is there
                        self._finish()
                    raise
            self._finish()
        finally:
            self.recorder.note_end()

    def _finish(self) -> None:
        """Write the results of the last evaluation, if there is one, and draw the curve."""
        if self.results:
            self.recorder.finish(self.results)
            draw_curve(self.recorder)

    def _begin_again(self) -> None:
        """Clear the log, to begin at step 0. What was learned is set aside."""
        aside = set_aside(self.recorder.folder)
        self.recorder.rewind(dict.fromkeys(self.recorder.seeds, 0))
        self.results = None
        kept = "" if aside is None else f"; the log and the agents until now are in {aside}"
        self._note(f"there is no checkpoint: begins again from step 0{kept}")

    def restore(self, shapes: SeedState) -> Snapshot:
        """Restore the last undamaged checkpoint, and truncate the log to its length at that time."""
        empty = shapes.replay
        like = shapes._replace(replay=empty._replace(timesteps=()))
        found = self.checkpoints.restore(like, empty.timesteps, RENAMED, axes=empty.added.ndim)
        for why in found.passed_over:
            self._report(Event(Phase.RESUMING, found.step, note=f"{why} The checkpoint before it is used."))
        self.recorder.rewind({int(seed): length for seed, length in found.progress["metrics"].items()})
        self.last, self.lost = TrainingProgress(*found.progress["progress"]), set(found.progress["lost"])
        self.results = found.progress.get("results", self.results)
        self.ended = self._reached(found.step)
        self.was_finished = self.ended is not None
        notes = [f"goes on from the checkpoint of step {found.step:,}"]
        if isinstance(self.task, GymnasiumTask):
            notes.append("a new episode begins: an environment cannot be saved")
        if self.ended:
            go_on = f"`beliefrl resume {as_argument(self.recorder)} --stop-at NUMBER` goes on to a higher return"
            notes = [f"this training is finished: it {self.ended}; {go_on}, with None to its last step"]
        for note in notes:
            self._report(Event(Phase.RESUMING, found.step, note=note))
        saved = found.tree.replay
        replay = saved._replace(timesteps=found.timesteps, added=saved.added - found.missing.astype(saved.added.dtype))
        seeds = found.tree._replace(replay=replay)
        if seeds.readers is not None:
            seeds = seeds._replace(readers=jax.vmap(ring.renumbered)(seeds.readers, jnp.asarray(found.missing)))
        return Snapshot(self.last, jax.tree.map(jnp.asarray, seeds))

    def _listen(self, event: Event) -> bool:
        """Record an event; returns whether the training ends with it, before its last step."""
        self.step = event.step
        self.requests.renew()
        self._look_for_divergence(event)
        if self.lost:
            event = log.without(event, self.lost)
        if event.states is not None:
            event = event._replace(states=self.agent.networks(event.states))
        self.results = log.record(self.recorder, event, self.lost) or self.results
        if event.evaluation is not None:
            self.ended = self._reached(event.step)
        self._report(event)
        return event.snapshot is not None and self._consider(event, event.snapshot)

    def _report(self, event: Event) -> None:
        """Give an event to the callback, which may ask for a stop."""
        answer = self.callback(event)
        is_flag = isinstance(answer, bool | np.bool_ | jax.Array) and np.asarray(answer).dtype == np.bool_
        if is_flag and bool(answer):
            self.is_stopped = True

    def _note(self, note: str) -> None:
        """Report a note at once, from any thread."""
        self._report(Event(Phase.TRAINING, self.step, note=note))

    def _reached(self, step: int) -> str | None:
        """The message if the returns have reached `stop_at` at this step."""
        line, patience = self.options.stop_at, self.options.stop_patience
        if not self.recorder.reached(line, patience):
            return None
        whose = "the return" if len(self.recorder.seeds) == 1 else "the return of every seed"
        when = "" if patience == 1 else f" in {patience} consecutive evaluations"
        return f"ended at step {step:,}, because {whose} was at least {line:g}{when}"

    def _look_for_divergence(self, event: Event) -> None:
        """Drop seeds whose losses or networks are no longer finite. The others continue."""
        losses = {
            name: event.metrics[name] for name in event.metrics if name.removeprefix("pretrain_") in self.agent.losses
        }
        for name, values in losses.items():
            self._lose(np.flatnonzero(~np.isfinite(values)), event, f"{name} is not finite")
        if event.states is not None:
            self._look_at_networks(event.states, event)

    def _look_at_networks(self, states: Any, event: Event) -> None:
        self._lose(np.flatnonzero(~np.asarray(log.finite(states))), event, "its networks are not finite")

    def _lose(self, indices: np.ndarray, event: Event, why: str) -> None:
        for index in indices:
            if index in self.lost:
                continue
            seed = self.recorder.seeds[index]
            self.lost.add(int(index))
            self.recorder.log(seed, "diverged", event.step, {"why": why})
            self._wait()
            kept = self.checkpoints.keep_for(f"seed-{seed}")
            where = f"its last good checkpoint stays in {kept}" if kept else "it had no checkpoint yet"
            note = f"seed {seed} diverged by step {event.step:,}: {why}; {where}."
            if len(self.lost) == len(self.recorder.seeds):
                raise UserError(f"All seeds have diverged; {note} Try smaller learning rates.")
            self._report(Event(event.phase, event.step, note=note))

    def _is_due(self, event: Event, snapshot: Snapshot) -> bool:
        """Whether a checkpoint is due. Before an evaluation it is due only if a signal asks for a stop."""
        if event.phase is Phase.EVALUATING:
            return self.requests.number is not None
        progress, options = snapshot.progress, self.options
        steps = progress.step - self.last.step >= options.checkpoint_steps > 0
        minutes = time.monotonic() - self.saved_at >= 60 * options.checkpoint_minutes > 0
        refreshed = progress.refreshed and not self.last.refreshed
        ends = self._has_ended(progress) or self.ended or self.is_stopped or self.requests.number
        return bool(steps or minutes or refreshed or ends or event.phase is Phase.FAULT)

    def _has_ended(self, progress: TrainingProgress) -> bool:
        return progress.step >= self.options.steps and progress.evaluated == progress.step

    def _consider(self, event: Event, snapshot: Snapshot) -> bool:
        """Write a checkpoint if one is due; returns whether the training ends with it, before its last step.

        Raises:
            Stopped: a signal asked for it.
        """
        if not self._is_due(event, snapshot):
            return False
        self._look_at_networks(snapshot.seeds.state, event)  # networks are checked before each checkpoint
        if event.phase is Phase.FAULT:
            self._save_at_fault(snapshot)
            return False
        step, asked = snapshot.progress.step, self.requests.number
        self._save(snapshot)
        if self._has_ended(snapshot.progress):
            return False
        if asked:
            self._wait()
            if self.failed:
                self._save(snapshot)
            raise Stopped(f"stopped at step {step:,}; {self._how_to_go_on}.", asked)
        if self.ended or self.is_stopped:
            self._note(self.ended or f"stopped by the callback at step {step:,}; {self._how_to_go_on}")
            return True
        return False

    def _save_at_fault(self, snapshot: Snapshot) -> None:
        """Write a checkpoint where an environment failed. The Fault is raised next, so an error here is only noted."""
        step = snapshot.progress.step
        try:
            self._save(snapshot)
            self.checkpoints.wait()
            self._note(f"saved at step {step:,}; {self._how_to_go_on}")
        except (OSError, UserError) as error:
            why = cause(error) if isinstance(error, OSError) else error
            self._note(f"the checkpoint of step {step:,} cannot be written ({why})")

    @property
    def _how_to_go_on(self) -> str:
        command = f"`beliefrl resume {as_argument(self.recorder)}` goes on from there"
        return f"{command}, in Python beliefrl.resume({self.recorder.shown!r})"

    def _save(self, snapshot: Snapshot) -> None:
        self._wait()
        if snapshot.progress.refreshed and not self.last.refreshed:
            self.checkpoints.forget_timesteps()
        replay = snapshot.seeds.replay
        rest = snapshot.seeds._replace(replay=replay._replace(timesteps=()))
        progress = {
            "progress": list(snapshot.progress),
            "metrics": self.recorder.lengths(),
            "lost": sorted(self.lost),
            "results": self.results,
        }
        failed, self.failed = self.failed, False
        self.checkpoints.save(snapshot.progress.step, progress, rest, replay.timesteps, np.asarray(replay.added))
        if failed:
            self.checkpoints.wait()  # a second failure ends the training
        self.last, self.saved_at = snapshot.progress, time.monotonic()

    def _wait(self) -> None:
        """Wait until the last checkpoint is written. If that has failed, for example on a full disk, remember it."""
        try:
            self.checkpoints.wait()
        except OSError as error:
            self._note(f"a checkpoint could not be written ({cause(error)}): if the next one fails, the training ends")
            self.failed = True
