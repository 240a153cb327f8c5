"""Train another library's agent on a BeliefRL task: RecurrentPPO of sb3-contrib on `pendulum-v`.

    pip install -c constraints.txt -e . sb3-contrib   # in a clone of the repository; it brings PyTorch
    python examples/05_train_elsewhere.py             # 20,000 steps: 8 minutes of CPU time
    python examples/05_train_elsewhere.py --quick     # 2,048 steps, to see it run: 40 s of CPU time

The program saves nothing. The return of an episode is about -1200 for a random policy, and -150 if the pendulum is
swung up and held. In our run, RecurrentPPO had a return of about -1400 after 20,000 steps: it needs many more.
"""

import argparse

import gymnasium
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import beliefrl  # noqa: F401 - registers BeliefRL/... in Gymnasium


def main() -> None:
    parser = argparse.ArgumentParser(description="RecurrentPPO on BeliefRL/PendulumV-v0")
    parser.add_argument("--quick", action="store_true", help="train for 2,048 steps, and evaluate two episodes")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    steps, episodes = (2_048, 2) if args.quick else (20_000, 20)

    environments = make_vec_env("BeliefRL/PendulumV-v0", n_envs=8, seed=args.seed)
    settings = {"learning_rate": 1e-3, "gamma": 0.9, "n_steps": 128, "batch_size": 512}
    agent = RecurrentPPO("MlpLstmPolicy", environments, **settings, seed=args.seed)
    agent.learn(steps)

    fresh = gymnasium.make("BeliefRL/PendulumV-v0")
    fresh.reset(seed=args.seed + 1)  # episodes that differ from those of the training
    mean, deviation = evaluate_policy(agent, fresh, n_eval_episodes=episodes, warn=False)
    print(f"Return after {agent.num_timesteps} steps: {mean:.1f}, standard deviation over episodes {deviation:.1f}")


if __name__ == "__main__":
    main()
