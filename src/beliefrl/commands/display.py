"""The live view of a training or a sweep, and the tables at the end."""

import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from beliefrl.runs.checkpoint import listed
from beliefrl.runs.run import Run
from beliefrl.sweeps.progress import Forecast
from beliefrl.sweeps.run import SweepStatus
from beliefrl.training.schedule import Event, Phase


def duration(seconds: float) -> str:
    """Seconds as 12 s, 3:04 or 1:02:03."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


class TrainingDisplay:
    """A live bar with the phase, steps/s, time left and the last returns; a line for every evaluation.

    Where the output is not a terminal, only the lines.
    """

    def __init__(self, console: Console, steps: int):
        """`steps` of each seed in all."""
        self.console, self.steps = console, steps
        columns = (TextColumn("{task.description:<26}"), BarColumn(), TextColumn("{task.fields[status]}"))
        self.progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self.bar = self.progress.add_task(Phase.STARTING, total=steps, status="")
        self.returns = ""
        self.phase = Phase.STARTING
        self.began = self.phase_began = time.monotonic()
        self.phase_step = 0

    def __enter__(self) -> "TrainingDisplay":
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def __call__(self, event: Event) -> None:
        """Show an event."""
        now = time.monotonic()
        if event.note is not None:
            self._line(now, event.note)
            return
        if event.phase not in (Phase.EVALUATING, self.phase):
            self._begin_phase(event, now)
        if event.episodes is not None and np.any(event.episodes.done):
            ended = np.asarray(event.episodes.episode_return)[np.asarray(event.episodes.done)]
            self.returns = f"last returns {ended.mean():.1f}"
        if event.part:
            done, of = event.part
            left = (now - self.phase_began) / done * (of - done)
            status = f"{done:,}/{of:,} updates, {duration(left)} left in this phase"
            self.progress.update(self.bar, completed=done, total=of, description=event.phase, status=status)
        else:
            status = f"step {event.step:,}/{self.steps:,}  {self._speed(event, now)}  {self.returns}"
            self.progress.update(
                self.bar, completed=event.step, total=self.steps, description=event.phase, status=status
            )
        if event.evaluation is not None:
            self._evaluated(event, now)

    def _begin_phase(self, event: Event, now: float) -> None:
        """Begin to time a phase, and print its name where there is no live bar."""
        self.phase, self.phase_began, self.phase_step = event.phase, now, event.step
        if not self.console.is_terminal:
            self._line(now, event.phase)

    def _speed(self, event: Event, now: float) -> str:
        steps = event.step - self.phase_step
        if steps <= 0:
            return "(a minute at most)" if event.phase.is_compiling else ""
        rate = steps / (now - self.phase_began)
        return f"{rate:.0f} steps/s, {duration((self.steps - event.step) / rate)} left"

    def _evaluated(self, event: Event, now: float) -> None:
        result = event.evaluation
        assert result is not None
        returns, success = np.asarray(result.episode_return), np.asarray(result.success)
        sampled, mode = np.nanmean(returns, axis=(0, 2))  # diverged seeds are NaN
        means = f"return {sampled:.1f} sampled, {mode:.1f} mode"
        line = f"step {event.step:,}: {means}"
        if success.any():
            line += f"; success {success[:, 0].mean():.0%} sampled, {success[:, 1].mean():.0%} mode"
        self._line(now, line)

    def _line(self, now: float, line: str) -> None:
        """Print a line that stays, with the time since the start."""
        self.console.print(f"[{duration(now - self.began)}] {line}", markup=False, highlight=False, soft_wrap=True)


class SweepDisplay:
    """A live table of what runs, what is left and when it ends; a line for every training that begins or ends.

    Where the output is not a terminal, only the lines.
    """

    def __init__(self, console: Console, folder: pathlib.Path):
        """`folder` is the sweep's."""
        self.console, self.folder = console, folder
        self.forecast = Forecast(folder)
        self.live = Live(console=console, transient=True, refresh_per_second=2, auto_refresh=False)
        self.began = time.monotonic()
        self.before: SweepStatus | None = None

    def __enter__(self) -> "SweepDisplay":
        if self.console.is_terminal:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.live.stop()
        if self.before is not None:
            done = f"{len(self.before.finished)} of {self.before.count} trainings finished in {self.folder}"
            self._line(f"{done}; `beliefrl report {self.folder} -o report.html` shows them")

    def __call__(self, status: SweepStatus) -> None:
        """Show how far a sweep is."""
        self.forecast.watch(status)
        self._tell_changes(status)
        if self.live.is_started:
            self.live.update(self._table(status), refresh=True)

    def _tell_changes(self, status: SweepStatus) -> None:
        if self.before is None:
            already = f", {len(status.finished)} of them finished already" if status.finished else ""
            self._line(f"{status.count} trainings{already}, {len(status.running)} at a time")
            self.before = SweepStatus([*status.finished], [])
        for name in status.running:
            if name not in self.before.running:
                self._line(f"begins: {name}")
        for training in status.finished[len(self.before.finished) :]:
            self._line(f"finished: {training.name} ({self._summary(status)})")
        for name, why in status.failed.items():
            if name not in self.before.failed:
                self._line(f"failed: {name}: {why}")
        self.before = SweepStatus([*status.finished], [*status.waiting], dict(status.running), dict(status.failed))

    def _summary(self, status: SweepStatus) -> str:
        failed = f", {len(status.failed)} failed" if status.failed else ""
        left = self.forecast.seconds_left(status)
        ends = "" if left is None else f", about {duration(left)} left"
        return f"{len(status.finished)} of {status.count} done{failed}, {len(status.waiting)} waiting{ends}"

    def _table(self, status: SweepStatus) -> Group:
        table = Table(box=None, pad_edge=False)
        for heading in ("training", "step", "doing", "last return"):
            table.add_column(heading, justify="right" if heading in ("step", "last return") else "left")
        for name, progress in self.forecast.going.items():
            last = "" if progress.last_return is None else f"{progress.last_return:.1f}"
            table.add_row(name, f"{progress.step:,}/{progress.training.steps:,}", progress.doing, last)
        return Group(table, f"[{duration(time.monotonic() - self.began)}] {self._summary(status)}".replace("[", "\\["))

    def _line(self, line: str) -> None:
        stamped = f"[{duration(time.monotonic() - self.began)}] {line}"
        self.console.print(stamped, markup=False, highlight=False, soft_wrap=True)


def results_table(results: dict[str, Any], seeds: list[int], title: str) -> Table:
    """Returns of every seed, and over seeds mean and standard error, with sampled and with mode actions."""
    table = Table(title=title, title_justify="left")
    with_success = results["sampled"]["success"] is not None
    for heading in ("seed", "sampled actions", "mode actions", *(["success sampled", "success mode"] * with_success)):
        table.add_column(heading, justify="right")
    for index, seed in enumerate(seeds):
        returns = [results[mode]["seeds"][index] for mode in ("sampled", "mode")]
        cells = ["diverged" if mean is None else f"{mean:.1f}" for mean in returns]
        if with_success:
            cells += [f"{results[mode]['seeds_success'][index]:.0%}" for mode in ("sampled", "mode")]
        table.add_row(str(seed), *cells)
    table.add_section()
    cells = [_mean(results[mode]) for mode in ("sampled", "mode")]
    if with_success:
        cells += [f"{results[mode]['success']:.0%}" for mode in ("sampled", "mode")]
    table.add_row("mean ± S.E.M.", *cells)
    return table


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
    steps = [max((row["step"] for row in run.rows(seed) if row["kind"] != "pretrain"), default=0) for seed in run.seeds]
    add("agent", config["agent"])
    add("settings", ", ".join(changed) or "the agent's defaults")
    add("task", " ".join([config["task"], *constants, *observed]))
    add("seeds", ", ".join(map(str, run.seeds)))
    add("steps", f"{max(steps):,} of {run.options.steps:,}")
    for seed in run.seeds:
        for entry in run.rows(seed, "diverged"):
            add("diverged", f"seed {seed} by step {entry['step']:,}: {entry.get('why', '?')}")
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


def _mean(mode: dict[str, Any]) -> str:
    return f"{mode['mean']:.1f}" + (f" ± {mode['sem']:.1f}" if mode["sem"] is not None else "")
