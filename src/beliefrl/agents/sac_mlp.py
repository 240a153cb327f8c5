"""SAC-MLP: a soft actor-critic on the observation alone, without memory (Haarnoja et al. 2018, 2019).

Source: Section 5, Table 1, Appendix A.2.1. The belief is o_t. What the whole state does not tell, this agent cannot
know: it is the measure of how much a task hides.
"""

import dataclasses
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.sac import SAC, Metrics
from beliefrl.soft_actor_critic import Batch, Controller, OptimiserState
from beliefrl.types import Spec, Step, Window, WindowShape, check_range, transitions


class State(NamedTuple):
    """Everything that training changes."""

    controller: Controller
    controller_optimiser: OptimiserState


@dataclasses.dataclass(frozen=True)
class SACMLPAgent(SAC):
    """Soft actor-critic on the observation alone, without memory (Haarnoja et al. 2018)."""

    batch_size: int = 256
    """Transitions in an update (Appendix F: as many as the other agents')."""
    pretrain_updates: int = 5000
    """Updates of the controller at step_start_rl, as many as VRM's pre-training has (Section 5; 0 is off)."""

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("batch_size",), 1)
        check_range(self, ("pretrain_updates",), 0)

    @property
    def cycle(self) -> int:
        return self.train_interval_rl

    @property
    def window(self) -> WindowShape:
        """One transition; where an episode ends between its two moments, it counts nowhere."""
        return WindowShape(burn_in=0, length=1)

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        return self.batch_size

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        return State(*self.init_controller(key, spec.obs_dim, spec.action_dim))

    def reset(self, spec: Spec) -> tuple[()]:
        return ()

    def act(
        self, state: State, memory: tuple[()], step: Step, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], tuple[()]]:
        return self.choose(state.controller, step.obs, key, explore), memory

    def note(self, memory: tuple[()]) -> tuple[()]:
        return ()

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        return self.update(state, self.batch(windows), key)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        """A cycle has one update: its batch."""
        return state, jax.tree.map(lambda leaf: leaf[None], self.batch(windows)), {}

    def batch(self, windows: Window) -> Batch:
        """The windows' transitions."""
        step = windows.step
        return Batch(
            belief=step.obs[:, 0],
            next_belief=step.obs[:, 1],
            action=step.prev_action[:, 1],
            reward=step.reward[:, 1],
            terminated=step.terminated[:, 1],
            valid=transitions(windows, 0)[:, 0],
        )

    def update(self, state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
        controller, optimiser, metrics = self.learn_controller(state.controller, state.controller_optimiser, batch, key)
        return State(controller, optimiser), metrics
