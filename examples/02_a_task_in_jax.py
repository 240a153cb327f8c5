"""A task in pure JAX. It is compiled together with the agent, so many seeds are trained in one program.

    pip install -c constraints.txt -e .             # in a clone of the repository
    python examples/02_a_task_in_jax.py             # 6,000 steps: 1 min 44 s of CPU time
    python examples/02_a_task_in_jax.py --quick     # 1,000 steps, enough to see the difference: 42 s of CPU time

The first observation of an episode shows whether a lamp is on the left or on the right. After some steps in the dark,
the agent must point to it. Without memory the best return is 0, with memory it is 1. The agents are small: an LSTM with
a state of size 32 is enough to remember a side. Each start makes new folders.
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


SMALL = {"policy_layers": (64, 64), "value_layers": (64, 64), "step_start_rl": 300, "pretrain_updates": 0}
FAST = {"lr_actor": 1e-3, "lr_critic": 1e-3}
MEMORY = {"d_size": 32, "lr_lstm": 1e-3, "seq_len": 14, "burn_in": 7, "batch_size": 16}


def main(quick: bool = False) -> None:
    """Train an agent with memory and one without, two seeds of each side by side."""
    options = {"steps": 1_000 if quick else 6_000, "seeds": 2, "eval_every": 500, "eval_episodes": 50}
    memory = beliefrl.train(beliefrl.make_agent("sac-lstm", **SMALL, **FAST, **MEMORY), Lamp(), **options)
    blind = beliefrl.train(beliefrl.make_agent("sac-mlp", **SMALL, **FAST), Lamp(), **options)
    for name, run in (("with memory", memory), ("without memory", blind)):
        print(f"return {name}, per seed: {[round(mean, 2) for mean in run.results()['mode']['seeds']]}")


if __name__ == "__main__":
    tyro.cli(main)
