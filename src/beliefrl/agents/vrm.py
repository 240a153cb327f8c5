"""VRM: a soft actor-critic on the belief that two variational recurrent models form (Han, Doya, Tani 2020).

Source: Section 4, Algorithm 1, Tables 1 and 2, Appendix A.1. The belief is s_t = [d_t of the first-impression model,
d_t of the keep-learning model, x_t] with x_t = (o_t, r_{t-1}). The first model is pre-trained once and then never
changes; the second learns all the time; the controller learns on the belief and sends no gradient back.

Departures:
1. The first-impression d_t is computed once, when it is perceived, and kept in the replay (`store_first_impression`):
   the model does not change any more, so only the sample of z is not drawn anew.
2. A cycle of `train_interval_klvrm` steps draws its windows at its beginning: between two of its updates the
   keep-learning model stands still, so one unroll gives the beliefs of all controller updates in between, and the
   up to four newest moments wait for the next cycle.
3. A mode action is also a mode of the belief: z is the posterior's mean where the agent does not explore.
"""

import dataclasses
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.nets import descend, draw, tanh_gaussian
from beliefrl.soft_actor_critic import (
    Batch,
    Controller,
    Optimisers,
    OptimiserState,
    gradients,
    init_controller,
    init_optimisers,
    update,
    valid_mean,
)
from beliefrl.types import LARGEST, Spec, Step, UserError, Window, WindowShape, check_choice, check_range, transitions
from beliefrl.variational_model import VRM, LSTMState, elbo_terms

Metrics = dict[str, Float[Array, ""]]


class Memory(NamedTuple):
    """What an actor remembers of its episode."""

    first: LSTMState
    keep: LSTMState


class State(NamedTuple):
    """Everything that training changes."""

    first: VRM  # the first-impression model
    keep: VRM  # the keep-learning model
    controller: Controller
    first_optimiser: optax.OptState
    keep_optimiser: optax.OptState
    controller_optimiser: OptimiserState


def perception(step: Step) -> Float[Array, "*batch x"]:
    """x_t = (o_t, r_{t-1})."""
    return jnp.concatenate([step.obs, step.reward[..., None]], axis=-1)


@dataclasses.dataclass(frozen=True)
class VRMAgent:
    """Two variational recurrent models form a belief, a soft actor-critic acts on it (Han, Doya, Tani 2020)."""

    # Table 1: shared by all agents of the paper
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
    """Entropy that α steers to; None is minus the number of actions (Table 1)."""
    tau: float = 0.005
    """Fraction by which the target V moves at each update, in [0, 1] (Table 1)."""
    policy_layers: tuple[int, ...] = (256, 256)
    """Hidden layers of μ and log σ of the policy (Table 1)."""
    value_layers: tuple[int, ...] = (256, 256)
    """Hidden layers of Q and V (Table 1)."""

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
    """Most steps before a sequence that are unrolled from a zero state to begin it (Appendix A.1.2)."""
    d_size: int = 256
    """Size of the recurrent state d of each model (Appendix A.1.1)."""
    z_size: int = 64
    """Size of the latent variable z (Appendix A.1.1)."""
    hidden_size: int = 128
    """Width of every hidden layer of the models (Appendix A.1.1)."""

    # What the paper leaves open
    actor_regulariser: float = 1e-3
    """Weight of half the mean squares of the policy's μ and σ in the actor's loss (the authors' code; 0 is off)."""
    elbo_scaling: Literal["mean", "sum"] = "mean"
    """Mean (the authors' code; lr_model was tuned on it) or sum (the formula) over the dimensions of z and x."""
    decode_from: Literal["posterior", "prior"] = "posterior"
    """What z is drawn from to decode x in training: the posterior (a true ELBO) or the prior (the authors' code)."""
    store_first_impression: bool = True
    """Keep the first-impression model's d in the replay instead of computing it again for every update."""

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        check_range(self, ("seq_len", "batch_size", "train_interval_rl", "train_interval_klvrm"), 1)
        check_range(self, ("d_size", "z_size", "hidden_size", "policy_layers", "value_layers"), 1)
        check_range(self, ("burn_in", "train_times_fivrm", "actor_regulariser"), 0)
        check_range(self, ("step_start_rl",), 2)  # fewer moments hold no transition to learn from
        check_range(self, ("lr_actor", "lr_critic", "lr_alpha", "lr_model", "gamma", "tau"), 0, 1)
        if self.target_entropy is not None:
            check_range(self, ("target_entropy",), -LARGEST)
        check_choice(self, "elbo_scaling", ("mean", "sum"))
        check_choice(self, "decode_from", ("posterior", "prior"))
        if self.train_interval_klvrm % self.train_interval_rl:
            raise UserError(
                f"train_interval_klvrm={self.train_interval_klvrm} is not a multiple of "
                f"train_interval_rl={self.train_interval_rl}: choose one that is."
            )

    # How it is trained

    @property
    def pretrain_updates(self) -> int:
        return self.train_times_fivrm

    @property
    def cycle(self) -> int:
        return self.train_interval_klvrm

    @property
    def window(self) -> WindowShape:
        return WindowShape(self.burn_in, self.seq_len)

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        """One batch for the keep-learning model and one for each update of the controller."""
        return self.batch_size * (1 + self.cycle // self.train_interval_rl)

    @property
    def optimisers(self) -> Optimisers:
        return Optimisers(optax.adam(self.lr_actor), optax.adam(self.lr_critic), optax.adam(self.lr_alpha))

    @property
    def model_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.lr_model)

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        key_models, key_controller = jax.random.split(key)
        x = spec.obs_dim + 1
        bounds = VRM(x, spec.action_dim, self.d_size, self.z_size, self.hidden_size)
        first, keep = draw(key_models, (bounds, bounds))
        controller = init_controller(
            2 * self.d_size + x, spec.action_dim, self.policy_layers, self.value_layers, key_controller
        )
        return State(
            first,
            keep,
            controller,
            self.model_optimiser.init(first),  # pyright: ignore[reportArgumentType]
            self.model_optimiser.init(keep),  # pyright: ignore[reportArgumentType]
            init_optimisers(self.optimisers, controller),
        )

    # Acting (Figure 2b)

    def reset(self) -> Memory:
        empty = LSTMState(jnp.zeros(self.d_size), jnp.zeros(self.d_size))
        return Memory(empty, empty)

    def perceive(
        self, vrm: VRM, memory: LSTMState, step: Step, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> LSTMState:
        """One model's state after one more moment."""
        noise = jnp.where(explore, jax.random.normal(key, (self.z_size,)), 0.0)
        start = jax.tree.map(lambda leaf: leaf[None], memory)
        moment = (perception(step), step.prev_action, step.is_first, noise)
        inferred = vrm.infer(start, *(leaf[None, None] for leaf in moment))
        return jax.tree.map(lambda leaf: leaf[0, 0], inferred.state)

    def act(
        self, state: State, memory: Memory, step: Step, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Memory]:
        key_first, key_keep, key_action = jax.random.split(key, 3)
        memory = Memory(
            self.perceive(state.first, memory.first, step, key_first, explore),
            self.perceive(state.keep, memory.keep, step, key_keep, explore),
        )
        belief = jnp.concatenate([memory.first.d, memory.keep.d, perception(step)])
        mean, log_sigma = state.controller.actor(belief)
        noise = jnp.where(explore, jax.random.normal(key_action, mean.shape), 0.0)
        return tanh_gaussian(mean, log_sigma, noise)[0], memory

    def note(self, memory: Memory) -> tuple[Float[Array, " d"], ...]:
        """d_t of the first-impression model, or nothing."""
        return (memory.first.d,) if self.store_first_impression else ()

    # Learning the models (Figure 2c)

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        first, optimiser, metrics = self.learn_model(state.first, state.first_optimiser, windows, key)
        return state._replace(first=first, first_optimiser=optimiser), metrics

    def learn_model(
        self, vrm: VRM, optimiser: optax.OptState, windows: Window, key: Key[Array, ""]
    ) -> tuple[VRM, optax.OptState, Metrics]:
        """One step up the ELBO of the windows' last `seq_len` moments but one."""
        grads, metrics = jax.grad(self.model_loss, has_aux=True)(vrm, windows, key)
        vrm, optimiser = descend(self.model_optimiser, grads, optimiser, vrm)
        return vrm, optimiser, metrics

    def model_loss(self, vrm: VRM, windows: Window, key: Key[Array, ""]) -> tuple[Float[Array, ""], Metrics]:
        """The negative ELBO, mean over the valid moments after the burn-in."""
        key_burn_in, key_infer, key_prior = jax.random.split(key, 3)
        before, after = _time_major(windows, 0, self.burn_in), _time_major(windows, self.burn_in, -1)
        start = self.unroll(jax.lax.stop_gradient(vrm), before, key_burn_in)
        inputs = (perception(after.step), after.step.prev_action)
        noise = self.noise(key_infer, after)
        inferred = vrm.infer(start, *inputs, after.step.is_first, noise)
        prior_noise = self.noise(key_prior, after) if self.decode_from == "prior" else None
        terms = elbo_terms(vrm, inferred, *inputs, self.elbo_scaling, prior_noise)
        kl, log_likelihood = (valid_mean(term.ravel(), after.exists.ravel()) for term in terms)
        return kl - log_likelihood, {"kl": kl, "log_likelihood": log_likelihood, "negative_elbo": kl - log_likelihood}

    def unroll(self, vrm: VRM, windows: Window, key: Key[Array, ""]) -> LSTMState:
        """A model's state after some moments (time-major) that begin with the empty state."""
        start = vrm.start(windows.exists.shape[1])
        if windows.exists.shape[0] == 0:
            return start
        step = windows.step
        inferred = vrm.infer(start, perception(step), step.prev_action, step.is_first, self.noise(key, windows))
        return jax.tree.map(lambda leaf: leaf[-1], inferred.state)

    def noise(self, key: Key[Array, ""], windows: Window) -> Float[Array, "time batch z"]:
        return jax.random.normal(key, (*windows.exists.shape, self.z_size))

    # Learning the controller (Figure 2a)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        key_model, key_belief = jax.random.split(key)
        for_model = jax.tree.map(lambda leaf: leaf[: self.batch_size], windows)
        for_controller = jax.tree.map(lambda leaf: leaf[self.batch_size :], windows)
        keep, optimiser, metrics = self.learn_model(state.keep, state.keep_optimiser, for_model, key_model)
        state = state._replace(keep=keep, keep_optimiser=optimiser)
        return state, self.batches(state, for_controller, key_belief), metrics

    def batches(self, state: State, windows: Window, key: Key[Array, ""]) -> Batch:
        """The windows' transitions with their beliefs, split for a cycle's updates: leaves (update, batch, ...)."""
        key_first, key_keep = jax.random.split(key)
        moments = _time_major(windows, 0, None)
        d_first = moments.note[0] if self.store_first_impression else self.states(state.first, moments, key_first)
        d_keep = self.states(state.keep, moments, key_keep)
        belief = jnp.concatenate([d_first, d_keep, perception(moments.step)], axis=-1)
        now, after = slice(self.burn_in, -1), slice(self.burn_in + 1, None)
        batch = Batch(
            belief=belief[now],
            next_belief=belief[after],
            action=moments.step.prev_action[after],
            reward=moments.step.reward[after],
            terminated=moments.step.terminated[after],
            valid=transitions(windows, self.burn_in).T,
        )
        return jax.tree.map(self._split, batch)

    def states(self, vrm: VRM, windows: Window, key: Key[Array, ""]) -> Float[Array, "time batch d"]:
        """d_t at every moment of the windows (time-major)."""
        step = windows.step
        start = vrm.start(windows.exists.shape[1])
        noise = self.noise(key, windows)
        return vrm.infer(start, perception(step), step.prev_action, step.is_first, noise).state.d

    def _split(self, leaf: Array) -> Array:
        """(time, update · batch, ...) to (update, time · batch, ...)."""
        time, windows, *rest = leaf.shape
        updates = windows // self.batch_size
        leaf = leaf.reshape(time, updates, self.batch_size, *rest).swapaxes(0, 1)
        return leaf.reshape(updates, time * self.batch_size, *rest)

    def update(self, state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
        noise = jax.random.normal(key, batch.action.shape)
        gradient, metrics = gradients(
            state.controller, batch, noise, self.gamma, self.actor_regulariser, self.target_entropy
        )
        controller, optimiser = update(
            self.optimisers, state.controller_optimiser, state.controller, gradient, self.tau
        )
        return state._replace(controller=controller, controller_optimiser=optimiser), metrics


def _time_major(windows: Window, start: int, stop: int | None) -> Window:
    """The moments from `start` to `stop` of windows (batch, time, ...) as (time, batch, ...)."""
    return jax.tree.map(lambda leaf: leaf[:, start:stop].swapaxes(0, 1), windows)
