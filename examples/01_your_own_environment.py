"""Train on your own environment with Gymnasium's interface: here a cart that must drive to a mark and stop there.

    pip install -c constraints.txt -e .                    # in a clone of the repository
    python examples/01_your_own_environment.py             # 6,000 steps: half a minute on two cores
    python examples/01_your_own_environment.py --quick     # 600 steps, to see it run: 22 s of CPU time

A registered environment needs no Python code. Here `my_robots` is a module that registers one:

    beliefrl train predictive-sac gym:my_robots:Cart-v0 --observe 0 --seeds 2
    beliefrl train predictive-sac gym:MountainCarContinuous-v0 --observe 0 --constants max_episode_steps=500

A second start continues the run in runs/cart. If that run is finished, it is not trained again.

The environment receives actions in the range of its own Box. The agent observes only the entries that `--observe`
selects (in Python: `indices`). Here it does not observe the cart's speed, and must infer it from past positions.
"""

import gymnasium
import numpy as np
import tyro

import beliefrl


class Cart(gymnasium.Env):
    """A cart on a track. The action is a force; the position of the mark changes with every episode."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)  # distance to the mark m, speed m/s
    action_space = gymnasium.spaces.Box(-3.0, 3.0, (1,), np.float32)  # force, N

    def reset(self, *, seed=None, options=None):
        """Start at a random distance, at rest."""
        super().reset(seed=seed)
        self.distance, self.speed = self.np_random.uniform(-2.0, 2.0), 0.0
        return self.observation(), {}

    def step(self, action):
        """Simulate a tenth of a second. The reward is the negative distance."""
        self.speed += 0.1 * float(action[0])
        self.distance += 0.1 * self.speed
        return self.observation(), -abs(self.distance), False, False, {}

    def observation(self):
        return np.array([self.distance, self.speed], np.float32)


def main(quick: bool = False) -> None:
    """Train without the speed. The environment never ends an episode, so this sets a time limit of 60 steps."""
    task = beliefrl.GymnasiumTask(Cart, indices=(0,), max_steps=60)
    if quick:
        small = {"d_size": 32, "seq_len": 16, "policy_layers": (32,), "value_layers": (32,)}
        agent = beliefrl.make_agent("predictive-sac", step_start_rl=300, pretrain_updates=100, **small)
        run = beliefrl.train(agent, task, "runs/cart-quick", resume=True, steps=600, eval_every=300)
    else:
        run = beliefrl.train("predictive-sac", task, "runs/cart", resume=True, steps=6_000, eval_every=1_000)

    for row in run.rows(seed=0, kind="evaluation"):
        print(f"step {row['step']}: return {np.mean(row['mode']):.1f}")
    policy, environment = beliefrl.load(run), beliefrl.make_env(task)
    obs, _ = environment.reset(seed=1)
    action, state = policy.predict(obs)
    for step in range(40):
        obs, reward, _, _, _ = environment.step(action)
        action, state = policy.predict(obs, reward, state)
        if step % 10 == 9:
            print(f"after {(step + 1) / 10:.0f} s the cart is {abs(obs[0]):.2f} m from the mark")


if __name__ == "__main__":
    tyro.cli(main)
