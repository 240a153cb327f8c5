"""A trained policy as an ONNX model, which runs without JAX: any batch size, mode actions, the state as inputs.

    session = onnxruntime.InferenceSession("policy.onnx")

Inputs are obs (batch, obs), reward and episode_start (batch,), as in `Policy.predict`, and state_0, state_1, ...: the
state, whose last part is the previous action. Outputs are action (batch, action), and next_state_0, next_state_1, ....
The first state may be zeros, since the state is ignored where episode_start is True.

The packages onnx and onnxruntime are an extra of this library, imported when they are needed.
"""

import contextlib
import importlib
import json
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np

from beliefrl.errors import UserError, said
from beliefrl.onnx.graph import model

LARGEST_DIFFERENCE = 1e-5  # between a policy and its model
CHECKED_STEPS = 200


def export(policy: Any, environment: Callable[[], Any] | None = None) -> tuple[bytes, float]:
    """The ONNX model of a `Policy`, and the largest difference found between the two.

    They are compared in onnxruntime at every timestep of an episode of at most 200 steps: each action, and each number
    of the next state, relative to its size if that is more than 1. The episode is played in an environment that
    `environment` makes. If it is None, or if none can be made here, observations and rewards are random.

    The metadata of the model have a description of the policy, and of a Gymnasium environment the names of the observed
    entries and the bounds of the actions, as lists in JSON.

    Raises:
        UserError: a package is missing, the agent uses a primitive that is not supported, onnxruntime cannot run the
            model, or the difference is more than 1e-5.
    """
    try:
        onnx, runtime = (importlib.import_module(name) for name in ("onnx", "onnxruntime"))
    except ImportError:
        raise UserError("ONNX needs packages that are not installed: pip install 'beliefrl[onnx]'.") from None
    parts = {f"state_{index}": part for index, part in enumerate(policy.initial_state(1))}
    inputs: dict[str, tuple[tuple[int, ...], Any]] = {
        "obs": ((policy.spec.obs_dim,), np.float32),
        "reward": ((), np.float32),
        "episode_start": ((), np.bool_),
        **{name: (part.shape[1:], part.dtype) for name, part in parts.items()},
    }
    outputs = ["action", *(f"next_{name}" for name in parts)]
    interface = {} if policy.interface is None else policy.interface._asdict()
    about = {"policy": repr(policy), **{name: json.dumps(value) for name, value in interface.items()}}
    with jax.enable_x64(False):
        content = model(onnx, policy.mode, inputs, outputs, about)
    session = _session(runtime, content)  # before a robot is started
    with contextlib.closing(_made(environment) or _MadeUp(policy.spec.obs_dim)) as made:
        difference = _largest(policy, session, made)
    if not difference <= LARGEST_DIFFERENCE:
        raise UserError(
            f"The ONNX model differs from the policy by {difference:.1g}, more than {LARGEST_DIFFERENCE:.0e}: export "
            "the policy as a .jax file."
        )
    return content, difference


def _made(environment: Callable[[], Any] | None) -> Any:
    """An environment, or None if there is none here."""
    with contextlib.suppress(UserError):
        return environment and environment()


def _session(runtime: Any, content: bytes) -> Any:
    """The model in onnxruntime, on one thread.

    Raises:
        UserError: onnxruntime cannot run it.
    """
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return runtime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its errors have no common class
        why = said(error)
        raise UserError(f"onnxruntime cannot run the model ({why}): export the policy as a .jax file.") from None


def _largest(policy: Any, session: Any, environment: Any) -> float:
    """The largest difference between a policy and its model along an episode; NaN if the model has one."""
    names = [each.name for each in session.get_inputs()]
    obs, _ = environment.reset(seed=0)
    reward, state, largest = 0.0, policy.initial_state(1), 0.0
    for time in range(CHECKED_STEPS):
        start = np.array([time == 0])
        given = {"obs": np.asarray(obs, np.float32)[None], "reward": np.array([reward], np.float32)}
        given |= {"episode_start": start, **{f"state_{index}": part for index, part in enumerate(state)}}
        outputs = session.run(None, {name: given[name] for name in names})
        action, state = policy.predict(obs, reward, state, start[0])
        for ours, theirs in zip((action[None], *state), outputs, strict=True):
            error = np.abs(theirs.astype(np.float64) - ours) / np.maximum(1.0, np.abs(ours))
            largest = float(np.maximum(largest, np.max(error, initial=0.0)))  # NaN stays, unlike with `max`
        obs, reward, terminated, truncated, _ = environment.step(action)
        if terminated or truncated:
            break
    return largest


class _MadeUp(gymnasium.Env[np.ndarray, np.ndarray]):
    """Observations and rewards from the standard normal distribution."""

    def __init__(self, obs: int):
        self.size = obs

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.normal(size=self.size), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.np_random.normal(size=self.size), float(self.np_random.normal()), False, False, {}
