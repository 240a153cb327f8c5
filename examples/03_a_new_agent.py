"""A new agent: soft actor-critic on the last few observations, which determine a hidden velocity.

    pip install -c constraints.txt -e .           # in a clone of the repository
    python examples/03_a_new_agent.py             # 6,000 steps, hidden velocity: 5 min 20 s of CPU time
    python examples/03_a_new_agent.py --quick     # 600 steps, to see it run: 43 s of CPU time

After 6,000 steps two seeds have returns of -855 and -181 (sampled actions). A random policy gets about -1200. Your
numbers may differ, because rounding differs between machines. A second start continues the run in runs/stack.

An agent is a frozen dataclass of hyperparameters whose methods are pure functions, for one seed and one actor. The
training loop maps them over seeds and environments. `SACAgent` has the hyperparameters of Table 1 of the paper, and the
controller. An agent adds its memory for acting, the windows that it learns from, and how it forms beliefs.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Bool, Float, Key

import beliefrl
from beliefrl.agents.base import Metrics, SACAgent, split_updates
from beliefrl.models.optimisation import OptimiserState
from beliefrl.models.soft_actor_critic import Batch, Controller
from beliefrl.types import Spec, Timestep, Window, WindowShape


class State(NamedTuple):
    """Everything that training changes. `SACAgent.update` trains these two."""

    controller: Controller
    controller_optimiser: OptimiserState


@dataclasses.dataclass(frozen=True)
class StackAgent(SACAgent):
    """Soft actor-critic on the last `stack` observations. At the start of an episode the first one is repeated."""

    stack: int = 3
    """Number of observations that the controller reads."""
    batch_size: int = 256
    """Transitions in each update."""
    pretrain_updates: int = 5000
    """Updates after step_start_rl steps, as many as for the paper's agents."""

    @property
    def window(self) -> WindowShape:
        """A transition of `n_step` steps, and the timesteps before it that its stack needs."""
        return WindowShape(burn_in=self.stack - 1, length=self.n_step)

    @property
    def pretrain_windows(self) -> int:
        """Windows in an update of the pre-training."""
        return self.batch_size

    @property
    def cycle_windows(self) -> int:
        """Windows in a cycle: a batch for each of its updates."""
        return self.batch_size * self.cycle_updates

    def init(self, key: Key[Array, ""], spec: Spec) -> State:
        """Networks and optimisers before training."""
        return State(*self.init_controller(key, self.stack * spec.obs_dim, spec.action_dim))

    def networks(self, state: State) -> State:
        """The state without its optimisers."""
        return state._replace(controller_optimiser=())

    def reset(self, spec: Spec) -> Float[Array, "stack obs"]:
        """The memory of an actor before its first timestep."""
        return jnp.zeros((self.stack, spec.obs_dim))

    def act(
        self,
        state: State,
        memory: Float[Array, "stack obs"],
        step: Timestep,
        key: Key[Array, ""],
        explore: Bool[Array, ""],
    ) -> tuple[Float[Array, " action"], Float[Array, "stack obs"]]:
        """Perceive a timestep, and choose an action."""
        older = jnp.where(step.is_first, jnp.broadcast_to(step.obs, memory.shape), memory)
        memory = jnp.concatenate([older[1:], step.obs[None]])
        return self.choose(state.controller.actor(memory.reshape(-1)), key, explore), memory

    def stacks(self, windows: Window) -> Float[Array, "time batch belief"]:
        """The beliefs at every timestep of the windows, from the same memory as in acting."""
        begins = windows.step.is_first | ~windows.exists

        def perceive(memory, step):
            obs, first = step
            older = jnp.where(first[:, None, None], jnp.broadcast_to(obs[:, None], memory.shape), memory)
            memory = jnp.concatenate([older[:, 1:], obs[:, None]], axis=1)
            return memory, memory.reshape(len(memory), -1)

        _, batch, obs = windows.step.obs.shape
        return jax.lax.scan(perceive, jnp.zeros((batch, self.stack, obs)), (windows.step.obs, begins))[1]

    def batches(self, windows: Window) -> Batch:
        """The first transition of every window, split for a cycle's updates: leaves (update, batch, ...)."""
        transitions = self.transitions(windows, self.stacks(windows)[self.stack - 1 :])
        return split_updates(jax.tree.map(lambda leaf: leaf[:1], transitions), self.batch_size)

    def pretrain(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Metrics]:
        """One update of the pre-training."""
        return self.update(state, jax.tree.map(lambda leaf: leaf[0], self.batches(windows)), key)

    def begin_cycle(self, state: State, windows: Window, key: Key[Array, ""]) -> tuple[State, Batch, Metrics]:
        """The batch of each update."""
        return state, self.batches(windows), {}


def main(quick: bool = False) -> None:
    """Train on the pendulum whose angle is observed and whose velocity is hidden, two seeds side by side."""
    if quick:
        agent = StackAgent(step_start_rl=300, pretrain_updates=100)
        run = beliefrl.train(agent, "pendulum-p", "runs/stack-quick", resume=True, steps=600, seeds=2)
    else:
        run = beliefrl.train(StackAgent(), "pendulum-p", "runs/stack", resume=True, steps=6_000, seeds=2)
    for seed in run.seeds:
        means = {row["step"]: round(sum(row["sampled"]) / len(row["sampled"])) for row in run.rows(seed, "evaluation")}
        print(f"seed {seed}: return at each evaluation {means}")


if __name__ == "__main__":
    tyro.cli(main)

# The command line accepts this agent too, in the folder of this file. Its fields are options.
#
#     beliefrl train 03_a_new_agent:StackAgent pendulum-p --stack 4 --steps 6000 --out runs/stack-4
#     beliefrl resume runs/stack-4 --steps 10000 --agent 03_a_new_agent:StackAgent
#     beliefrl evaluate runs/stack-4 --agent 03_a_new_agent:StackAgent
#     beliefrl video runs/stack-4 stack.gif --agent 03_a_new_agent:StackAgent
#     beliefrl bench 03_a_new_agent:StackAgent
