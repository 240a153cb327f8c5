"""Checks of a task in JAX, before anything is compiled."""

from typing import Any

import jax
import jax.numpy as jnp

from beliefrl.errors import UserError, said, short
from beliefrl.types import Spec, check_whole


def check_traced(task: Any, name: str) -> None:
    """Trace `reset` and `step` of a task, and compare what they return with its `spec`.

    Raises:
        UserError: one of them raises an error or returns another number of values; an observation is not (obs,); the
            reward is no float; `terminated` is no bool; or `step` returns a state with other arrays than `reset`.
    """
    spec = task.spec
    key, action = jax.random.key(0), jax.ShapeDtypeStruct((spec.action_dim,), jnp.zeros(()).dtype)
    state, first = _returned(f"reset of {name}", 2, task.reset, key)
    after, obs, reward, terminated = _returned(f"step of {name}", 4, task.step, state, action, key)
    for of, value in {"reset": first, "step": obs}.items():
        if _shape(value) != (spec.obs_dim,) or value.dtype != first.dtype:
            raise UserError(
                f"{of} of {name} returns an observation that is {_described(value)}: its spec says shape "
                f"{(spec.obs_dim,)}, and reset and step must agree in type."
            )
    if _shape(reward) != () or reward.dtype != action.dtype:
        raise UserError(f"step of {name} returns a reward that is {_described(reward)}: return one {action.dtype}.")
    if _shape(terminated) != () or terminated.dtype != jnp.bool_:
        raise UserError(f"step of {name} returns no bool for terminated: return an array of shape () and type bool.")
    if _arrays(state) != _arrays(after):
        raise UserError(f"step of {name} returns a state with other shapes or types than reset: return the same.")


def check_spec(task: Any) -> None:
    """Raise a UserError if a size in a JAX task's `spec` is no whole number from 1, or its measures have no method.

    A task with action repeat has the spec of another task, which was checked before.
    """
    name, spec = type(task).__name__, task.spec
    if not isinstance(spec, Spec):
        raise UserError(f"{name}.spec is {short(spec)}: give a beliefrl.Spec.")
    for size in ("obs_dim", "action_dim", "max_steps"):
        check_whole(f"{size} of {name}.spec", getattr(spec, size), 1)
    if spec.measures and not callable(getattr(task, "measures", None)):
        raise UserError(f"{name} has measures in its spec, but no method measures(state).")


def _returned(what: str, count: int, function: Any, *args: Any) -> tuple[Any, ...]:
    """The shapes and types of what a method returns."""
    try:
        found = jax.eval_shape(function, *args)
    except UserError:
        raise
    except Exception as error:  # a task may raise anything
        raise UserError(f"{what} cannot be traced: {said(error)}.") from None
    if not isinstance(found, tuple) or len(found) != count:
        values = {2: "(state, observation)", 4: "(state, observation, reward, terminated)"}[count]
        raise UserError(f"{what} does not return {values}.")
    return found


def _shape(value: Any) -> Any:
    return getattr(value, "shape", None)


def _described(value: Any) -> str:
    return "no array" if _shape(value) is None else f"{value.dtype} of shape {value.shape}"


def _arrays(state: Any) -> Any:
    leaves, structure = jax.tree.flatten(state)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
