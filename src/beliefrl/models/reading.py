"""From the windows of the replay's readers to transitions: where unrolls start, what is learned from, the pool.

A reader (`training.replay.read`) reads windows in order. The state at the end of a window is kept, and the next window
of this reader starts from it. It was formed with the weights of some updates ago. After a jump the state is empty, and
what came before is unknown. So nothing is learned from that window until an episode begins in it.

The transitions of the last cycles go into a pool, from which the batches of `predictive-sac` are drawn.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from beliefrl.models.double_q import Samples
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


class Pool(NamedTuple):
    """The transitions of the last cycles, beliefs not standardised.

    A target is computed once, when its transition enters the pool.
    """

    transitions: Samples  # leaves (cycles that fit, transitions of a cycle, ...)
    cycles: Int[Array, ""]  # so far

    @classmethod
    def empty(cls, room: tuple[int, int], belief: int, action: int) -> "Pool":
        """A pool with room for so many cycles of so many transitions, given the sizes of beliefs and actions."""

        def zeros(*shape: int) -> Float[Array, "cycles transitions *shape"]:
            return jnp.zeros((*room, *shape))

        samples = Samples(zeros(belief), zeros(action), zeros(), zeros().astype(bool))
        return cls(samples, jnp.zeros((), int))

    def add(self, samples: Samples) -> "Pool":
        """The same with the transitions (length, batch, ...) of one more cycle in place of those of the oldest."""
        index = self.cycles % len(self.transitions.target)

        def write(ring: Array, new: Array) -> Array:
            return ring.at[index].set(new.reshape(-1, *new.shape[2:]))

        return Pool(jax.tree.map(write, self.transitions, samples), self.cycles + 1)

    def draw(self, key: Key[Array, ""], shape: tuple[int, int]) -> Samples:
        """Transitions drawn uniformly, leaves (*shape, ...); they include transitions that are not `valid`."""
        cycles, count = self.transitions.target.shape
        index = jax.random.randint(key, shape, 0, jnp.minimum(self.cycles, cycles) * count)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[index], self.transitions)
