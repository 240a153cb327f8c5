"""Base classes of the agents: `ControllerAgent` (all agents) and `SACAgent` (the paper's).

Together they have the hyperparameters of Table 1, and the soft actor-critic that these describe.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.hyperparameters import Range
from beliefrl.agents.protocol import Metrics
from beliefrl.errors import UserError
from beliefrl.models.nets import tanh_gaussian
from beliefrl.models.optimisation import Optimisers, OptimiserState, init_optimisers
from beliefrl.models.returns import transition_batch
from beliefrl.models.scales import RunningStatistics, standardise, update_statistics
from beliefrl.models.soft_actor_critic import Batch, Controller, init_controller, loss, update
from beliefrl.types import LARGEST, WIDEST, Window, WindowShape, check_choice, check_range, transitions

MOST_STEPS = 64  # of an n-step return; each step is compiled


@dataclasses.dataclass(frozen=True)
class ControllerAgent:
    """Base class of agents whose controller is a soft actor-critic: its hyperparameters and its actions."""

    gamma: float = 0.99
    """Discount factor γ, in [0, 1] (Table 1)."""
    step_start_rl: int = 1000
    """Environment steps before training starts; the untrained policy acts until then (Table 1)."""
    train_interval_rl: int = 1
    """Environment steps between two updates of the controller (Table 1)."""
    lr_actor: float = 3e-4
    """Adam's learning rate for the actor (Table 1)."""
    lr_critic: float = 3e-4
    """Adam's learning rate for both Q and V (Table 1)."""
    lr_alpha: float = 3e-4
    """Adam's learning rate for log α, the temperature (Table 1)."""
    target_entropy: float | None = None
    """Target entropy of the policy; None is minus the number of action dimensions (Table 1)."""
    tau: float = 0.005
    """Soft-update rate of the target network, in [0, 1] (Table 1)."""
    policy_layers: tuple[int, ...] = (256, 256)
    """Hidden layers of μ and log σ of the policy (Table 1)."""
    value_layers: tuple[int, ...] = (256, 256)
    """Hidden layers of Q and V (Table 1)."""
    actor_regulariser: float = 1e-3
    """Weight of half the mean squares of the policy's μ and σ in the actor's loss (the authors' code; 0 is off)."""

    ranges = {  # for `beliefrl.tune`
        "gamma": Range(0.95, 0.999, "horizon"),
        "lr_actor": Range(1e-4, 3e-3, "log"),
        "lr_critic": Range(1e-4, 3e-3, "log"),
        "lr_alpha": Range(1e-4, 3e-3, "log"),
        "tau": Range(1e-3, 2e-2, "log"),
        "policy_layers": ((64, 64), (128, 128), (256, 256)),
        "value_layers": ((64, 64), (128, 128), (256, 256)),
        "actor_regulariser": (0.0, 1e-4, 1e-3),
    }

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        check_range(self, ("train_interval_rl",), 1)
        check_range(self, ("policy_layers", "value_layers"), 1, WIDEST)
        check_range(self, ("actor_regulariser",), 0)
        check_range(self, ("step_start_rl",), 2)  # fewer timesteps hold no transition
        check_range(self, ("lr_actor", "lr_critic", "lr_alpha", "gamma", "tau"), 0, 1)
        if self.target_entropy is not None:
            check_range(self, ("target_entropy",), -LARGEST)
        for field in dataclasses.fields(self):
            if field.type is bool:
                check_choice(self, field.name, (True, False))

    @property
    def cycle(self) -> int:
        """Environment steps in a cycle: the agent learns at the end of each cycle."""
        return self.train_interval_rl

    @property
    def window(self) -> WindowShape:
        """The windows that the agent learns from."""
        raise NotImplementedError

    @property
    def optimisers(self) -> Optimisers:
        return Optimisers(optax.adam(self.lr_actor), optax.adam(self.lr_critic), optax.adam(self.lr_alpha))

    def choose(
        self,
        policy: tuple[Float[Array, " action"], Float[Array, " action"]],
        key: Key[Array, ""],
        explore: Bool[Array, ""],
    ) -> Float[Array, " action"]:
        """An action of the policy with this μ and log σ: a sample, or its mode if not `explore`."""
        mean, log_sigma = policy
        noise = jnp.where(explore, jax.random.normal(key, mean.shape), 0.0)
        return tanh_gaussian(mean, log_sigma, noise)[0]


@dataclasses.dataclass(frozen=True)
class SACAgent(ControllerAgent):
    """Base class of the paper's agents, whose controller has a V (Table 1)."""

    n_step: int = 1
    """Steps of the critics' n-step returns (the paper: one). More propagate rewards faster over a long horizon."""
    updates_per_step: int = 1
    """Updates of the controller every `train_interval_rl` steps (Table 1: one). With more, learning takes fewer steps,
    and each step takes longer."""
    value_start: float = 0.0
    """Initial output of V and Q, up to noise from the initial weights (the paper: 0), in units of the return."""

    ranges = ControllerAgent.ranges | {"n_step": (1, 3, 5, 10), "updates_per_step": (1, 2, 4)}

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("n_step",), 1, MOST_STEPS)
        check_range(self, ("updates_per_step",), 1)
        check_range(self, ("value_start",), -LARGEST)

    def check_interval(self, name: str) -> None:
        """Refuse an interval between two updates of a model that is no multiple of `train_interval_rl`."""
        if getattr(self, name) % self.train_interval_rl:
            raise UserError(
                f"{name}={getattr(self, name)} is not a multiple of train_interval_rl={self.train_interval_rl}: "
                "choose one that is."
            )

    @property
    def cycle_updates(self) -> int:
        """Updates of the controller in a cycle."""
        return self.cycle // self.train_interval_rl * self.updates_per_step

    @property
    def losses(self) -> tuple[str, ...]:
        """The metrics that stop a seed if they are not finite."""
        return "loss_value", "loss_q", "loss_actor"

    def transitions(
        self,
        windows: Window,
        belief: Float[Array, "time batch belief"],
        next_belief: Float[Array, "time batch belief"] | None = None,
        actor_input: Float[Array, "time batch actor_input"] | None = None,
    ) -> Batch:
        """The transitions of windows after the burn-in, with returns of `n_step` steps; leaves (length, batch, ...).

        Args:
            windows: as the replay returns them.
            belief: at the length + 1 timesteps after the burn-in.
            next_belief: the inputs of V̄ at these timesteps; None: `belief`.
            actor_input: the inputs of the actor at these timesteps; None: `belief`.
        """
        burn_in = self.window.burn_in
        after = belief if next_belief is None else next_belief
        step, valid = windows.between(burn_in, None).step, transitions(windows, burn_in)
        return transition_batch(step, valid, belief, after, self.n_step, self.gamma, actor_input)

    def init_controller(
        self, key: Key[Array, ""], belief: int, action: int, actor_size: int | None = None
    ) -> tuple[Controller, OptimiserState]:
        """A new controller and its optimisers; `actor_size` is the actor's input size if it is not the belief."""
        sizes = belief, action, self.policy_layers, self.value_layers
        controller = init_controller(key, *sizes, actor_size, self.value_start)
        return controller, init_optimisers(self.optimisers, controller.trained)

    def note(self, memory: Any) -> Any:
        """The data that the replay stores with a timestep: none."""
        return ()

    def controller_loss(
        self, controller: Controller, batch: Batch, key: Key[Array, ""]
    ) -> tuple[Float[Array, ""], Metrics]:
        """The sum of the four losses of soft actor-critic, and the metrics."""
        noise = jax.random.normal(key, batch.action.shape)
        return loss(controller, batch, noise, self.actor_regulariser, self.target_entropy)

    def update(self, state: Any, batch: Any, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the controller, of a state with `controller` and `controller_optimiser`."""
        controller, optimiser = state.controller, state.controller_optimiser
        gradient, metrics = jax.grad(self.controller_loss, has_aux=True)(controller, batch, key)
        controller, optimiser = update(self.optimisers, optimiser, controller, gradient, self.tau)
        return state._replace(controller=controller, controller_optimiser=optimiser), metrics


def standardise_beliefs(scale: RunningStatistics | None, batch: Batch) -> tuple[RunningStatistics | None, Batch]:
    """The statistics after a batch (or a cycle's batches), and the batch standardised with them.

    Without statistics the batch is returned unchanged.
    """
    if scale is None:
        return None, batch
    scale = update_statistics(scale, batch.belief, batch.valid)
    belief, next_belief = standardise(scale, batch.belief), standardise(scale, batch.next_belief)
    return scale, batch._replace(belief=belief, next_belief=next_belief)


def split_windows(windows: Window, count: int) -> tuple[Window, Window]:
    """The first `count` windows (time-major), and the others."""
    first = jax.tree.map(lambda leaf: leaf[:, :count], windows)
    return first, jax.tree.map(lambda leaf: leaf[:, count:], windows)


def for_each_update(windows: Any, count: int) -> Any:
    """Split a cycle's windows into those of each update: (time, update · count, ...) to (update, time, count, ...)."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0], -1, count, *leaf.shape[2:]).swapaxes(0, 1), windows)


def split_updates(batch: Any, count: int) -> Any:
    """Split a cycle's transitions by update: (time, update · count, ...) to (update, time · count, ...)."""
    return jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0], -1, *leaf.shape[3:]), for_each_update(batch, count))
