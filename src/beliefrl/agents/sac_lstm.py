"""SAC-LSTM: a soft actor-critic on the state of an LSTM. The controller's losses train both, end to end.

Source: Section 5, Table 1, Appendix A.2.2 and A.1.2. The belief is d_t = LSTM(d_{t-1}; o_t). Sequences, burn-in and
resets inside windows are those of VRM. The gradients of J_π (through μ and log σ), J_V and J_Q reach the LSTM. The
gradients through the targets and through the Q of the actor's loss do not.

Departure: V̄ reads the state of a target LSTM, which moves together with V̄. In the authors' code it reads the state of
the learning LSTM, so the target moves with every update. In our runs such agents learned and then forgot
(docs/agents/alternatives.md).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.base import SACAgent, for_each_update
from beliefrl.agents.hyperparameters import Range
from beliefrl.agents.protocol import Metrics
from beliefrl.models.nets import LSTM, LSTMState, draw
from beliefrl.models.optimisation import OptimiserState, descend, soft_update
from beliefrl.models.soft_actor_critic import Batch, Controller, update
from beliefrl.types import WIDEST, Spec, Timestep, Window, WindowShape, check_range


class State(NamedTuple):
    """Everything that training changes."""

    lstm: LSTM
    target_lstm: LSTM
    controller: Controller
    lstm_optimisers: tuple[optax.OptState, optax.OptState]  # for the critics' gradient and for the actor's
    controller_optimiser: OptimiserState


@dataclasses.dataclass(frozen=True)
class SACLSTMAgent(SACAgent):
    """Soft actor-critic on an LSTM of the observations, trained end to end (Han, Doya, Tani 2020, Appendix A.2.2)."""

    seq_len: int = 64
    """Steps in a sampled sequence (Appendix A.1.2)."""
    batch_size: int = 4
    """Sequences in an update (Appendix A.1.2)."""
    burn_in: int = 64
    """Burn-in: at most this many steps before a sequence initialise its state, from zero (Appendix A.1.2)."""
    d_size: int = 256
    """Size of the LSTM's state (Appendix A.2.2)."""
    lr_lstm: float = 3e-4
    """Adam's learning rate for the LSTM, which learns from the critics and from the actor in turn (authors' code)."""
    pretrain_updates: int = 5000
    """Updates of the whole agent after step_start_rl steps, as many as in VRM's pre-training (Section 5; 0 is off)."""
    perceive_action: bool = False
    """Make the previous action an input of the LSTM, in addition to the observation (not in the paper)."""
    perceive_reward: bool = False
    """Make the previous reward an input of the LSTM, in addition to the observation (not in the paper)."""

    ranges = SACAgent.ranges | {
        "lr_lstm": Range(1e-4, 3e-3, "log"),
        "seq_len": (16, 32, 64),
        "batch_size": (4, 8, 16),
        "d_size": (64, 128, 256),
        "perceive_action": (False, True),
        "perceive_reward": (False, True),
    }
    network_settings = ("perceive_action", "perceive_reward")

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("seq_len", "batch_size"), 1)
        check_range(self, ("d_size",), 1, WIDEST)
        check_range(self, ("burn_in", "pretrain_updates"), 0)
        check_range(self, ("lr_lstm",), 0, 1)

    # How it is trained

    @property
    def window(self) -> WindowShape:
        return WindowShape(self.burn_in, self.seq_len)

    @property
    def pretrain_windows(self) -> int:
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        return self.batch_size * self.cycle_updates

    @property
    def lstm_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(self.lr_lstm)

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        key_lstm, key_controller = jax.random.split(key)
        x = spec.obs_dim + self.perceive_action * spec.action_dim + self.perceive_reward
        lstm = draw(key_lstm, LSTM(x, self.d_size))
        controller, controller_optimiser = self.init_controller(key_controller, self.d_size, spec.action_dim)
        lstm_optimiser = self.lstm_optimiser.init(lstm)  # pyright: ignore[reportArgumentType]
        return State(lstm, lstm, controller, (lstm_optimiser, lstm_optimiser), controller_optimiser)

    def networks(self, state: State) -> State:
        """The state without its optimisers."""
        return state._replace(lstm_optimisers=(), controller_optimiser=())

    # Acting

    def perception(self, step: Timestep) -> Float[Array, "*batch x"]:
        """o_t, with the last action and the last reward if they are inputs."""
        parts = [step.obs]
        if self.perceive_action:
            parts.append(step.prev_action)
        if self.perceive_reward:
            parts.append(step.reward[..., None])
        return jnp.concatenate(parts, axis=-1)

    def reset(self, spec: Spec) -> LSTMState:
        return LSTMState.empty(self.d_size)

    def act(
        self, state: State, memory: LSTMState, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], LSTMState]:
        memory = state.lstm.step(memory, self.perception(step), step.is_first)
        return self.choose(state.controller.actor(memory.d), key, explore), memory

    # Learning

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        return self.update(state, windows, key)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Window, Metrics]:
        """The windows of each update."""
        return state, for_each_update(windows, self.batch_size), {}

    def beliefs(self, lstm: LSTM, windows: Window) -> Float[Array, "time batch d"]:
        """d_t after the burn-in; no gradient reaches the burn-in."""
        before, after = windows.between(0, self.burn_in), windows.between(self.burn_in, None)
        start = lstm.start(self.batch_size)
        if self.burn_in:
            still = jax.lax.stop_gradient(lstm)
            burnt_in = still.unroll(start, self.perception(before.step), before.step.is_first)
            start = jax.tree.map(lambda leaf: leaf[-1], burnt_in)
        return lstm.unroll(start, self.perception(after.step), after.step.is_first).d

    def batch(
        self,
        windows: Window,
        d: Float[Array, "time batch d"],
        d_actor: Float[Array, "time batch d"],
        d_target: Float[Array, "time batch d"],
    ) -> Batch:
        """The windows' transitions, with beliefs for the critics, for the actor (the same numbers) and for V̄."""
        batch = self.transitions(windows, d, d_target, d_actor)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), batch)

    def gradients(
        self, lstm: LSTM, target_lstm: LSTM, controller: Controller, windows: Window, key: Key[Array, ""]
    ) -> tuple[tuple[LSTM, LSTM, Controller], Metrics]:
        """The gradients of J_V + J_Q in the LSTM, of J_π in the LSTM, and of all losses in the controller."""

        def loss(d: Array, d_actor: Array, controller: Controller) -> tuple[Float[Array, ""], Metrics]:
            return self.controller_loss(controller, self.batch(windows, d, d_actor, d_target), key)

        d_target = self.beliefs(target_lstm, windows)
        d, pullback = jax.vjp(lambda lstm: self.beliefs(lstm, windows), lstm)
        (grad_d, grad_d_actor, grad_controller), metrics = jax.grad(loss, (0, 1, 2), has_aux=True)(d, d, controller)
        (grads,) = jax.vmap(pullback)(jnp.stack([grad_d, grad_d_actor]))  # one scan back for both
        grad_critics, grad_actor = (jax.tree.map(lambda leaf, i=i: leaf[i], grads) for i in range(2))
        return (grad_critics, grad_actor, grad_controller), metrics

    def update(self, state: State, batch: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        """One update of the LSTM and the controller; the batch is windows."""
        gradients, metrics = self.gradients(state.lstm, state.target_lstm, state.controller, batch, key)
        grad_critics, grad_actor, grad_controller = gradients
        s_critics, s_actor = state.lstm_optimisers
        lstm, s_critics = descend(self.lstm_optimiser, grad_critics, s_critics, state.lstm)
        lstm, s_actor = descend(self.lstm_optimiser, grad_actor, s_actor, lstm)
        controller, controller_optimiser = update(
            self.optimisers, state.controller_optimiser, state.controller, grad_controller, self.tau
        )
        target_lstm = soft_update(state.target_lstm, lstm, self.tau)
        return State(lstm, target_lstm, controller, (s_critics, s_actor), controller_optimiser), metrics
