"""Sequential target reaching: visit red, green and blue in that order. The next one is not shown (Section 5.3).

A robot on two wheels moves in a square field. It perceives all three targets. When it reaches the next target of the
order, it gets a reward in that step. It must remember which targets it has already reached.

    forward = speed (a_1 + a_2) / 2 along the old heading;   turn = (a_1 - a_2) / 2 / axle
    r = -0.1 if the robot would leave the field (it stays),  K / (1 + distance) at the next target,  0 otherwise
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.tasks.drawing import BLUE, GREEN, GREY, INK, PALE, PAPER, RED, Circle, Line, Picture, Polygon
from beliefrl.types import Spec, check_range


class TargetReachingState(NamedTuple):
    position: Float[Array, "2"]  # in [0, field]²
    heading: Float[Array, ""]  # rad in [0, 2π)
    targets: Float[Array, "3 2"]  # red, green, blue
    reached: Int[Array, ""]  # number of targets reached, 0 to 3
    reward: Float[Array, ""]  # of the last step


def wall_distance(position: Float[Array, "2"], heading: Float[Array, ""], field: float) -> Float[Array, ""]:
    """Distance from a point in [0, field]² to the wall that a ray along `heading` meets."""
    direction = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    room = jnp.where(direction > 0, field - position, position)
    return jnp.min(room / jnp.maximum(jnp.abs(direction), 1e-6))


@dataclasses.dataclass(frozen=True)
class TargetReaching:
    """Reach three targets in a hidden order (long-term memory): 12 numbers; 2 actions; 128 steps."""

    field: float = 15.0
    """Side length of the field."""
    target_square: float = 4.0
    """Side length of the square in the middle of the field that contains the targets."""
    min_squared_gap: float = 2.0
    """Lower bound of the squared distance between any two targets."""
    radius: float = 0.4
    """A target is reached within this distance."""
    speed: float = 0.8
    """Distance per step at full speed of both wheels."""
    axle: float = 0.5
    """Distance between the wheels: full speed in opposite directions turns the robot by 1 / axle rad per step."""
    rewards: tuple[float, float, float] = (20.0, 50.0, 100.0)
    """Factor K of the reward at the first, second and third target."""
    wall_reward: float = -0.1
    """Reward of a step that would leave the field."""
    scale: float = 3.0
    """A distance d is observed as exp(-d / scale)."""
    max_steps: int = 128
    """Time limit in steps."""

    def __post_init__(self) -> None:
        """Raise a UserError for impossible values."""
        check_range(self, ("field", "radius", "speed", "axle", "scale"), 0.001, 1000)
        check_range(self, ("target_square",), 0.001, self.field)
        check_range(self, ("min_squared_gap",), 0, self.target_square**2 / 2)  # no larger gap fits
        check_range(self, ("rewards", "wall_reward"), -1000, 1000)
        check_range(self, ("max_steps",), 1)

    entry_names: ClassVar[tuple[str, ...]] = (
        *(f"nearness of {what}" for what in ("red", "green", "blue", "wall ahead", "wall behind")),
        *(f"{part} of bearing to {colour}" for part in ("sin", "cos") for colour in ("red", "green", "blue")),
        "last reward",
    )

    @property
    def spec(self) -> Spec:
        return Spec(obs_dim=12, action_dim=2, max_steps=self.max_steps, measures=("success",))

    def draw_targets(self, key: Key[Array, ""]) -> Float[Array, "3 2"]:
        """Three uniform targets in the middle square, redrawn until no two are too close."""
        low, high = (self.field - self.target_square) / 2, (self.field + self.target_square) / 2

        def draw(key: Key[Array, ""]) -> Float[Array, "3 2"]:
            return jax.random.uniform(key, (3, 2), minval=low, maxval=high)

        def too_close(carry: tuple[Key[Array, ""], Float[Array, "3 2"]]) -> Bool[Array, ""]:
            targets = carry[1]
            gaps = jnp.sum((targets - jnp.roll(targets, 1, axis=0)) ** 2, axis=-1)
            return jnp.any(gaps <= self.min_squared_gap)

        def redraw(carry: tuple[Key[Array, ""], Float[Array, "3 2"]]) -> tuple[Key[Array, ""], Float[Array, "3 2"]]:
            key, now = jax.random.split(carry[0])
            return key, draw(now)

        return jax.lax.while_loop(too_close, redraw, redraw((key, jnp.zeros((3, 2)))))[1]

    def observation(self, state: TargetReachingState) -> Float[Array, "12"]:
        """Nearness of red, green, blue and the walls ahead and behind; sin and cos of the bearings; the last reward."""
        offset = state.targets - state.position[None]
        distance = jnp.sqrt(jnp.sum(offset**2, axis=-1))
        bearing = jnp.arctan2(offset[:, 1], offset[:, 0]) - state.heading
        ahead = wall_distance(state.position, state.heading, self.field)
        behind = wall_distance(state.position, state.heading + jnp.pi, self.field)
        near = jnp.exp(-jnp.concatenate([distance, jnp.stack([ahead, behind])]) / self.scale)
        return jnp.concatenate([near, jnp.sin(bearing), jnp.cos(bearing), state.reward[None]])

    def reset(self, key: Key[Array, ""]) -> tuple[TargetReachingState, Float[Array, "12"]]:
        key_position, key_heading, key_targets = jax.random.split(key, 3)
        state = TargetReachingState(
            position=jax.random.uniform(key_position, (2,), maxval=self.field),
            heading=jax.random.uniform(key_heading, (), maxval=2 * jnp.pi),
            targets=self.draw_targets(key_targets),
            reached=jnp.array(0),
            reward=jnp.zeros(()),
        )
        return state, self.observation(state)

    def step(
        self, state: TargetReachingState, action: Float[Array, "2"], key: Key[Array, ""]
    ) -> tuple[TargetReachingState, Float[Array, "12"], Float[Array, ""], Bool[Array, ""]]:
        left, right = jnp.clip(action, -1.0, 1.0)
        direction = jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)])
        moved = state.position + self.speed * (left + right) / 2 * direction
        outside = jnp.any((moved < 0) | (moved > self.field))
        position = jnp.where(outside, state.position, moved)
        turn = jnp.clip((left - right) / 2 / self.axle, -jnp.pi, jnp.pi)

        squared = jnp.sum((position - state.targets[state.reached]) ** 2)
        reached = ~outside & (squared < self.radius**2)
        prize = jnp.array(self.rewards)[state.reached] / (1 + jnp.sqrt(squared))
        reward = jnp.where(outside, self.wall_reward, jnp.where(reached, prize, 0.0))

        heading = (state.heading + turn) % (2 * jnp.pi)
        state = TargetReachingState(position, heading, state.targets, state.reached + reached, reward)
        return state, self.observation(state), reward, state.reached >= 3

    def measures(self, state: TargetReachingState) -> dict[str, Array]:
        return {"success": state.reached >= 3}

    def draw(self, states: Sequence[TargetReachingState]) -> Picture:
        """The field, the targets with a tick on those reached, and the robot with its path so far."""
        state, side, margin = states[-1], self.field, 0.04 * self.field
        corners = [(0, 0), (side, 0), (side, side), (0, side), (0, 0)]
        body, centre = 1.4 * self.radius, np.asarray(state.position)  # larger than a target, so that both are visible
        ahead = np.array([np.cos(state.heading), np.sin(state.heading)])
        across = np.array([-ahead[1], ahead[0]])
        shapes: list[Circle | Line | Polygon] = [
            Line(corners, margin / 2, PALE),
            Line([past.position for past in states], 0.2 * self.radius, GREY),
            Circle(centre, body, INK),
            Polygon([centre + 1.8 * body * ahead, centre + body * across, centre - body * across], INK),
        ]
        for index, colour in enumerate((RED, GREEN, BLUE)):
            at = np.asarray(state.targets[index])
            shapes.append(Circle(at, self.radius, colour))
            if index < state.reached:
                tick = np.array([(-0.45, 0.0), (-0.1, -0.35), (0.45, 0.35)]) * self.radius
                shapes.append(Line(at + tick, 0.25 * self.radius, PAPER))
        return Picture((-margin, -margin), (side + margin, side + margin), shapes)
