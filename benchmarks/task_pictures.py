"""Draw the tasks' pictures in docs/pictures: `python benchmarks/task_pictures.py`."""

import pathlib

import jax
import jax.numpy as jnp
from PIL import Image

import beliefrl
from beliefrl.tasks.cartpole import CartPoleState
from beliefrl.tasks.drawing import paint
from beliefrl.tasks.pendulum import PendulumState
from beliefrl.tasks.target_reaching import TargetReachingState

FOLDER = pathlib.Path(__file__).parents[1] / "docs" / "pictures"


def play(name, state, act, steps):
    """The states of a task from `state` on, with the actions `act(state)`, as a picture in this folder."""
    task, states = beliefrl.make_task(name), [state]
    step = jax.jit(task.step)
    for _ in range(steps):
        states.append(step(states[-1], act(states[-1]), jax.random.key(0))[0])
    Image.fromarray(paint(task.draw(states))).quantize(64).save(FOLDER / f"{name}.png", optimize=True)


def towards(state):
    """Turn to the target that is due, and drive."""
    offset = state.targets[jnp.minimum(state.reached, 2)] - state.position
    turn = jnp.arctan2(offset[1], offset[0]) - state.heading
    turn = 0.5 * ((turn + jnp.pi) % (2 * jnp.pi) - jnp.pi)
    drive = jnp.clip(jnp.linalg.norm(offset), 0.3, 0.5)
    return jnp.stack([drive + turn, drive - turn])


play("pendulum", PendulumState(jnp.array(2.6), jnp.array(-7.0)), lambda state: jnp.zeros(1), 10)
play("cartpole", CartPoleState(*jnp.array([0.6, 0.0, 0.1, 0.0])), lambda state: jnp.zeros(1), 3)
field = TargetReachingState(
    position=jnp.array([1.5, 3.0]),
    heading=jnp.array(1.2),
    targets=jnp.array([[6.0, 9.0], [9.2, 6.3], [8.6, 9.1]]),
    reached=jnp.array(0),
    reward=jnp.zeros(()),
)
play("target-reaching", field, towards, 32)
