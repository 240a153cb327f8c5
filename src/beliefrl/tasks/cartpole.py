"""CartPole with a continuous force: keep a pole upright on a cart (Gymnasium's physics; Appendix B).

temp = (F + m_p l θ̇² sin θ) / m,   F = 30 a,   m = m_c + m_p
θ̈ = (g sin θ - cos θ temp) / (l (4/3 - m_p cos² θ / m))
ẍ = temp - m_p l θ̈ cos θ / m,   integrated with explicit Euler steps
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.tasks.drawing import BLUE, GREY, INK, PALE, RED, Circle, Line, Picture, Polygon
from beliefrl.types import Spec, check_range

START = 0.05  # all four entries of the initial state are in [-START, START]


class CartPoleState(NamedTuple):
    x: Float[Array, ""]  # m, 0 in the middle of the track
    x_dot: Float[Array, ""]  # m/s
    theta: Float[Array, ""]  # rad, 0 upright
    theta_dot: Float[Array, ""]  # rad/s


@dataclasses.dataclass(frozen=True)
class CartPole:
    """Keep a pole upright on a cart that stays on its track: x, ẋ, θ, θ̇; 1 action; 1000 steps."""

    gravity: float = 9.8
    """m/s²."""
    cart_mass: float = 1.0
    """kg."""
    pole_mass: float = 0.1
    """kg."""
    half_length: float = 0.5
    """m, from the hinge to the pole's centre of mass."""
    force: float = 30.0
    """N, at action 1."""
    dt: float = 0.02
    """s, duration of a step."""
    max_x: float = 2.4
    """m, distance from the middle at which the episode terminates."""
    max_theta: float = 0.20943951023931956
    """rad, angle at which the episode terminates: 12°."""
    max_steps: int = 1000
    """Time limit in steps."""

    entry_names: ClassVar[tuple[str, ...]] = ("x (m)", "ẋ (m/s)", "θ (rad)", "θ̇ (rad/s)")
    VELOCITIES: ClassVar[tuple[int, ...]] = (1, 3)
    POSITIONS: ClassVar[tuple[int, ...]] = (0, 2)

    def __post_init__(self) -> None:
        """Raise a UserError for impossible values."""
        check_range(self, ("cart_mass", "pole_mass", "half_length", "force"), 0.001, 1000)
        check_range(self, ("gravity",), 0, 1000)
        check_range(self, ("dt",), 0.0001, 1)
        check_range(self, ("max_x",), START, 1000)
        check_range(self, ("max_theta",), START, 3)  # less than half a turn
        check_range(self, ("max_steps",), 1)

    @property
    def spec(self) -> Spec:
        return Spec(obs_dim=4, action_dim=1, max_steps=self.max_steps)

    def reset(self, key: Key[Array, ""]) -> tuple[CartPoleState, Float[Array, "4"]]:
        obs = jax.random.uniform(key, (4,), minval=-START, maxval=START)
        return CartPoleState(*obs), obs

    def step(
        self, state: CartPoleState, action: Float[Array, "1"], key: Key[Array, ""]
    ) -> tuple[CartPoleState, Float[Array, "4"], Float[Array, ""], Bool[Array, ""]]:
        x, x_dot, theta, theta_dot = state
        force = self.force * jnp.clip(action[0], -1.0, 1.0)
        mass = self.cart_mass + self.pole_mass
        sin, cos = jnp.sin(theta), jnp.cos(theta)

        temp = (force + self.pole_mass * self.half_length * theta_dot**2 * sin) / mass
        theta_acc = (self.gravity * sin - cos * temp) / (self.half_length * (4 / 3 - self.pole_mass * cos**2 / mass))
        x_acc = temp - self.pole_mass * self.half_length * theta_acc * cos / mass

        state = CartPoleState(
            x + self.dt * x_dot, x_dot + self.dt * x_acc, theta + self.dt * theta_dot, theta_dot + self.dt * theta_acc
        )
        terminated = (jnp.abs(state.x) > self.max_x) | (jnp.abs(state.theta) > self.max_theta)
        return state, jnp.stack(state), jnp.array(1.0), terminated

    def draw(self, states: Sequence[CartPoleState]) -> Picture:
        """The cart on its track, the ends of the track, the pole, and its permitted range of angles."""
        x, theta = float(states[-1].x), float(states[-1].theta)
        size = 2 * self.half_length
        hinge = (x, 0.0)

        def tip(angle: float, length: float = size) -> tuple[float, float]:
            return x + length * math.sin(angle), length * math.cos(angle)

        room = [tip(share * self.max_theta, 1.15 * size) for share in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        shapes = [
            Polygon([hinge, *room], PALE),
            Line([(-self.max_x, -0.2), (self.max_x, -0.2)], 0.03, INK),
            *(Line([(end, -0.3), (end, -0.1)], 0.05, RED) for end in (-self.max_x, self.max_x)),
            Polygon([(x - 0.28, -0.12), (x + 0.28, -0.12), (x + 0.28, 0.1), (x - 0.28, 0.1)], INK),
            *(Circle((x + side, -0.11), 0.075, GREY) for side in (-0.16, 0.16)),
            Line([hinge, tip(theta)], 0.09, BLUE),
            Circle(hinge, 0.03, PALE),
        ]
        return Picture((-self.max_x - 0.4, -0.45), (self.max_x + 0.4, 1.15 * size + 0.15), shapes, pixels=640)
