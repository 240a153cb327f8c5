"""The recurrent states of the replay's readers: where the unroll of a window starts, and where the next one does.

A reader (`training.replay.read`) reads windows in order. The state at the end of a window is kept, and the next window
of this reader starts from it. It was formed with the weights of some updates ago. After a jump the state is empty, and
what came before is unknown. So nothing is learned from that window until an episode begins in it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from beliefrl.models.nets import LSTMState
from beliefrl.types import Reading, Window, transitions


def of(windows: Window) -> Reading:
    """Which readers have read these windows."""
    assert windows.reading is not None, "the agent's window has readers"
    return windows.reading


def is_known(windows: Window) -> Bool[Array, "time batch"]:
    """Whether a timestep can be learned from: its reader did not just jump, or an episode has begun since."""
    return of(windows).continues[None] | (jnp.cumsum(windows.step.is_first, axis=0) > 0)


def known_transitions(windows: Window) -> Bool[Array, "length batch"]:
    """Whether each pair of neighbouring timesteps is a transition to learn from."""
    return transitions(windows, 0) & is_known(windows)[:-1]


def start(windows: Window, states: LSTMState) -> LSTMState:
    """The state before each window, leaves (batch, d), given those of all readers, leaves (reader, d)."""
    reader, continues = of(windows)
    return jax.tree.map(lambda leaf: jnp.where(continues[:, None], leaf[reader], 0.0), states)


def end(windows: Window, states: LSTMState, unrolled: LSTMState) -> LSTMState:
    """The states of all readers after these windows, given the unroll of the windows, leaves (time, batch, d).

    The last timestep is the first of the reader's next window. So the state before it is kept.
    """
    reader = of(windows).reader
    return jax.tree.map(lambda leaf, new: leaf.at[reader].set(new[-2]), states, unrolled)
