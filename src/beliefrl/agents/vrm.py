"""VRM: a soft actor-critic on the belief that two variational recurrent models form (Han, Doya, Tani 2020).

Source: Section 4, Algorithm 1, Tables 1 and 2, Appendix A.1; the ablations: Appendix C. The belief is
s_t = [d_t of the first-impression model, d_t of the keep-learning model, x_t] with x_t = (o_t, r_{t-1}). The first
model is pre-trained once and does not change afterwards. The second learns during the whole training. The controller
learns on the belief, and its gradient does not reach the models. In an ablation the belief has the d_t of one model, or
both models are deterministic.

Departures:
1. The first-impression model's d_t is computed once, when the timestep is perceived, and stored in the replay
   (`store_first_impression`). The model does not change any more. So there are two differences: z is not sampled anew,
   and d_t summarises the whole episode, and not only the burn-in and what follows.
2. All updates of a cycle of `train_interval_klvrm` steps are made at its end: first one of the keep-learning model,
   then those of the controller. The model does not change between the latter, so one unroll gives all their beliefs.
3. If the agent does not explore, z is the posterior's mean, so that a mode action also has a belief without noise.
"""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.base import SACAgent, split_updates, split_windows, standardise_beliefs
from beliefrl.agents.hyperparameters import Range
from beliefrl.agents.protocol import Metrics
from beliefrl.errors import UserError
from beliefrl.models.nets import Gaussian, LSTMState, draw
from beliefrl.models.optimisation import OptimiserState, descend
from beliefrl.models.scales import RunningStatistics, initial_statistics, standardise
from beliefrl.models.soft_actor_critic import Batch, Controller
from beliefrl.models.variational_model import VRM, predict
from beliefrl.models.window_loss import draw_noise, model_loss, states
from beliefrl.types import WIDEST, Spec, Timestep, Window, WindowShape, check_choice, check_range, perception


class Memory(NamedTuple):
    """The recurrent states of an actor."""

    first: LSTMState | None
    keep: LSTMState | None


class State(NamedTuple):
    """Everything that training changes."""

    first: VRM | None  # the first-impression model
    keep: VRM | None  # the keep-learning model
    controller: Controller
    first_optimiser: optax.OptState
    keep_optimiser: optax.OptState
    controller_optimiser: OptimiserState
    scale: RunningStatistics | None  # of beliefs, if they are standardised


@dataclasses.dataclass(frozen=True)
class VRMAgent(SACAgent):
    """Two variational recurrent models form a belief, a soft actor-critic acts on it (Han, Doya, Tani 2020)."""

    # Table 2: of this agent
    train_times_fivrm: int = 5000
    """Updates in the first-impression model's pre-training (Table 2)."""
    train_interval_klvrm: int = 5
    """Environment steps between two updates of the keep-learning model (Table 2)."""
    lr_model: float = 8e-4
    """Adam's learning rate for both models (Table 2)."""
    seq_len: int = 64
    """Steps in a sampled sequence (Table 2)."""
    batch_size: int = 4
    """Sequences in an update (Table 2)."""

    # Appendix A.1
    burn_in: int = 64
    """Burn-in: at most this many steps before a sequence initialise its state (Appendix A.1.2). It starts from zero, or
    with store_state from the stored state."""
    d_size: int = 256
    """Size of the recurrent state d of each model (Appendix A.1.1)."""
    z_size: int = 64
    """Size of the latent variable z (Appendix A.1.1)."""
    hidden_size: int = 128
    """Width of every hidden layer of the models (Appendix A.1.1)."""

    # Appendix C: ablations
    models: Literal["both", "single", "first", "keep"] = "both"
    """Both models; a single one that is pre-trained and keeps learning; only the first-impression model; or only
    the keep-learning model, which is not pre-trained."""
    deterministic: bool = False
    """Models without noise. Their loss is the mean squared error of the predicted x, in place of the ELBO."""

    # What the paper leaves open
    elbo_scaling: Literal["mean", "sum"] = "mean"
    """Mean (the authors' code; lr_model was tuned on it) or sum (the formula) over the dimensions of z and x."""
    decode_from: Literal["posterior", "prior"] = "posterior"
    """Distribution of z when x is decoded in training: posterior (a true ELBO) or prior (the authors' code)."""
    store_first_impression: bool = True
    """Store the first-impression model's d in the replay, and do not compute it again for every update."""
    store_state: bool = False
    """Store the keep-learning model's state in the replay. After the pre-training its burn-ins then start from it, and
    not from zero. It is meant for a shorter `burn_in`, which takes less time."""
    sample_belief: bool = True
    """Form beliefs with a sample of z, as in the training of the models; if False, with the posterior's mean."""
    standardise: bool = False
    """Standardise the controller's beliefs to mean 0 and deviation 1, by running statistics."""

    ranges = SACAgent.ranges | {
        "lr_model": Range(2e-4, 2e-3, "log"),
        "seq_len": (16, 32, 64),
        "batch_size": (4, 8, 16),
        "d_size": (64, 128, 256),
    }
    network_settings = ("deterministic",)
    note_settings = ("store_first_impression", "store_state")

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("seq_len", "batch_size", "train_interval_klvrm"), 1)
        check_range(self, ("d_size", "z_size", "hidden_size"), 1, WIDEST)
        check_range(self, ("burn_in", "train_times_fivrm"), 0)
        check_range(self, ("lr_model",), 0, 1)
        check_choice(self, "models", ("both", "single", "first", "keep"))
        check_choice(self, "elbo_scaling", ("mean", "sum"))
        check_choice(self, "decode_from", ("posterior", "prior"))
        if self.store_state and (not self.burn_in or not self.has_keep):
            raise UserError(
                "store_state=True is impossible without a burn-in and a keep-learning model: "
                "set burn_in to at least 1, and models to another value than 'first'."
            )
        self.check_interval("train_interval_klvrm")

    # How it is trained

    @property
    def has_first(self) -> bool:
        """Whether there is a first-impression model, which does not change after its pre-training."""
        return self.models in ("both", "first")

    @property
    def has_keep(self) -> bool:
        """Whether there is a keep-learning model, which is updated during the whole training."""
        return self.models != "first"

    @property
    def pretrain_updates(self) -> int:
        return 0 if self.models == "keep" else self.train_times_fivrm

    @property
    def cycle(self) -> int:
        return self.train_interval_klvrm

    @property
    def window(self) -> WindowShape:
        return WindowShape(self.burn_in, self.seq_len)

    @property
    def losses(self) -> tuple[str, ...]:
        return *super().losses, "negative_elbo", "prediction_error"

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        """One batch for the keep-learning model and one for each update of the controller."""
        return self.batch_size * (self.has_keep + self.cycle_updates)

    @property
    def model_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.lr_model)

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        key_models, key_controller = jax.random.split(key)
        x = spec.obs_dim + 1
        bounds = VRM(x, spec.action_dim, self.d_size, self.z_size, self.hidden_size, self.deterministic)
        first, keep = draw(key_models, (bounds if self.has_first else None, bounds if self.has_keep else None))
        belief = (self.has_first + self.has_keep) * self.d_size + x
        controller, controller_optimiser = self.init_controller(key_controller, belief, spec.action_dim)
        models: Any = first, keep
        of_first, of_keep = map(self.model_optimiser.init, models)
        scale = initial_statistics(belief) if self.standardise else None
        return State(first, keep, controller, of_first, of_keep, controller_optimiser, scale)

    def networks(self, state: State) -> State:
        """The state without its optimisers."""
        return state._replace(first_optimiser=(), keep_optimiser=(), controller_optimiser=())

    # Acting (Figure 2b)

    def reset(self, spec: Spec) -> Memory:
        empty = LSTMState.empty(self.d_size)
        return Memory(empty if self.has_first else None, empty if self.has_keep else None)

    def perceive(
        self, vrm: VRM | None, memory: LSTMState | None, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> LSTMState | None:
        """One model's state after one more timestep."""
        if vrm is None:
            return None
        noise = jnp.where(explore & self.sample_belief, jax.random.normal(key, (self.z_size,)), 0.0)
        start = jax.tree.map(lambda leaf: leaf[None], memory)
        inputs = (perception(step), step.prev_action, step.is_first, noise)
        inferred = vrm.infer(start, *(leaf[None, None] for leaf in inputs))
        return jax.tree.map(lambda leaf: leaf[0, 0], inferred.state)

    def act(
        self, state: State, memory: Memory, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Memory]:
        key_first, key_keep, key_action = jax.random.split(key, 3)
        memory = Memory(
            self.perceive(state.first, memory.first, step, key_first, explore),
            self.perceive(state.keep, memory.keep, step, key_keep, explore),
        )
        belief = jnp.concatenate([*(part.d for part in memory if part is not None), perception(step)])
        policy = state.controller.actor(standardise(state.scale, belief))
        return self.choose(policy, key_action, explore), memory

    def note(self, memory: Memory) -> tuple[Float[Array, " d"], ...]:
        """d_t of the first-impression model, then the state of the keep-learning model, if they are stored."""
        first = (memory.first.d,) if self.store_first_impression and memory.first is not None else ()
        return (*first, *memory.keep) if self.store_state and memory.keep is not None else first

    # Predicting (Appendix "Model Accuracy")

    @property
    def predictors(self) -> tuple[str, ...]:
        return ("keep",) * self.has_keep + ("first",) * self.has_first

    def predict(
        self, state: State, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        x, keys = perception(step), jax.random.split(key)
        noise = jax.random.normal(keys[0], (len(x), self.z_size)), jax.random.normal(keys[1], x.shape)
        return predict(getattr(state, model), x, step.prev_action, observed, noise)

    # Learning the models (Figure 2c)

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        if state.first is None:
            return self.learn_keep(state, windows, key)
        first, optimiser, metrics = self.learn_model(state.first, state.first_optimiser, windows, key)
        return state._replace(first=first, first_optimiser=optimiser), metrics

    def learn_keep(
        self, state: State, windows: Window, key: Key[Array, ""], known: LSTMState | None = None
    ) -> tuple[State, Metrics]:
        """One update of the keep-learning model, if there is one; `known` as in `learn_model`."""
        if state.keep is None:
            return state, {}
        keep, optimiser, metrics = self.learn_model(state.keep, state.keep_optimiser, windows, key, known)
        return state._replace(keep=keep, keep_optimiser=optimiser), metrics

    def learn_model(
        self, vrm: VRM, optimiser: optax.OptState, windows: Window, key: Key[Array, ""], known: LSTMState | None = None
    ) -> tuple[VRM, optax.OptState, Metrics]:
        """One Adam step on the loss of `seq_len` timesteps after the burn-in; `known` as in `window_loss.states`."""
        options = self.burn_in, known, self.elbo_scaling, self.decode_from
        grads, metrics = jax.grad(model_loss, has_aux=True)(vrm, windows, key, *options)
        return *descend(self.model_optimiser, grads, optimiser, vrm), metrics

    def stored_state(self, windows: Window) -> LSTMState | None:
        """The keep-learning model's states of the first timestep of windows, leaves (batch, d), if they are stored."""
        return LSTMState(*(leaf[0] for leaf in windows.note[-2:])) if self.store_state else None

    # Learning the controller (Figure 2a)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        key_model, key_belief = jax.random.split(key)
        for_model, for_controller = split_windows(windows, self.batch_size * self.has_keep)
        state, metrics = self.learn_keep(state, for_model, key_model, self.stored_state(for_model))
        scale, batches = standardise_beliefs(state.scale, self.batches(state, for_controller, key_belief))
        return state._replace(scale=scale), batches, metrics

    def belief_noise(self, key: Key[Array, ""], windows: Window) -> Float[Array, "time batch z"]:
        """The noise of z in beliefs; zeros if they are formed with the posterior's mean."""
        noise = draw_noise(key, windows, self.z_size)
        return noise if self.sample_belief else jnp.zeros_like(noise)

    def batches(self, state: State, windows: Window, key: Key[Array, ""]) -> Batch:
        """The windows' transitions with their beliefs, split for a cycle's updates: leaves (update, batch, ...)."""
        of_first, of_keep = (self.belief_noise(k, windows) for k in jax.random.split(key))
        parts = [perception(windows.step)]
        if state.keep is not None:
            parts.insert(0, states(state.keep, windows, of_keep, self.stored_state(windows)).d)
        if state.first is not None:
            stored = self.store_first_impression
            parts.insert(0, windows.note[0] if stored else states(state.first, windows, of_first).d)
        belief = jnp.concatenate([part[self.burn_in :] for part in parts], axis=-1)
        return split_updates(self.transitions(windows, belief), self.batch_size)
