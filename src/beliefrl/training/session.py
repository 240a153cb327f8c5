"""A training while it runs: its log, its checkpoints, seeds that diverge, and the stop that a signal asks for.

`schedule.stages` trains and yields events; the code here records them.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.agents import Agent
from beliefrl.analysis.curves import draw_curve
from beliefrl.runs.checkpoint import Checkpoints
from beliefrl.runs.options import Options
from beliefrl.runs.run import Recorder, Run
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training import log
from beliefrl.training.compilation import keep_compiled
from beliefrl.training.evaluation import as_argument
from beliefrl.training.phases import SeedState
from beliefrl.training.schedule import Event, Phase, Snapshot, TrainingProgress, stages
from beliefrl.training.stop import Requests, Stopped
from beliefrl.types import UserError

Report = Callable[[Event], Any]
RENAMED = {".actor.episode_return": ".actor.total"}  # arrays in checkpoints: the present name, the old one


class Session:
    """One training while it runs."""

    def __init__(
        self,
        recorder: Recorder,
        agent: Agent,
        task: Any,
        options: Options,
        report: Report,
        own_process: bool,
    ):
        self.recorder, self.agent, self.task, self.options = recorder, agent, task, options
        self.own_process = own_process
        self.report = report
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
        like = shapes._replace(replay=ring._replace(timesteps=()))
        found = self.checkpoints.restore(like, ring.timesteps, RENAMED)
        for why in found.passed_over:
            self.report(Event(Phase.RESUMING, found.step, note=f"{why} The checkpoint before it is used."))
        self.recorder.rewind({int(seed): length for seed, length in found.progress["metrics"].items()})
        self.last, self.lost = TrainingProgress(*found.progress["progress"]), set(found.progress["lost"])
        self.report(Event(Phase.RESUMING, found.step, note=f"goes on from the checkpoint of step {found.step:,}"))
        if isinstance(self.task, GymnasiumTask):
            self.report(Event(Phase.RESUMING, found.step, note="a new episode begins: an environment cannot be saved"))
        seeds = found.tree._replace(replay=found.tree.replay._replace(timesteps=found.timesteps))
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
            go_on = f"`beliefrl resume {as_argument(self.recorder)}` goes on from there"
            in_python = f"in Python beliefrl.resume({str(self.recorder.folder)!r})"
            raise Stopped(f"stopped at step {progress.step:,}; {go_on}, {in_python}.", asked)

    def _save(self, snapshot: Snapshot) -> None:
        replay = snapshot.seeds.replay
        rest = snapshot.seeds._replace(replay=replay._replace(timesteps=()))
        lost = sorted(self.lost)
        progress = {"progress": list(snapshot.progress), "metrics": self.recorder.lengths(), "lost": lost}
        self.checkpoints.save(snapshot.progress.step, progress, rest, replay.timesteps, np.asarray(replay.added))
        self.last, self.saved_at = snapshot.progress, time.monotonic()
