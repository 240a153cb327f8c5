"""Train another library's agent on a task of ours: sb3-contrib's RecurrentPPO on the pendulum seen by its speed only.

    pip install beliefrl sb3-contrib
    python examples/05_train_elsewhere.py               # 5,000 steps: to see it run
    python examples/05_train_elsewhere.py --steps 500000

Random play gets a return of about -1200 an episode; -150 is a pendulum that is swung up and held.
"""

import argparse

import gymnasium
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import beliefrl  # noqa: F401 - after it, gymnasium.make knows BeliefRL/...


def main() -> None:
    parser = argparse.ArgumentParser(description="RecurrentPPO on BeliefRL/PendulumV-v0")
    parser.add_argument("--steps", type=int, default=5_000, help="of the environment, to train for")
    parser.add_argument("--episodes", type=int, default=20, help="to evaluate")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    environments = make_vec_env("BeliefRL/PendulumV-v0", n_envs=8, seed=args.seed)
    settings = {"learning_rate": 1e-3, "gamma": 0.9, "n_steps": 128, "batch_size": 512}
    agent = RecurrentPPO("MlpLstmPolicy", environments, **settings, seed=args.seed)
    agent.learn(args.steps)

    fresh = gymnasium.make("BeliefRL/PendulumV-v0")
    fresh.reset(seed=args.seed + 1)  # other episodes than those of the training
    mean, deviation = evaluate_policy(agent, fresh, n_eval_episodes=args.episodes, warn=False)
    print(f"Return after {agent.num_timesteps} steps: {mean:.1f}, standard deviation over episodes {deviation:.1f}")


if __name__ == "__main__":
    main()
