"""The display of a training, its progress, then its results; and the tables of `beliefrl show` and `bench all`."""

import dataclasses
import io
import time
from typing import Any

import numpy as np
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from beliefrl.agents.hyperparameters import values_before
from beliefrl.analysis.figures import curve_figure
from beliefrl.analysis.tables import measure_text
from beliefrl.errors import UserError
from beliefrl.runs.best import evaluations
from beliefrl.runs.checkpoint import listed
from beliefrl.runs.records import finite_mean, finite_or_none, sessions
from beliefrl.runs.run import Run
from beliefrl.training.restore import as_argument
from beliefrl.training.schedule import Event, Phase
from beliefrl.training.screen import Screen, duration
from beliefrl.training.summary import MODES
from beliefrl.types import plain


class TrainingDisplay:
    """A live bar with the phase, steps/s, time left and the last returns; a line for every evaluation.

    In a log, each phase also gets a line. A notebook shows the learning curve as well.
    """

    def __init__(self, screen: Screen, run: Run):
        """`run` is the run that is trained."""
        self.screen, self.run, self.steps = screen, run, run.options.steps
        self.progress = Progress(
            TextColumn("{task.description:<26}"), BarColumn(), TextColumn("{task.fields[status]}"), auto_refresh=False
        )
        self.bar = self.progress.add_task(Phase.STARTING, total=self.steps, status="")
        self.returns = ""
        self.phase = Phase.STARTING
        self.phase_began = time.monotonic()
        self.phase_step = 0
        self.first_part: tuple[float, int] | None = None  # when the first update of a phase was shown, and its number

    def __enter__(self) -> "TrainingDisplay":
        self.screen.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.screen.__exit__()
        if kind is None:
            self._ended()

    def __call__(self, event: Event) -> None:
        """Show an event."""
        now = time.monotonic()
        if event.note is not None:
            self.screen.line(event.note)
            return
        if event.phase not in (Phase.EVALUATING, Phase.FINISHED, self.phase):
            self._begin_phase(event, now)
        if event.episodes is not None and np.any(event.episodes.done):
            ended = np.asarray(event.episodes.episode_return)[np.asarray(event.episodes.done)]
            self.returns = f"last returns {ended.mean():.1f}"
        if event.part:
            done, of = event.part
            began, first = self.first_part = self.first_part or (now, done)
            status = f"{done:,}/{of:,} updates"
            if done > first:
                status += f", {duration((now - began) / (done - first) * (of - done))} left in this phase"
            self._status(event, done, of, status)
        else:
            status = f"step {event.step:,}/{self.steps:,}  {self._speed(event, now)}  {self.returns}"
            self._status(event, event.step, self.steps, status)
        if event.evaluation is not None:
            self._evaluated(event)

    def _begin_phase(self, event: Event, now: float) -> None:
        """Begin to time a phase, and print its name if the screen is not live."""
        self.phase, self.phase_began, self.phase_step, self.first_part = event.phase, now, event.step, None
        if not self.screen.is_live:
            self.screen.line(event.phase)

    def _status(self, event: Event, done: int, of: int, status: str) -> None:
        self.progress.update(self.bar, completed=done, total=of, description=event.phase, status=status)
        text = f"still {event.phase}" if event.phase.is_compiling else f"{event.phase}: {status}"
        self.screen.status(" ".join(text.split()), self.progress)

    def _speed(self, event: Event, now: float) -> str:
        steps = event.step - self.phase_step
        if steps <= 0:
            return "(can take a minute)" if event.phase.is_compiling else ""
        rate = steps / (now - self.phase_began)
        return f"{rate:.0f} steps/s, {duration((self.steps - event.step) / rate)} left"

    def _evaluated(self, event: Event) -> None:
        result = event.evaluation
        assert result is not None
        sampled, mode = np.nanmean(result.episode_return, axis=(0, 2))  # diverged seeds are NaN
        line = f"step {event.step:,}: return {sampled:.1f} sampled, {mode:.1f} mode"
        for name, values in result.measures.items():
            means = (finite_or_none(finite_mean(values[:, index])) for index in range(2))
            sampled, mode = (measure_text(name, mean) for mean in means)
            line += f"; {name} {sampled} sampled, {mode} mode"
        self.screen.line(line)
        self.screen.picture(self._curve)

    def _curve(self) -> bytes | None:
        """The learning curve so far, as PNG; None before every seed has an evaluation."""
        png = io.BytesIO()
        try:
            curve_figure(self.run).savefig(png, format="png", dpi=90)
        except UserError:
            return None
        return png.getvalue()

    def _ended(self) -> None:
        """Show the results of a training, and its folder."""
        run, results = self.run, self.run.results()
        if not results:  # stopped before the first evaluation
            self.screen.show(f"saved in {run.shown}")
            return
        title = f"{run.config['agent']} on {run.config['task']} after {results['step']:,} steps"
        self.screen.show(results_table(results, run.seeds, title))
        command = f"`beliefrl evaluate {as_argument(run)}`"
        self.screen.show(f"saved in {run.shown}: see curve.png; {command} plays more episodes")


def results_table(results: dict[str, Any], seeds: list[int], title: str) -> Table:
    """Returns of every seed with sampled and with mode actions, and their mean and standard error over seeds."""
    table = Table(title=title, title_justify="left")
    measures = [name.removeprefix("seeds_") for name, of in results["sampled"].items() if name[:6] == "seeds_" and of]
    headings = [f"{name} {mode}" for name in measures for mode in MODES]
    for heading in ("seed", "sampled actions", "mode actions", *headings):
        table.add_column(heading, justify="right")
    for index, seed in enumerate(seeds):
        returns = [results[mode]["seeds"][index] for mode in MODES]
        cells = ["diverged" if mean is None else f"{mean:.1f}" for mean in returns]
        cells += [measure_text(name, results[mode][f"seeds_{name}"][index]) for name in measures for mode in MODES]
        table.add_row(str(seed), *cells)
    table.add_section()
    cells = [_mean(results[mode]) for mode in MODES]
    cells += [measure_text(name, results[mode][name]) for name in measures for mode in MODES]
    table.add_row("mean ± S.E.M.", *cells)
    return table


def _mean(mode: dict[str, Any]) -> str:
    return f"{mode['mean']:.1f}" + (f" ± {mode['sem']:.1f}" if mode["sem"] is not None else "")


def run_table(run: Run, agent: Any) -> Table:
    """The settings of a run, and its progress. Without an agent all of its settings are shown."""
    table = Table(title=Text(run.shown), title_justify="left", show_header=False)

    def add(name: str, value: str) -> None:
        table.add_row(name, Text(value))  # without markup: it may contain brackets

    config = run.config
    own = {} if agent is None else {field.name: field.default for field in dataclasses.fields(agent)}
    known = values_before(agent) | config["hyperparameters"]
    changed = [f"{name}={value}" for name, value in known.items() if plain(value) != plain(own.get(name))]
    constants = [f"{name}={value}" for name, value in config["constants"].items()]
    observed = [] if config.get("observe") is None else [f"observe={' '.join(map(str, config['observe']))}"]
    faults = [f"{name}={value}" for name, value in config.get("faults", {}).items()]
    steps = [max((row["step"] for row in run.rows(seed) if row["kind"] != "pretrain"), default=0) for seed in run.seeds]
    add("agent", config["agent"])
    add("settings", ", ".join(changed) or "the agent's defaults")
    add("task", " ".join([config["task"], *constants, *observed, *faults]))
    add("seeds", ", ".join(map(str, run.seeds)))
    add("steps", f"{max(steps):,} of {run.options.steps:,}")
    for seed in run.seeds:
        for entry in run.rows(seed, "diverged"):
            add("diverged", f"seed {seed} by step {entry['step']:,}: {entry.get('why', '?')}")
    if config.get("initial"):
        add("initial networks", _origin(config["initial"]))
    for seed, found in zip(run.seeds, evaluations(run.folder, len(run.seeds)), strict=True):
        if found is not None:
            add("best agent", f"seed {seed} at step {found['step']:,}: return {found['return']:.1f} sampled")
    add("checkpoints", ", ".join(path.name for path in listed(run.folder)) or "none")
    for index, session in enumerate(sessions(config)):
        began = f"{session.get('started', '?')} to {session.get('ended', '?')}, {session.get('device', '?')}"
        versions = " ".join(f"{name} {version}" for name, version in session.get("versions", {}).items())
        table.add_section()
        add("resumed" if index else "started", began)
        add("command", " ".join(map(str, session.get("command", ()))))
        add("commit", str(session.get("git_commit")))
        add("versions", versions)
    return table


def _origin(initial: dict[str, Any]) -> str:
    """Where the initial networks of a run come from."""
    which = "best" if initial.get("best") else "last"
    source = f"{initial.get('run')} ({initial.get('agent')} on {initial.get('task')})"
    taken, step = initial.get("timesteps"), initial.get("replay_step")
    replay = f", and its replay of step {step:,} (at most {taken:,} timesteps)" if taken and step else ""
    return f"{which} agent of {source}, commit {initial.get('git_commit')}{replay}"


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
