"""Predictive SAC: a soft actor-critic on the state of one LSTM that learns only to predict.

The belief is s_t = [h_t, x_t], with the LSTM's state h_t and x_t = (o_t, a_{t-1}, r_{t-1}, n_t), all standardised by
running statistics. n_t is a memory of the observations of the episode, which is off by default. The LSTM also reads a
memory of its unusual rewards. It learns during the whole training, and only by predicting the next observation and
reward (`models.predictive_model`). The gradient of the controller (`models.double_q`) does not reach it.

The model reads the replay in order (`models.reading`): a reader's window begins with the state at the end of its last
one. So h_t knows the episode since its beginning, or since the reader's last jump, which empties it. The beliefs of the
windows of a cycle become transitions. A pool has those of the last `pool` cycles with their targets, and the
controller's batches are drawn from it: the windows of one cycle are too few and too correlated.

In training the newest weights act. Evaluations and the trained agent use averages of the last weights of the model and
the actor (`models.optimisation`). These fit together only if beliefs change slowly. So the model's learning rate falls.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents.base import ControllerAgent
from beliefrl.agents.hyperparameters import Range
from beliefrl.agents.protocol import Metrics
from beliefrl.models import double_q, predictive_model, reading
from beliefrl.models.double_q import DoubleQController, Samples
from beliefrl.models.nets import Gaussian, LSTMState
from beliefrl.models.optimisation import Average, OptimiserState, descend, falling_rate, init_optimisers, valid_mean
from beliefrl.models.predictive_model import Memory, Note, Perceived, PredictiveModel, perceive, prediction_loss
from beliefrl.models.scales import Scales, initial_scales, standardise, update_statistics
from beliefrl.types import WIDEST, Spec, Timestep, Window, WindowShape, check_range

MEMORIES = ("reward_memory", "observation_memory")


class State(NamedTuple):
    """Everything that training changes."""

    model: PredictiveModel
    controller: DoubleQController
    scales: Scales
    readers: LSTMState  # the LSTM's state before each reader's next window, leaves (reader, d)
    pool: reading.Pool
    model_optimiser: optax.OptState
    controller_optimiser: OptimiserState
    average: Average  # of the model and the actor


@dataclasses.dataclass(frozen=True)
class PredictiveSACAgent(ControllerAgent):
    """Soft actor-critic on an LSTM that learns only to predict observations and rewards. It is not in the paper."""

    # The controller
    trace_decay: float = 0.95
    """λ of the critics' λ-returns, in [0, 1]. With 0, a target has one reward and the value of the next belief."""
    off_policy_trace: float = 0.5
    """ω, in [0, 1]: at an action that the current policy would not choose, the trace is ωλ. With 1, it is always λ."""
    trace_per_dimension: bool = False
    """Use the geometric mean of the ratio over the action dimensions. With many dimensions, traces are longer."""
    pessimism: float = 1.0
    """P, in [0, 1]. The actor and the targets use the smaller Q (1), the mean of the two (0), or a mixture."""
    train_interval_rl: int = 1
    """Environment steps between two updates of the model. Unlike in `vrm`, the controller learns at each step."""
    updates_per_step: int = 1
    """Updates of the controller for each environment step, also if the model learns less often."""
    batch_size: int = 128
    """Transitions that are drawn for an update of the controller, including some from which nothing is learned."""
    lr_actor: float = 1e-3
    """Adam's learning rate for the actor."""
    lr_critic: float = 1e-3
    """Adam's learning rate for both Q."""
    lr_alpha: float = 2e-3
    """Adam's learning rate for log α, the temperature."""
    alpha_start: float = 0.1
    """α before training, in units of u, the size of the returns."""
    tau: float = 0.02
    """Soft-update rate of the target Qs, in [0, 1]."""
    policy_layers: tuple[int, ...] = (128, 128)
    """Hidden layers of the actor."""
    value_layers: tuple[int, ...] = (128, 128)
    """Hidden layers of each Q."""
    normalise_critics: bool = True
    """Layer normalisation, without gains, before each activation of the Q networks (Ba et al. 2016)."""
    critic_likelihood: float = 0.1
    """w ≥ 0: the loss of Q is the squared error plus w times the negative log likelihood. If w > 0, Q also has a σ."""
    actor_regulariser: float = 1e-3
    """Weight, in units of u, of half the mean square of the policy's μ in the actor's loss; 0 is off."""

    # The model
    pretrain_updates: int = 1000
    """Updates of the model alone at step_start_rl."""
    lr_model: float = 1e-3
    """Adam's learning rate for the model in its first `lr_model_updates` updates."""
    lr_model_updates: int = 12000
    """Number of updates of the model, including the pre-training, from which on its learning rate falls as 1 / n."""
    lr_model_min: float = 1e-5
    """Smallest learning rate of the model. If it is `lr_model` or more, the learning rate is constant."""
    seq_len: int = 32
    """Steps in a window, and of the gradient through time."""
    sequences: int = 8
    """Windows in an update of the model."""
    jump: float = 1 / 16
    """Probability that a reader jumps to a random place of the replay before it reads a window. It also jumps at the
    end of the replay. The state is then empty, and learning begins with the next window or episode."""
    d_size: int = 128
    """Size of the LSTM's state h."""
    hidden_size: int = 128
    """Width of the predictor's hidden layer."""
    long_memories: float = 0.25
    """Fraction of the LSTM's cells that start with a long memory, in [0, 1]."""
    longest_memory: int = 127
    """L: these cells start with forget biases of log U(1, L), which are time constants of 2 to L + 1 steps."""
    perceive_reward: bool = True
    """Read the last reward. Without it there is no `reward_memory` either, and the trained agent needs no rewards."""
    reward_memory: tuple[float, ...] = (8.0, 64.0, 512.0)
    """Time constants, in steps, of the memory of unusual rewards that the LSTM reads. Without any it reads none."""
    observation_memory: tuple[float, ...] = ()
    """Time constants, in steps, of the memory of observations that the LSTM and the controller read. Without any they
    read none. Try 8 64 512 where velocities are observed and positions are hidden."""
    pool: int = 8
    """Number of the last cycles whose transitions are in the pool. There are `pool` × `sequences` readers."""
    average_rate: float = 2e-4
    """Smallest rate of the running average of the weights that is evaluated and saved, in (0, 1]. After n updates of
    the controller the rate is at least 10 / (n + 9). With 1, the newest weights are evaluated."""

    ranges = ControllerAgent.ranges | {
        "updates_per_step": (1, 2, 4),
        "critic_likelihood": (0.0, 0.1, 1.0),
        "batch_size": (64, 128, 256, 512),
        "trace_decay": Range(0.8, 1.0),
        "pessimism": Range(0.0, 1.0),
        "tau": Range(5e-3, 5e-2, "log"),
        "lr_model": Range(1e-4, 3e-3, "log"),
        "lr_model_updates": (6000, 12000, 24000),
        "seq_len": (16, 32, 64),
        "d_size": (64, 128, 256),
        "long_memories": Range(0.0, 0.5),
        "pool": (4, 8, 16),
    }
    predictors = ("lstm",)
    losses = ("loss_q", "loss_actor", "loss_model")
    network_settings = ("normalise_critics", "critic_likelihood", "perceive_reward", *MEMORIES)
    values_before = {
        "normalise_critics": False,
        "lr_model_min": 1.0,
        "average_rate": 1.0,
        "critic_likelihood": 0.0,
        "observation_memory": (),
        "perceive_reward": True,
        "trace_per_dimension": False,
    }

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        super().__post_init__()
        check_range(self, ("updates_per_step", "batch_size", "lr_model_updates", "seq_len", "sequences", "pool"), 1)
        check_range(self, ("d_size", "hidden_size"), 1, WIDEST)
        check_range(self, ("pretrain_updates", "critic_likelihood"), 0)
        check_range(self, ("alpha_start",), 1e-6)
        fractions = "long_memories", "trace_decay", "off_policy_trace", "pessimism"
        check_range(self, ("lr_model", "lr_model_min", "jump", *fractions), 0, 1)
        check_range(self, ("average_rate",), 1e-6, 1)
        memories = [name for name in MEMORIES if getattr(self, name) != ()]
        check_range(self, ("longest_memory", *memories), 1)

    # How it is trained

    @property
    def window(self) -> WindowShape:
        return WindowShape(0, self.seq_len, self.pool * self.sequences, self.jump)

    @property
    def pretrain_windows(self) -> int:
        return self.sequences

    cycle_windows = pretrain_windows

    @property
    def perceived(self) -> Perceived:
        rewards = self.reward_memory if self.perceive_reward else ()
        return Perceived(self.perceive_reward, rewards, self.observation_memory)

    @property
    def model_optimiser(self) -> optax.GradientTransformation:
        return optax.adam(falling_rate(self.lr_model, self.lr_model_updates, self.lr_model_min))

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        key_model, key_controller = jax.random.split(key)
        remembered = spec.obs_dim * len(self.observation_memory)
        x = spec.obs_dim + spec.action_dim + self.perceive_reward + remembered
        sizes = spec.obs_dim, spec.action_dim, x + len(self.perceived.reward_memory), self.d_size, self.hidden_size
        model = predictive_model.init_model(key_model, *sizes, self.long_memories, self.longest_memory)
        belief, action = self.d_size + x, spec.action_dim
        settings = self.policy_layers, self.value_layers, self.alpha_start, self.normalise_critics
        controller = double_q.init_controller(key_controller, belief, action, *settings, self.critic_likelihood > 0)
        return State(
            model,
            controller,
            initial_scales(spec.obs_dim, belief, remembered),
            model.lstm.start(self.window.readers),
            reading.Pool.empty((self.pool, self.sequences * self.seq_len), belief, action),
            self.model_optimiser.init(model),  # pyright: ignore[reportArgumentType]
            init_optimisers(self.optimisers, controller.trained),
            Average.begin((model, controller.actor)),
        )

    def networks(self, state: State) -> State:
        """The averages in place of the newest weights, the newest scales, and the Q networks (for `--init-from`).

        Before the first update there are no averages, and the newest weights stay.
        """
        model, actor = state.average.or_newest((state.model, state.controller.actor))
        rest = ("readers", "pool", "model_optimiser", "controller_optimiser", "average")
        return state._replace(model=model, controller=state.controller._replace(actor=actor), **dict.fromkeys(rest, ()))

    # Acting

    def reset(self, spec: Spec) -> Memory:
        return Memory.empty(self.d_size, spec.obs_dim, spec.action_dim, self.perceived)

    def act(
        self, state: State, memory: Memory, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Memory]:
        memory, x = perceive(state.model, state.scales, memory, step, self.perceived)
        belief = jnp.concatenate([memory.lstm.d, x])
        policy = state.controller.actor(standardise(state.scales.belief, belief))
        return self.choose(policy, key, explore), memory._replace(note=memory.note._replace(policy=policy))

    def note(self, memory: Memory) -> Note:
        return memory.note

    def predict(
        self, state: State, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        return predictive_model.forecast(state.model, state.scales, step, observed, self.perceived)

    # Learning the model

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        state, _, metrics = self.learn_model(state, windows)
        usual = state.scales.usual.include(windows.step.reward, windows.exists & ~windows.step.is_first)
        return state._replace(scales=state.scales._replace(usual=usual)), metrics

    def learn_model(self, state: State, windows: Window) -> tuple[State, Float[Array, "time batch belief"], Metrics]:
        """One Adam step on J_model; also returns the beliefs, formed before the step and not standardised."""
        scales, step = state.scales.include(windows), windows.step
        x = scales.perception(step, windows.note.observations, self.perceive_reward)
        valid = reading.known_transitions(windows)
        inputs, start = scales.model_input(x, windows.note.rewards), reading.start(windows, state.readers)
        (j_model, lstm), gradient = jax.value_and_grad(prediction_loss, has_aux=True)(
            state.model, start, inputs, step, scales.prediction(windows.between(1, None).step), valid
        )
        model, optimiser = descend(self.model_optimiser, gradient, state.model_optimiser, state.model)
        belief = jnp.concatenate([lstm.d, x], axis=-1)
        known = windows.exists & reading.is_known(windows)
        scales = scales._replace(belief=update_statistics(scales.belief, belief, known))
        readers = reading.end(windows, state.readers, lstm)
        state = state._replace(model=model, model_optimiser=optimiser, scales=scales, readers=readers)
        return state, belief, {"loss_model": j_model}

    # Learning the controller

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Samples, Metrics]:
        """One update of the model; then a batch from the pool for each update of the controller."""
        key_targets, key_draw = jax.random.split(key)
        state, belief, metrics = self.learn_model(state, windows)
        samples, likeness = self.samples(state, windows, belief, key_targets)
        pool = state.pool.add(samples)
        batches = pool.draw(key_draw, (self.cycle * self.updates_per_step, self.batch_size))
        batches = batches._replace(belief=standardise(state.scales.belief, batches.belief))
        return state._replace(pool=pool), batches, metrics | {"likeness": likeness}

    def samples(
        self, state: State, windows: Window, belief: Float[Array, "time batch belief"], key: Key[Array, ""]
    ) -> tuple[Samples, Float[Array, ""]]:
        """The transitions of windows with their targets; also the mean of min(1, ρ)."""
        valid, s = reading.known_transitions(windows), standardise(state.scales.belief, belief)
        traces = double_q.Traces(self.gamma, self.trace_decay, self.off_policy_trace, self.trace_per_dimension)
        step, b = windows.step, windows.note.policy
        y, likeness = double_q.critic_targets(state.controller, s, step, valid, b, key, traces, self.pessimism)
        return Samples(belief[:-1], step.prev_action[1:], y, valid), valid_mean(likeness, valid)

    def update(self, state: State, batch: Samples, key: Key[Array, ""]) -> tuple[State, Metrics]:
        controller, optimiser, metrics = double_q.update(
            self.optimisers,
            state.controller_optimiser,
            state.controller,
            batch,
            key,
            tau=self.tau,
            regulariser=self.actor_regulariser,
            pessimism=self.pessimism,
            likelihood=self.critic_likelihood,
            target_entropy=self.target_entropy,
        )
        average = state.average.follow((state.model, controller.actor), self.average_rate)
        return state._replace(controller=controller, controller_optimiser=optimiser, average=average), metrics
