"""SLAC: critics on the latent state of a learned model, an actor on the last observations (Lee et al. 2019).

Source: Lee et al. 2019, Sections 4 and 5; Han, Doya, Tani 2020, Section 5 and Appendix A.2.3. The model
(`latent_model`) is pre-trained and then learns at every step. Q and V read z²_t. The actor reads the last eight
x_t = (o_t, r_{t-1}). At the start of an episode the first x_t is repeated.

Departures: the inference of z²_t starts four timesteps before a sampled sequence. So the critics' beliefs depend on 5
to 12 timesteps. Lee et al. take one transition from each sequence, after 8 timesteps. The beliefs of an update are
inferred with the model before its own update of that step, so that the two computations can run side by side. The
departures of the model are in `latent_model`.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.base import SACAgent, split_updates, split_windows
from beliefrl.agents.hyperparameters import Range
from beliefrl.agents.protocol import Metrics
from beliefrl.models.latent_model import LatentModel, Latents, elbo_terms, predict
from beliefrl.models.nets import Gaussian, draw
from beliefrl.models.optimisation import OptimiserState, descend, valid_mean
from beliefrl.models.soft_actor_critic import Batch, Controller
from beliefrl.types import WIDEST, Spec, Timestep, Window, WindowShape, check_choice, check_range, perception


class State(NamedTuple):
    """Everything that training changes."""

    model: LatentModel
    controller: Controller
    model_optimiser: optax.OptState
    controller_optimiser: OptimiserState


@dataclasses.dataclass(frozen=True)
class SLACAgent(SACAgent):
    """Critics on the latent state of a learned model, an actor on the last 8 timesteps (Lee et al. 2019)."""

    seq_len: int = 8
    """Steps in a sampled sequence (Lee et al. 2019)."""
    batch_size: int = 32
    """Sequences in an update (Lee et al. 2019)."""
    history: int = 8
    """Observations and rewards that the actor reads (Lee et al. 2019)."""
    z1_size: int = 32
    """Size of the latent variable z¹ (Lee et al. 2019)."""
    z2_size: int = 256
    """Size of the latent variable z² (Lee et al. 2019)."""
    model_layers: tuple[int, ...] = (256, 256)
    """Hidden layers of every network of the model (Appendix A.2.3)."""
    lr_model: float = 1e-4
    """Adam's learning rate for the model (Lee et al. 2019)."""
    train_interval_model: int = 1
    """Environment steps between two updates of the model (Lee et al. 2019)."""
    pretrain_updates: int = 5000
    """Updates of the model after step_start_rl steps, as many as in VRM's pre-training (Section 5; 0 is off)."""
    elbo_scaling: Literal["mean", "sum"] = "mean"
    """Mean (the authors' code) or sum (the formula) over the dimensions of z¹, and of observation and reward."""

    ranges = SACAgent.ranges | {
        "lr_model": Range(3e-5, 1e-3, "log"),
        "seq_len": (8, 16),
        "batch_size": (16, 32, 64),
        "z1_size": (16, 32, 64),
        "z2_size": (64, 128, 256),
        "model_layers": ((64, 64), (128, 128), (256, 256)),
    }

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("seq_len",), 2)  # the first timestep of a window trains neither the prior nor the reward
        check_range(self, ("batch_size", "train_interval_model"), 1)
        check_range(self, ("history", "z1_size", "z2_size", "model_layers"), 1, WIDEST)
        check_range(self, ("pretrain_updates",), 0)
        check_range(self, ("lr_model",), 0, 1)
        check_choice(self, "elbo_scaling", ("mean", "sum"))
        self.check_interval("train_interval_model")

    # How it is trained

    @property
    def cycle(self) -> int:
        return self.train_interval_model

    @property
    def window(self) -> WindowShape:
        return WindowShape(self.history - 1, self.seq_len)

    @property
    def losses(self) -> tuple[str, ...]:
        return *super().losses, "negative_elbo"

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        """One batch for the model and one for each update of the controller."""
        return self.batch_size * (1 + self.cycle_updates)

    @property
    def model_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.lr_model)

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        key_model, key_controller = jax.random.split(key)
        sizes = (spec.obs_dim, spec.action_dim, self.z1_size, self.z2_size)
        model = draw(key_model, LatentModel(*sizes, self.model_layers))
        actor_size = self.history * (spec.obs_dim + 1)
        controller, controller_optimiser = self.init_controller(
            key_controller, self.z2_size, spec.action_dim, actor_size
        )
        model_optimiser = self.model_optimiser.init(model)  # pyright: ignore[reportArgumentType]
        return State(model, controller, model_optimiser, controller_optimiser)

    def networks(self, state: State) -> State:
        """The state without its optimisers."""
        return state._replace(model_optimiser=(), controller_optimiser=())

    # Acting

    def reset(self, spec: Spec) -> Float[Array, "history x"]:
        return jnp.zeros((self.history, spec.obs_dim + 1))

    def act(
        self,
        state: State,
        memory: Float[Array, "history x"],
        step: Timestep,
        key: Key[Array, ""],
        explore: Bool[Array, ""],
    ) -> tuple[Float[Array, " action"], Float[Array, "history x"]]:
        x = perception(step)
        memory = jnp.where(step.is_first, x[None], jnp.concatenate([memory[1:], x[None]]))
        return self.choose(state.controller.actor(memory.ravel()), key, explore), memory

    # Predicting

    @property
    def predictors(self) -> tuple[str, ...]:
        return ("latent",)

    def predict(
        self, state: State, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        key1, key2 = jax.random.split(key)
        time = len(observed)
        noise = jax.random.normal(key1, (time, self.z1_size)), jax.random.normal(key2, (time, self.z2_size))
        return predict(state.model, perception(step), step.prev_action, observed, noise)

    # Learning the model

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        gradient, metrics = jax.grad(self.model_loss, has_aux=True)(state.model, windows, key)
        model, optimiser = descend(self.model_optimiser, gradient, state.model_optimiser, state.model)
        return state._replace(model=model, model_optimiser=optimiser), metrics

    def model_loss(self, model: LatentModel, windows: Window, key: Key[Array, ""]) -> tuple[Float[Array, ""], Metrics]:
        """The negative ELBO, mean over the valid timesteps of the sequences."""
        windows = begin_windows(windows.between(self.history - 1, -1))
        step = windows.step
        latents = self.infer(model, windows, key)
        terms = elbo_terms(model, latents, step.obs, step.reward, step.prev_action, step.is_first)
        kl, log_obs, log_reward = (valid_mean(term, windows.exists) for term in terms)
        log_likelihood = log_obs + log_reward
        if self.elbo_scaling == "mean":
            kl, log_likelihood = kl / self.z1_size, log_likelihood / (step.obs.shape[-1] + 1)
        metrics = {"kl": kl, "log_likelihood": log_likelihood, "negative_elbo": kl - log_likelihood}
        return kl - log_likelihood, metrics

    def infer(self, model: LatentModel, windows: Window, key: Key[Array, ""]) -> Latents:
        """The latent variables along windows (time-major)."""
        key1, key2 = jax.random.split(key)
        shape, step = windows.exists.shape, windows.step
        noise = jax.random.normal(key1, (*shape, self.z1_size)), jax.random.normal(key2, (*shape, self.z2_size))
        return model.infer(perception(step), step.prev_action, step.is_first, noise)

    # Learning the controller

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        key_model, key_belief = jax.random.split(key)
        for_model, for_controller = split_windows(windows, self.batch_size)
        batches = self.batches(state.model, for_controller, key_belief)
        state, metrics = self.pretrain(state, for_model, key_model)
        return state, batches, metrics

    def batches(self, model: LatentModel, windows: Window, key: Key[Array, ""]) -> Batch:
        """The windows' transitions with their beliefs, split for a cycle's updates: leaves (update, batch, ...)."""
        burn_in, context = self.window.burn_in, self.history // 2
        inferred = begin_windows(windows.between(burn_in - context, None))
        belief = self.infer(model, inferred, key).z2[context:]
        batch = self.transitions(windows, belief, actor_input=self.histories(windows.step))
        return split_updates(batch, self.batch_size)

    def histories(self, step: Timestep) -> Float[Array, "time batch actor_input"]:
        """The actor's input at each timestep after the burn-in of windows (time-major)."""
        x, time = perception(step), jnp.arange(step.reward.shape[0])
        begun = jax.lax.cummax(jnp.where(step.is_first, time[:, None], 0))  # index of the episode's first timestep
        back = time[self.history - 1 :, None] - jnp.arange(self.history)[::-1][None]
        index = jnp.maximum(back[:, :, None], begun[self.history - 1 :, None])  # (time, history, batch)
        actor_input = x[index, jnp.arange(x.shape[1])].swapaxes(1, 2)
        return actor_input.reshape(*actor_input.shape[:2], -1)


def begin_windows(windows: Window) -> Window:
    """The windows (time-major), each as the beginning of an episode. First timesteps have no previous action."""
    first = windows.step.is_first.at[0].set(True)
    prev_action = jnp.where(first[..., None], 0.0, windows.step.prev_action)
    return windows._replace(step=windows.step._replace(is_first=first, prev_action=prev_action))
