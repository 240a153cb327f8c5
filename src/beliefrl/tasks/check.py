"""Check a task before training: its observations, actions and rewards, the reasons to refuse it, and warnings."""

import contextlib
import dataclasses
import io
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from beliefrl import tasks
from beliefrl.errors import UserError, short
from beliefrl.tasks.check_warnings import Entry, about_episodes, about_observations, number
from beliefrl.tasks.environment import TaskEnvironment
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.tasks.settings import settings_kept
from beliefrl.tasks.spaces import action_names, check_actions, check_names, flat_bounds, flat_size, observation_names
from beliefrl.tasks.traced import check_traced
from beliefrl.types import LARGEST, check_whole

MOST_ROWS = 100  # of a printed table


@dataclasses.dataclass(frozen=True, repr=False)
class TaskCheck:
    """The result of `check`; printed as tables."""

    task: str
    observation_space: str
    action_space: str
    entries: tuple[Entry, ...] = ()
    """All entries of the full observation."""
    actions: tuple[Entry, ...] = ()
    max_steps: int | None = None
    """Time limit in steps; None if there is none."""
    rewards: tuple[float, float] | None = None
    """Lowest and highest reward in the random steps."""
    steps: int = 0
    """Random steps that were taken."""
    episodes: int = 0
    """Episodes that ended in these steps."""
    steps_per_second: float = 0.0
    warnings: tuple[str, ...] = ()
    """Sentences about suspicious properties; the training does not refuse the task for them."""
    refusals: tuple[str, ...] = ()
    """Sentences that say why the agent cannot be trained on the task; empty if it can."""

    def __repr__(self) -> str:
        """The tables and sentences as plain text."""
        page = io.StringIO()
        refused = [Text(f"refused: {sentence}") for sentence in self.refusals]
        Console(file=page, width=100, color_system=None).print(self, *refused, sep="\n")
        return "\n".join(line.rstrip() for line in page.getvalue().splitlines())

    def __rich__(self) -> Group:
        """Everything except the refusals, in colour on a terminal."""
        parts = [self._summary()]
        if self.entries:
            parts += [_table("observation", self.entries, seen=True), _table("action", self.actions, seen=False)]
        return Group(*parts, *(Text(f"warning: {sentence}", "yellow") for sentence in self.warnings))

    def _summary(self) -> Table:
        table = Table(title=Text(self.task), title_justify="left", show_header=False)
        rows = {"observation": self.observation_space, "action": self.action_space}
        if self.entries:
            seen = sum(entry.position is not None for entry in self.entries)
            rows["agent observes"] = f"{seen} of {len(self.entries)} entries"
            limit = "no time limit" if self.max_steps is None else f"at most {self.max_steps:,} steps"
            rows["episode"] = f"{limit}; {self.episodes} ended in {self.steps} random steps"
        if self.rewards:
            rows["reward"] = f"{_range(*self.rewards)} in these steps"
            rows["speed"] = f"{float(f'{self.steps_per_second:.2g}'):,.0f} steps a second, one environment alone"
        for name, value in rows.items():
            table.add_row(name, Text(value))
        return table


def check(
    task: Any, observe: Sequence[int | str] | int | str | None = None, steps: int = 200, seed: int = 0, **constants: Any
) -> TaskCheck:
    """Take random steps in a task. Report its observations, actions and rewards, and what prevents a training.

        print(beliefrl.check("gym:Pendulum-v1", observe=[0, 1]))

    Actions are uniform between the bounds of the environment.

    Args:
        task: the name of a task, as for `make_task`, a task, or a class of Gymnasium environments.
        observe: entries that the agent will observe, as for `make_task`; None: all, or those of the task.
        steps: number of random steps, at least 1.
        seed: random seed of the steps, at least 0.
        constants: as for `make_task`, if `task` is a name.

    Raises:
        UserError: there is no such task or constant, the environment cannot be made, or a number is out of range.
    """
    check_whole("steps", steps, 1)
    check_whole("seed", seed, 0, LARGEST // 2)  # each episode has one more
    with settings_kept():
        return _checked(task, observe, steps, seed, constants)


def _checked(task: Any, observe: Any, steps: int, seed: int, constants: dict[str, Any]) -> TaskCheck:
    whole = tasks.make(task, **constants) if isinstance(task, str) else tasks.given(task)
    found = _declared(whole)
    if found.refusals:
        return found
    seen = whole
    try:
        seen = whole if observe is None else tasks.observed(tasks.describe(whole)["task"], whole, observe)
    except UserError as error:  # the tables are still made, to show the existing entries
        found = dataclasses.replace(found, refusals=(str(error),))
    return _played(found, seen, steps, seed)


def _declared(task: Any) -> TaskCheck:
    """The declarations of a task, and the refusals. If its spaces are not supported: no entries."""
    if not isinstance(task, GymnasiumTask):
        name = tasks.describe(task)["task"]
        refusals = _refusals(lambda: check_traced(tasks.full(task), name))
        if refusals:
            return TaskCheck(name, "unknown", "unknown", refusals=refusals)
        spec, names = task.spec, tasks.entry_names(tasks.full(task))
        entries = tuple(Entry(index, name, -np.inf, np.inf) for index, name in enumerate(names))
        actions = tuple(Entry(index, "", -1.0, 1.0) for index in range(spec.action_dim))
        spaces = f"entries: {len(entries)}", f"entries: {spec.action_dim}, from -1 to 1"
        return TaskCheck(name, *spaces, entries, actions, spec.max_steps)
    environment = task.bare()
    space, actions = (getattr(environment, f"{what}_space", None) for what in ("observation", "action"))
    found = TaskCheck(task.name, short(space), short(actions))
    refusals = _refusals(lambda: check_actions(actions, task.name), lambda: flat_size(space, task.name))
    if not refusals:
        bounds, wanted = flat_bounds(space), flat_bounds(actions)
        names = observation_names(environment, space, task.name), action_names(environment, wanted.low.size)
        found = dataclasses.replace(found, entries=_entries(names[0], bounds), actions=_entries(names[1], wanted))
        refusals = _refusals(lambda: check_names(environment, space, task.name))
    with contextlib.suppress(Exception):
        environment.close()
    return dataclasses.replace(found, refusals=refusals)


def _entries(names: Sequence[str], bounds: Any) -> tuple[Entry, ...]:
    rows = zip(names, bounds.low.tolist(), bounds.high.tolist(), strict=True)
    return tuple(Entry(index, name, float(low), float(high)) for index, (name, low, high) in enumerate(rows))


def _refusals(*checks: Callable[[], Any]) -> tuple[str, ...]:
    """The sentences of those checks that fail."""
    sentences = []
    for each in checks:
        try:
            each()
        except UserError as error:
            sentences.append(str(error))
    return tuple(sentences)


def _played(found: TaskCheck, task: Any, steps: int, seed: int) -> TaskCheck:
    """The same with the results of random steps; `task` has the entries that the agent observes."""
    on_host = isinstance(task, GymnasiumTask)
    refusals, observations, rewards, times, ends = list(found.refusals), [], [], [], []
    environment: Any = task.environment() if on_host else TaskEnvironment(tasks.full(task))
    limit = environment.limit if on_host else task.spec.max_steps
    random, length = np.random.default_rng(seed), 0
    try:
        for _ in range(steps):
            if length == 0:
                obs, _ = environment.reset(seed=seed + len(ends))
                observations.append(environment.whole.copy() if on_host else obs)
            started = time.perf_counter()
            obs, reward, *end, _ = environment.step(random.uniform(-1.0, 1.0, len(found.actions)))
            times.append(time.perf_counter() - started)
            observations.append(environment.whole.copy() if on_host else obs)
            rewards.append(float(reward))
            length = 0 if any(end) or length + 1 == limit else length + 1
            ends += [] if length else [end]
    except UserError as error:
        refusals.append(str(error))
    with contextlib.suppress(Exception):
        environment.close()
    values = np.array(observations, np.float64).reshape(-1, len(found.entries))
    seen = () if found.refusals else tasks.entries(task)
    entries = _with_values(found.entries, values, seen)
    found = dataclasses.replace(
        found,
        entries=entries,
        max_steps=limit,
        rewards=(min(rewards), max(rewards)) if rewards else None,
        steps=len(rewards),
        episodes=len(ends),
        steps_per_second=1 / max(float(np.median(times)), 1e-9) if times else 0.0,
        refusals=tuple(refusals),
    )
    truncates = any(truncated for _, truncated in ends)
    warnings = *about_observations(entries, values), *about_episodes(found.max_steps, rewards, truncates)
    return dataclasses.replace(found, warnings=warnings)


def _with_values(entries: Sequence[Entry], values: Any, seen: Sequence[int]) -> tuple[Entry, ...]:
    """The entries with the range of their finite values (time, entry), and their positions in its observation."""
    positions = {index: position for position, index in enumerate(seen)}
    rows = []
    for entry, column in zip(entries, values.T, strict=True):
        finite = column[np.isfinite(column)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)
        position = positions.get(entry.index)
        rows.append(dataclasses.replace(entry, seen_low=low, seen_high=high, position=position))
    return tuple(rows)


def _range(low: float, high: float) -> str:
    if np.isnan(low) or low == high:
        return "none" if np.isnan(low) else f"always {number(low)}"
    return "unbounded" if np.isinf([low, high]).all() else f"{number(low)} to {number(high)}"


def _table(title: str, entries: Sequence[Entry], seen: bool) -> Table:
    """One row for each entry. `seen`: with the range in the random steps, and the index in the agent's observation."""
    caption = f"and {len(entries) - MOST_ROWS} more entries" if len(entries) > MOST_ROWS else None
    table = Table(title=title, title_justify="left", caption=caption, caption_justify="left")
    for heading in ("index", "name", "declared", *(("seen", "agent's index") if seen else ())):
        table.add_column(heading, justify="left" if heading == "name" else "right")
    for entry in entries[:MOST_ROWS]:
        position = "hidden" if entry.position is None else str(entry.position)
        more = (_range(entry.seen_low, entry.seen_high), position) if seen else ()
        table.add_row(*map(Text, (str(entry.index), entry.name, _range(entry.low, entry.high), *more)))
    return table
