"""A task in pure JAX. It is compiled together with the agent, so that many seeds train in one program.

    pip install beliefrl
    python examples/02_a_task_in_jax.py                  # 4,000 steps, two seeds
    python examples/02_a_task_in_jax.py --steps 300      # a short test run

The first observation of an episode shows whether a lamp is on the left or on the right. After some steps in the dark,
the agent must point to it. Without memory the best return is 0; with memory it is close to 1.
"""

import dataclasses

import jax
import jax.numpy as jnp
import tyro
from jaxtyping import Array, Bool, Float, Key

import beliefrl


@dataclasses.dataclass(frozen=True)
class Lamp:
    """Remember a side. Observation and action are one number each. The fields are the task's constants."""

    wait: int = 6  # steps in the dark

    @property
    def spec(self) -> beliefrl.Spec:
        """The sizes and the time limit. Here `step` never ends an episode itself."""
        return beliefrl.Spec(obs_dim=1, action_dim=1, max_steps=self.wait)

    def reset(self, key: Key[Array, ""]) -> tuple[tuple[Array, Array], Float[Array, "1"]]:
        """Draw a side. The state is (side, time); only this first observation shows the side."""
        side = jax.random.choice(key, jnp.array([-1.0, 1.0]))
        return (side, jnp.array(0)), side[None]

    def step(
        self, state: tuple[Array, Array], action: Float[Array, "1"], key: Key[Array, ""]
    ) -> tuple[tuple[Array, Array], Float[Array, "1"], Float[Array, ""], Bool[Array, ""]]:
        """Reward only the last action."""
        side, time = state
        reward = jnp.where(time + 1 == self.wait, side * action[0], 0.0)
        return (side, time + 1), jnp.zeros(1), reward, jnp.array(False)

    def success(self, state: tuple[Array, Array]) -> Bool[Array, ""]:
        """Not used, since `has_success` of the spec is False."""
        return jnp.array(False)


def main(steps: int = 4_000, seeds: int = 2, agent: str = "sac-lstm", out: str = "runs/lamp") -> None:
    """Train with memory, `seeds` seeds side by side."""
    task = Lamp()
    run = beliefrl.train(agent, task, out, steps=steps, seeds=seeds, eval_every=1_000, eval_episodes=20)
    results = beliefrl.evaluate(run, episodes=50, task=task)
    print(f"return per seed: {[round(total, 2) for total in results['mode']['seeds']]}")


if __name__ == "__main__":
    tyro.cli(main)
