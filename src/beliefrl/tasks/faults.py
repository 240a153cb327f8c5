"""Missing and faulty sensors on any task: noise, lost observations, lost entries, delay, and actions that repeat.

At each step, in this order:

    the action that is applied   the agent's action, or the one that was applied before (`sticky`)
    the task's observation       that of `delay` steps ago, plus Gaussian noise, then zeros for lost entries

The equations are in `Faults`, for JAX and for numpy. `variants.Variant` applies them to JAX tasks, and
`seen_environment.FaultyEnvironment` to Gymnasium environments.
"""

import dataclasses
import numbers
from collections.abc import Mapping
from typing import Any, NamedTuple

from beliefrl.errors import UserError, short
from beliefrl.types import LARGEST, check_choice, check_range, tuples

LONGEST_DELAY = 10_000
STREAM = 1_179_406_420  # separates the random numbers of faults from those of the task, which has the same key


class Draws(NamedTuple):
    """The random numbers of one step, arrays of JAX or of numpy."""

    noise: Any  # (obs,), standard normal
    entries: Any  # (obs,), uniform in [0, 1), as are the others
    whole: Any  # ()
    action: Any  # ()


@dataclasses.dataclass(frozen=True)
class Faults:
    """Missing and faulty sensors. By default there are none.

    The agent perceives the true reward, without delay, and the action that it chose.
    """

    noise: float | tuple[float, ...] = 0.0
    """Standard deviation of Gaussian noise that is added to the observation: one number for all entries, or one for
    each entry."""
    flicker: float = 0.0
    """Probability, at each step, that the whole observation is lost. The agent then observes zeros."""
    flicker_flag: bool = False
    """Append an entry to the observation, which is 1 where the whole observation is lost and 0 elsewhere."""
    dropout: float = 0.0
    """Probability, at each step, that an entry of the observation is lost. The agent then observes a zero there."""
    delay: int = 0
    """Number of steps by which the observation is late. At the start of an episode the first one is repeated."""
    sticky: float = 0.0
    """Probability, at each step, that the previous action is applied again in place of the new one. Before the first
    action it is zero, the middle of its range."""

    def __post_init__(self) -> None:
        """Raise a UserError for impossible values."""
        given: Any = self.noise
        several = isinstance(given, list | tuple) or getattr(given, "ndim", 0) == 1
        deviations: tuple[Any, ...] = tuple(given) if several else (given,)
        if not deviations or not all(map(_is_deviation, deviations)):
            shown = " ".join(map(str, deviations)) or "()"
            raise UserError(
                f"noise={shown} is impossible: it must be a number of at least 0, or one for each entry of the "
                "observation."
            )
        deviations = tuple(map(float, deviations))
        noise = 0.0 if not any(deviations) else deviations if several else deviations[0]
        object.__setattr__(self, "noise", noise)
        check_range(self, ("flicker", "dropout", "sticky"), 0, 1)
        check_range(self, ("delay",), 0, LONGEST_DELAY)
        check_choice(self, "flicker_flag", (False, True))

    @classmethod
    def of(cls, settings: "Faults | Mapping[str, Any] | None") -> "Faults":
        """Faults from their `settings`; None: no faults.

        Raises:
            UserError: there is no such fault, or a value is impossible.
        """
        if isinstance(settings, Faults):
            return settings
        if not isinstance(settings, Mapping | None):
            raise UserError(f"faults={short(settings)} is impossible: give Faults(...), or a dictionary of its fields.")
        known = [field.name for field in dataclasses.fields(cls)]
        for name in settings or {}:
            if name not in known:
                raise UserError(f"There is no fault {name!r}: there is {', '.join(known)}.")
        return cls(**tuples(settings or {}))

    def settings(self) -> dict[str, Any]:
        """The fields that differ from their defaults, as runs record them."""
        return {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if getattr(self, field.name) != field.default
        }

    def observed_size(self, size: int) -> int:
        """The number of entries that the agent observes of a task whose observation has `size` entries.

        Raises:
            UserError: `noise` has another number of deviations.
        """
        if isinstance(self.noise, tuple) and len(self.noise) != size:
            entries = "1 entry" if size == 1 else f"{size} entries"
            raise UserError(
                f"noise={' '.join(map(str, self.noise))} has {len(self.noise)} deviations, but the observation has "
                f"{entries}: give one number for all, or one for each entry."
            )
        return size + self.flicker_flag

    def applied(self, xp: Any, action: Any, before: Any, draws: Draws) -> Any:
        """The action (action,) that is applied: `action`, or the one that was applied `before`. `xp`: numpy or jnp."""
        return xp.where(draws.action < self.sticky, before, action)

    def start(self, xp: Any, obs: Any) -> Any:
        """The measurements (delay, obs) on their way to the agent at the start of an episode, the oldest first."""
        return xp.repeat(obs[None], self.delay, axis=0)

    def observe(self, xp: Any, waiting: Any, obs: Any, draws: Draws) -> tuple[Any, Any]:
        """The measurements that are still delayed after this step, and the observation of the agent.

        `waiting` (delay, obs) are the delayed measurements before this step, and `obs` (obs,) is the true observation.
        """
        waiting = xp.concatenate([waiting, obs[None]])
        seen = waiting[0] + xp.asarray(self.noise, draws.noise.dtype) * draws.noise
        lost = draws.whole < self.flicker
        seen = xp.where(lost | (draws.entries < self.dropout), xp.zeros_like(seen), seen)
        if self.flicker_flag:
            seen = xp.concatenate([seen, xp.asarray(lost, seen.dtype)[None]])
        return waiting[1:], seen


def _is_deviation(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and 0 <= float(value) <= LARGEST


NONE = Faults()
