"""What is suspicious about the observations, rewards and episodes of a task, in sentences; used by `check`."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from beliefrl.tasks.seen_environment import ENDLESS

SCALES = 100.0  # entries whose largest magnitudes differ by more than this factor cause a warning
SMALLEST_DEVIATION = 1e-3  # as in `models.scales`, which adds it to deviations: entries that vary less stay small
OFFSET = 1e4  # standard deviations: a running mean in float32 does not follow a larger one well
MOST_NAMED = 5  # entries in one warning


@dataclasses.dataclass(frozen=True)
class Entry:
    """One entry of an observation or of an action."""

    index: int
    name: str
    """Name with a unit in brackets; "entry 2" or "" if the environment has none."""
    low: float
    high: float
    """Declared range; infinite if none is declared."""
    seen_low: float = np.nan
    seen_high: float = np.nan
    """Range in the random steps; NaN for actions."""
    position: int | None = None
    """Index in the agent's observation; None if the agent does not observe it."""


def about_observations(entries: Sequence[Entry], values: Float[np.ndarray, "time entry"]) -> list[str]:
    """Warnings about entries and their values in the random steps."""
    sentences = []
    broken = [entry for entry in entries if not np.isfinite(values[:, entry.index]).all()]
    if broken:
        sentences.append(f"{_listed(broken)} had values that are not finite: an agent that observes them diverges.")
    outside = [e for e in entries if _beyond(e.low - e.seen_low, e.low) or _beyond(e.seen_high - e.high, e.high)]
    if outside:
        sentences.append(f"{_listed(outside)} left the declared range: correct the observation or its space.")
    seen = [entry for entry in entries if entry.position is not None]
    constant = [entry for entry in seen if entry.seen_low == entry.seen_high]
    if constant and len(values) > 1:
        sentences.append(f"{_listed(constant)} never changed: leave out what says nothing, with --observe.")
    sizes = sorted((max(-entry.seen_low, entry.seen_high), entry.index) for entry in seen if entry not in constant)
    if sizes and sizes[-1][0] > SCALES * sizes[0][0]:
        small, large = (f"{_listed([entries[i]])} up to {number(size)}" for size, i in (sizes[0], sizes[-1]))
        sentences.append(
            f"Scales differ: {small}, {large}. Scale them in the environment, or use predictive-sac, which "
            "standardises observations."
        )
    changing = [entry for entry in seen if entry not in constant and entry not in broken]
    return sentences + _about_deviations(changing, values)


def _about_deviations(entries: Sequence[Entry], values: Float[np.ndarray, "time entry"]) -> list[str]:
    """Warnings about entries that change little."""
    if not len(values):
        return []
    small, far = [], []
    for entry in entries:
        deviation, size = np.std(values[:, entry.index]), abs(np.mean(values[:, entry.index]))
        if deviation < SMALLEST_DEVIATION:
            small.append(entry)
        elif size > OFFSET * deviation:
            far.append(entry)
    sentences = []
    if small:
        sentences.append(f"{_listed(small)} changed by less than {SMALLEST_DEVIATION:g}: use a smaller unit.")
    if far:
        sentences.append(f"{_listed(far)} changed little around a large mean: subtract a constant.")
    return sentences


def _beyond(excess: float, bound: float) -> bool:
    """Whether a value exceeds a bound by more than rounding."""
    return excess > 1e-5 * max(1.0, abs(bound))


def about_episodes(max_steps: int | None, rewards: Sequence[float], truncates: bool) -> list[str]:
    """Warnings about rewards and the end of episodes."""
    sentences = []
    if rewards and not any(rewards):
        sentences.append("The reward was always 0: an agent that never meets another reward cannot learn.")
    if max_steps is None and not truncates:
        sentences.append(
            f"There is no time limit: an episode of more than {ENDLESS:,} steps stops the training; set one with "
            "--constants max_episode_steps=500, or in Python with GymnasiumTask(..., max_steps=500)."
        )
    return sentences


def _listed(entries: Sequence[Entry]) -> str:
    """Entries in a sentence: "Entry 2 (θ̇ in rad/s)"."""
    names = [
        str(entry.index) if entry.name == f"entry {entry.index}" else f"{entry.index}, {entry.name},"
        for entry in entries[:MOST_NAMED]
    ]
    more = len(entries) - len(names)
    text = " and ".join([*names, *([f"{more} more"] if more else [])])
    return f"{'Entry' if len(entries) == 1 else 'Entries'} {text}"


def number(value: float) -> str:
    """The number as text, with four significant digits."""
    return f"{value:.4g}"
