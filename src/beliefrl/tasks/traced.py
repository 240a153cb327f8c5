"""Checks of a task in JAX, before anything is compiled."""

from typing import Any

import jax
import jax.numpy as jnp

from beliefrl.types import UserError, check_whole, said


def check_traced(task: Any, name: str) -> None:
    """Trace `reset` and `step` of a task, and compare what they return with its `spec`.

    Raises:
        UserError: one of them raises an error or returns another number of values; a size in `spec` is no number from
            1; an observation is not (obs,); the reward is no number; `terminated` is no bool; or `step` returns a
            state with other arrays than `reset`.
    """
    spec = task.spec
    for size in ("obs_dim", "action_dim", "max_steps"):
        check_whole(f"{size} of {name}.spec", getattr(spec, size, None), 1)
    key, action = jax.random.key(0), jax.ShapeDtypeStruct((spec.action_dim,), jnp.float32)
    state, first = _returned(f"reset of {name}", 2, task.reset, key)
    after, obs, reward, terminated = _returned(f"step of {name}", 4, task.step, state, action, key)
    for of, value in {"reset": first, "step": obs}.items():
        if _shape(value) != (spec.obs_dim,):
            raise UserError(
                f"{of} of {name} returns an observation of shape {_shape(value)}, but its spec says {(spec.obs_dim,)}."
            )
    if _shape(reward) != ():
        raise UserError(f"step of {name} returns a reward of shape {_shape(reward)}: return one number.")
    if _shape(terminated) != () or terminated.dtype != jnp.bool_:
        raise UserError(f"step of {name} returns no bool for terminated: return an array of shape () and type bool.")
    if _arrays(state) != _arrays(after):
        raise UserError(f"step of {name} returns a state with other shapes or types than reset: return the same.")


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


def _arrays(state: Any) -> Any:
    leaves, structure = jax.tree.flatten(state)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
