"""What an agent must have (`Agent`), and what it may have (`Predictive`)."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float, Key

from beliefrl.models.nets import Gaussian
from beliefrl.types import Spec, Timestep, Window, WindowShape

Metrics = dict[str, Float[Array, ""]]


@runtime_checkable
class Agent(Protocol):
    """A frozen dataclass of hyperparameters whose methods are pure functions.

    A training explores for `step_start_rl` steps with the untrained policy, and calls `pretrain` `pretrain_updates`
    times. Then it makes cycles of `cycle` steps. At the end of a cycle it calls `begin_cycle` once, and `update` for
    each batch that `begin_cycle` returned.
    """

    @property
    def step_start_rl(self) -> int: ...
    @property
    def pretrain_updates(self) -> int: ...
    @property
    def cycle(self) -> int: ...
    @property
    def window(self) -> WindowShape:
        """The shape of the windows that the methods below receive."""
        ...

    @property
    def losses(self) -> tuple[str, ...]:
        """The metrics that stop a seed if they are not finite; `pretrain` and the updates share these names."""
        ...

    @property
    def pretrain_windows(self) -> int:
        """Number of windows that `pretrain` receives."""
        ...

    @property
    def cycle_windows(self) -> int:
        """Number of windows that `begin_cycle` receives."""
        ...

    def init(self, key: Key[Array, ""], spec: Spec) -> Any:
        """The state before training: networks and optimisers."""
        ...

    def networks(self, state: Any) -> Any:
        """The trained agent: the state without what only updates need. Its optimisers' fields are replaced by ().

        In evaluations and outside of training, `act` and `predict` receive this state. So it may have averages of the
        weights in place of the newest. It is saved as the trained agent, and its numbers are counted as parameters.
        `state` may have leading axes.
        """
        ...

    def reset(self, spec: Spec) -> Any:
        """The empty memory of one actor: arrays, not necessarily zeros.

        The caller passes it to `act` at the first timestep.
        """
        ...

    def act(
        self, state: Any, memory: Any, step: Timestep, key: Key[Array, ""], explore: Bool[Array, ""]
    ) -> tuple[Float[Array, " action"], Any]:
        """Perceive a timestep; returns the action (a sample, or the mode if not `explore`) and the new memory.

        At the first timestep of an episode the caller passes the memory of `reset`, so this method need not check
        `step.is_first` for it.
        """
        ...

    def note(self, memory: Any) -> Any:
        """The data that the replay stores with a timestep, given the memory after it."""
        ...

    def pretrain(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the pre-training."""
        ...

    def begin_cycle(self, state: Any, windows: Window, key: Key[Array, ""]) -> tuple[Any, Any, Metrics]:
        """Called once per cycle; the second result has a batch for each `update` of the cycle (leading axis)."""
        ...

    def update(self, state: Any, batch: Any, key: Key[Array, ""]) -> tuple[Any, Metrics]:
        """One update of the controller."""
        ...


@runtime_checkable
class Predictive(Protocol):
    """An agent with a model that can predict its inputs. This protocol is optional."""

    @property
    def predictors(self) -> tuple[str, ...]:
        """The names of its models, the default first."""
        ...

    def predict(
        self, state: Any, model: str, step: Timestep, observed: Bool[Array, " time"], key: Key[Array, ""]
    ) -> Gaussian:
        """One model's predictions of x_t = (o_t, r_{t-1}) along an episode, leaves (time, x).

        Where x_t is `observed` (open loop), latent variables are inferred from it. Elsewhere (closed loop) they are
        drawn from the generative model, and x_t must not be used. Entries that the model does not predict are NaN.
        """
        ...
