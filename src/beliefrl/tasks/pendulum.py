"""Pendulum: swing a weight up and hold it there (Gymnasium's Pendulum-v1; Appendix B).

θ̈ = 3g / (2l) sin θ + 3 / (m l²) u,   u = 2 a,   θ = 0 upright
r = -(θ² + 0.1 θ̇² + 0.001 u²),   with θ wrapped to [-π, π)
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from beliefrl.tasks.drawing import BLUE, INK, PALE, Circle, Line, Picture
from beliefrl.types import Spec, check_range


class PendulumState(NamedTuple):
    theta: Float[Array, ""]  # rad, 0 upright, not wrapped
    theta_dot: Float[Array, ""]  # rad/s


@dataclasses.dataclass(frozen=True)
class Pendulum:
    """Swing a pendulum up and hold it: cos θ, sin θ, θ̇; 1 action; 200 steps."""

    gravity: float = 10.0
    """m/s²."""
    mass: float = 1.0
    """kg."""
    length: float = 1.0
    """m."""
    max_torque: float = 2.0
    """N m, at action 1."""
    max_speed: float = 8.0
    """rad/s, limit of the angular speed."""
    dt: float = 0.05
    """s, duration of a step."""
    max_steps: int = 200
    """Time limit in steps."""

    entry_names: ClassVar[tuple[str, ...]] = ("cos θ", "sin θ", "θ̇ (rad/s)")
    VELOCITIES: ClassVar[tuple[int, ...]] = (2,)
    POSITIONS: ClassVar[tuple[int, ...]] = (0, 1)

    def __post_init__(self) -> None:
        """Raise a UserError for impossible values."""
        check_range(self, ("mass", "length", "max_torque", "max_speed"), 0.001, 1000)
        check_range(self, ("gravity",), 0, 1000)
        check_range(self, ("dt",), 0.0001, 1)
        check_range(self, ("max_steps",), 1)

    @property
    def spec(self) -> Spec:
        return Spec(obs_dim=3, action_dim=1, max_steps=self.max_steps)

    def observation(self, state: PendulumState) -> Float[Array, "3"]:
        return jnp.stack([jnp.cos(state.theta), jnp.sin(state.theta), state.theta_dot])

    def reset(self, key: Key[Array, ""]) -> tuple[PendulumState, Float[Array, "3"]]:
        theta, theta_dot = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        state = PendulumState(theta * jnp.pi, theta_dot)
        return state, self.observation(state)

    def step(
        self, state: PendulumState, action: Float[Array, "1"], key: Key[Array, ""]
    ) -> tuple[PendulumState, Float[Array, "3"], Float[Array, ""], Bool[Array, ""]]:
        theta, theta_dot = state
        torque = self.max_torque * jnp.clip(action[0], -1.0, 1.0)
        angle = (theta + jnp.pi) % (2 * jnp.pi) - jnp.pi
        reward = -(angle**2 + 0.1 * theta_dot**2 + 0.001 * torque**2)

        acceleration = 1.5 * self.gravity / self.length * jnp.sin(theta) + 3.0 / (self.mass * self.length**2) * torque
        theta_dot = jnp.clip(theta_dot + acceleration * self.dt, -self.max_speed, self.max_speed)
        state = PendulumState(theta + theta_dot * self.dt, theta_dot)
        return state, self.observation(state), reward, jnp.array(False)

    def draw(self, states: Sequence[PendulumState]) -> Picture:
        """The rod, its hub, and the path of its tip in the last half second. θ grows anticlockwise."""
        angles = np.array([state.theta for state in states[-round(0.5 / self.dt) - 1 :]])
        fine = np.interp(np.linspace(0, len(angles) - 1, 8 * len(angles)), np.arange(len(angles)), angles)
        path = self.length * np.stack([-np.sin(fine), np.cos(fine)], axis=-1)
        size, hub = self.length, (0.0, 0.0)
        shapes = [
            Line(path, 0.08 * size, PALE),
            Line([hub, path[-1]], 0.17 * size, BLUE),
            Circle(hub, 0.045 * size, INK),
        ]
        return Picture((-1.3 * size, -1.3 * size), (1.3 * size, 1.3 * size), shapes)
