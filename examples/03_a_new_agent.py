"""A new agent: soft actor-critic on the last few observations, the plain answer to a hidden velocity.

    pip install beliefrl
    python examples/03_a_new_agent.py                  # 6,000 steps on the pendulum without its speed: a few minutes
    python examples/03_a_new_agent.py --steps 300      # to see it run

By then two seeds came to -750 and -495; random play gets about -1200.

An agent is a frozen dataclass of hyperparameters whose methods are pure functions, for one seed and one actor; the
training loop maps them over seeds and environments. `SAC` brings Table 1 of the paper and the controller; what is left
to say is what it remembers while acting, which windows of the past it learns from, and how a belief is formed of both.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Bool, Float, Key

import beliefrl
from beliefrl.agents.sac import SAC, Metrics
from beliefrl.models.soft_actor_critic import Batch, Controller, OptimiserState
from beliefrl.types import Spec, Timestep, Window, WindowShape, transitions


class State(NamedTuple):
    """Everything that training changes."""

    controller: Controller
    optimiser: OptimiserState


@dataclasses.dataclass(frozen=True)
class StackAgent(SAC):
    """Soft actor-critic on the last `stack` observations; before an episode's first, on copies of it."""

    stack: int = 3
    """Observations that the controller reads."""
    batch_size: int = 256
    """Transitions in an update."""
    pretrain_updates: int = 5000
    """Updates at step_start_rl, as many as the paper's agents make."""

    @property
    def cycle(self) -> int:
        """Steps between two visits to the replay."""
        return self.train_interval_rl

    @property
    def window(self) -> WindowShape:
        """A transition, and what must be seen before it."""
        return WindowShape(burn_in=self.stack - 1, length=1)

    @property
    def pretrain_windows(self) -> int:
        """Windows in an update of the pre-training."""
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        """Windows in a cycle, which has one update."""
        return self.batch_size

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        """Networks and optimisers before training."""
        return State(*self.init_controller(key, self.stack * spec.obs_dim, spec.action_dim))

    def reset(self, spec: Spec) -> Float[Array, "stack obs"]:
        """The memory of an actor before its first moment."""
        return jnp.zeros((self.stack, spec.obs_dim))

    def act(
        self,
        state: State,
        memory: Float[Array, "stack obs"],
        step: Timestep,
        key: Key[Array, ""],
        explore: Bool[Array, ""],
    ) -> tuple[Float[Array, " action"], Float[Array, "stack obs"]]:
        """Perceive a moment, and act on it."""
        older = jnp.where(step.is_first, jnp.broadcast_to(step.obs, memory.shape), memory)
        memory = jnp.concatenate([older[1:], step.obs[None]])
        return self.choose(state.controller, memory.reshape(-1), key, explore), memory

    def note(self, memory: Float[Array, "stack obs"]) -> tuple[()]:
        """What the replay keeps beside the moment: nothing."""
        return ()

    def stacks(self, window: Window) -> Float[Array, "time belief"]:
        """The beliefs at every moment of one window, by the same memory as in acting."""
        begins = window.step.is_first | ~window.exists

        def perceive(memory, moment):
            obs, first = moment
            memory = jnp.concatenate([jnp.where(first, jnp.broadcast_to(obs, memory.shape), memory)[1:], obs[None]])
            return memory, memory.reshape(-1)

        empty = jnp.zeros((self.stack, window.step.obs.shape[-1]))
        return jax.lax.scan(perceive, empty, (window.step.obs, begins))[1]

    def batch(self, windows: Window) -> Batch:
        """The last transition of every window."""
        step, beliefs = windows.step, jax.vmap(self.stacks)(windows)
        return Batch(
            belief=beliefs[:, -2],
            next_belief=beliefs[:, -1],
            action=step.prev_action[:, -1],
            reward=step.reward[:, -1],
            terminated=step.terminated[:, -1],
            valid=transitions(windows, self.stack - 1)[:, 0],
        )

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        """One update of the pre-training."""
        return self.update(state, self.batch(windows), key)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        """The batches of the cycle's updates, here one."""
        return state, jax.tree.map(lambda leaf: leaf[None], self.batch(windows)), {}

    def update(self, state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
        """One update of the controller."""
        controller, optimiser, metrics = self.learn_controller(state.controller, state.optimiser, batch, key)
        return State(controller, optimiser), metrics


def main(steps: int = 6_000, seeds: int = 2, out: str = "runs/stack") -> None:
    """Train it on the pendulum of which the angle is seen and the speed is not."""
    run = beliefrl.train(StackAgent(), "pendulum-p", out, steps=steps, seeds=seeds)
    for seed in run.seeds:
        means = {row["step"]: round(sum(row["sampled"]) / len(row["sampled"])) for row in run.rows(seed, "evaluation")}
        print(f"seed {seed}: return at each evaluation {means}")


if __name__ == "__main__":
    tyro.cli(main)

# The command line takes it as well, in the folder of this file. Its fields are options.
#
#     beliefrl train 03_a_new_agent:StackAgent pendulum-p --stack 4 --steps 6000 --out runs/stack-4
#     beliefrl resume runs/stack-4 --steps 10000 --agent 03_a_new_agent:StackAgent
#     beliefrl evaluate runs/stack-4 --agent 03_a_new_agent:StackAgent
#     beliefrl video runs/stack-4 stack.gif --agent 03_a_new_agent:StackAgent
#     beliefrl bench 03_a_new_agent:StackAgent
