"""The words that the whole library shares: a moment, a window of moments, a task's sizes, a user's mistake.

Axis names in shapes, everywhere: `seed` (one training each), `batch` (windows), `time` (moments of a window),
`obs`, `action`, `belief` (what the controller reads), `d` (recurrent state), `z` (latent variable), `x` (perception).
"""

import dataclasses
import numbers
import typing
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class UserError(Exception):
    """A mistake that the user can mend. Its message is one sentence: what was wrong, and what to do."""


LARGEST = 2**31 - 1  # integer in a compiled program
WIDEST = 100_000  # layer or state of a network


def check_range(settings: Any, names: Sequence[str], low: int, high: int = LARGEST) -> None:
    """Raise a UserError where a field of a dataclass, or an entry of a tuple there, is no number in [low, high].

    Where the field is declared as int, it must be a whole number; only where it is declared as a tuple, it may be one.
    NaN is in no range, and True is no number.
    """
    declared = {field.name: field.type for field in dataclasses.fields(settings)}
    for name in names:
        value = getattr(settings, name)
        entries = value if isinstance(value, tuple) else (value,)
        whole = declared[name] in (int, tuple[int, ...])
        kind = numbers.Integral if whole else numbers.Real
        numeric = all(isinstance(entry, kind) and not isinstance(entry, bool) for entry in entries)
        numeric &= isinstance(value, tuple) == (typing.get_origin(declared[name]) is tuple)
        if not entries or not numeric or not all(low <= entry <= high for entry in entries):
            too_large = numeric and any(entry > high for entry in entries)
            bounds = f"from {low} to {high}" if too_large or high < LARGEST else f"of at least {low}"
            number = "a whole number" if whole else "a number"
            raise UserError(f"{name}={value} is impossible: it must be {number} {bounds}.")


def check_choice(settings: object, name: str, choices: Sequence[str | bool]) -> None:
    """Raise a UserError where a field of `settings` is none of the choices."""
    if getattr(settings, name) not in choices:
        raise UserError(
            f"{name}={getattr(settings, name)!r} is impossible: it must be {' or '.join(map(str, choices))}."
        )


class Spec(NamedTuple):
    """The sizes of a task, all that an agent learns of it beforehand."""

    obs_dim: int  # numbers in an observation
    action_dim: int  # degrees of freedom; every action lies in [-1, 1]
    max_steps: int  # time limit of an episode: it truncates, it does not terminate
    has_success: bool = False  # whether an episode can succeed, besides its return


class Step(NamedTuple):
    """One moment: what is perceived at t, and what was done just before it.

    Two neighbouring moments are a transition (o_t, a_t, r_t, o_{t+1}) unless the second is_first:
    a_t is the second's prev_action, r_t its reward. An episode's last observation is a moment too.
    """

    obs: Float[Array, "*batch obs"]  # o_t
    reward: Float[Array, "*batch"]  # r_{t-1}, which came with o_t; 0 at the first moment
    prev_action: Float[Array, "*batch action"]  # a_{t-1} in [-1, 1]; zeros at the first moment
    is_first: Bool[Array, "*batch"]  # an episode begins here: the memory is empty
    terminated: Bool[Array, "*batch"]  # o_t is terminal: there is no value beyond it


def perception(step: Step) -> Float[Array, "*batch x"]:
    """x_t = (o_t, r_{t-1})."""
    return jnp.concatenate([step.obs, step.reward[..., None]], axis=-1)


class Moment(NamedTuple):
    """What the replay keeps of a moment: the step, and the agent's own note of it (any pytree, may be empty)."""

    step: Step
    note: Any


class Window(NamedTuple):
    """Moments in a row as the replay returns them; is_first is also set at the oldest moment that exists."""

    step: Step  # leaves (batch, time, ...)
    note: Any
    exists: Bool[Array, "*batch time"]  # False where the window overhangs what is stored


class WindowShape(NamedTuple):
    """How an agent wants to sample: `burn_in` moments, then `length` transitions (so burn_in + length + 1 moments)."""

    burn_in: int
    length: int
    one_episode: bool = False  # windows end with their episode and overhang it, instead of going on with the next


def transitions(window: Window, burn_in: int) -> Bool[Array, "*batch length"]:
    """Which pairs of neighbours after the burn-in are transitions; (..., time) gives (..., time - burn_in - 1)."""
    now, after = window.exists[..., burn_in:-1], window.exists[..., burn_in + 1 :]
    return now & after & ~window.step.is_first[..., burn_in + 1 :]


def time_major(window: Window, start: int, stop: int | None) -> Window:
    """The moments from `start` to `stop` of windows (batch, time, ...) as (time, batch, ...)."""
    return jax.tree.map(lambda leaf: leaf[:, start:stop].swapaxes(0, 1), window)
