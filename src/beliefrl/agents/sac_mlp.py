"""SAC-MLP: a soft actor-critic on the observation alone, without memory (Haarnoja et al. 2018, 2019).

Source: Section 5, Table 1, Appendix A.2.1. The belief is o_t. This agent has no memory, so its returns show
how much the task needs memory.
"""

import dataclasses
from typing import NamedTuple

import jax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.base import SACAgent, standardise_beliefs
from beliefrl.agents.protocol import Metrics
from beliefrl.models.optimisation import OptimiserState
from beliefrl.models.scales import RunningStatistics, initial_statistics, standardise
from beliefrl.models.soft_actor_critic import Batch, Controller
from beliefrl.types import Spec, Timestep, Window, WindowShape, check_range


class State(NamedTuple):
    """Everything that training changes."""

    controller: Controller
    controller_optimiser: OptimiserState
    scale: RunningStatistics | None  # of observations, if they are standardised


@dataclasses.dataclass(frozen=True)
class SACMLPAgent(SACAgent):
    """Soft actor-critic on the observation alone, without memory (Haarnoja et al. 2018)."""

    batch_size: int = 256
    """Transitions in an update (Appendix F: as many as the other agents')."""
    pretrain_updates: int = 5000
    """Updates of the controller after step_start_rl steps, as many as in VRM's pre-training (Section 5; 0 is off)."""
    standardise: bool = False
    """Standardise the controller's observations to mean 0 and deviation 1, by running statistics."""

    ranges = SACAgent.ranges | {"batch_size": (64, 128, 256, 512), "standardise": (False, True)}

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("batch_size",), 1)
        check_range(self, ("pretrain_updates",), 0)

    @property
    def window(self) -> WindowShape:
        """n + 1 timesteps. Two of them are no transition, and are masked, if an episode ends between them."""
        return WindowShape(burn_in=0, length=self.n_step, least=1)  # only the first transition is learned

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        return self.batch_size * self.cycle_updates

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        scale = initial_statistics(spec.obs_dim) if self.standardise else None
        return State(*self.init_controller(key, spec.obs_dim, spec.action_dim), scale)

    def networks(self, state: State) -> State:
        """The state without its optimisers."""
        return state._replace(controller_optimiser=())

    def reset(self, spec: Spec) -> tuple[()]:
        return ()

    def act(
        self, state: State, memory: tuple[()], step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], tuple[()]]:
        policy = state.controller.actor(standardise(state.scale, step.obs))
        return self.choose(policy, key, explore), memory

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        scale, batch = standardise_beliefs(state.scale, self.batch(windows))
        return self.update(state._replace(scale=scale), batch, key)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        """The batch of each update."""
        scale, batch = standardise_beliefs(state.scale, self.batch(windows))
        batches = jax.tree.map(lambda leaf: leaf.reshape(-1, self.batch_size, *leaf.shape[1:]), batch)
        return state._replace(scale=scale), batches, {}

    def batch(self, windows: Window) -> Batch:
        """The windows' first transitions."""
        return jax.tree.map(lambda leaf: leaf[0], self.transitions(windows, windows.step.obs))
