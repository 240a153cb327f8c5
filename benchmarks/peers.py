"""One race of `race_peers.py`: trains one agent on a task with one seed, on one core, against the clock.

    PYTHON peers.py AGENT TASK SEED SECONDS CORE CHECKOUT_OF_POMDP_BASELINES

PYTHON must have the agent's library and beliefrl. The last line that is printed is the result, in JSON.
"""

import collections.abc
import functools
import importlib.metadata
import json
import os
import sys
import tempfile
import time
from typing import Any

LINES = {"pendulum-p": -200.0, "pendulum-v": -200.0, "cartpole-p": 900.0}  # mean returns to reach
IDS = {
    "pendulum-p": "BeliefRL/PendulumP-v0",
    "pendulum-v": "BeliefRL/PendulumV-v0",
    "cartpole-p": "BeliefRL/CartPoleP-v0",
}
EVERY, EPISODES = 1_000, 20  # steps between two evaluations, at least; episodes in each
EXPLORATION = 1_000  # steps with random actions, where an agent takes their number as a setting
MOST_STEPS = 10_000_000  # more than any race has time for


class Race:
    """The clock of a race, which stands still during evaluations, and the results of these."""

    def __init__(self, task: str, seconds: float):
        self.line, self.budget = LINES[task], seconds
        self.steps, self.compiling, self.has_reached = 0, 0.0, False
        self.evaluations: list[tuple[int, float, float]] = []  # steps, seconds, mean return
        self._counted, self._since = 0.0, time.perf_counter()  # seconds up to the last pause; None: it stands still

    @property
    def seconds(self) -> float:
        return self._counted + (0.0 if self._since is None else time.perf_counter() - self._since)

    @property
    def is_over(self) -> bool:
        return self.has_reached or self.seconds > self.budget

    def pause(self) -> None:
        """Stop the clock, before an evaluation."""
        self._counted, self._since = self.seconds, None

    def record(self, mean: float) -> None:
        """Start the clock again, after an evaluation with this mean return. After the race it does not count."""
        if not self.is_over:
            self.evaluations.append((self.steps, round(self._counted, 2), float(mean)))
            self.has_reached = bool(mean > self.line)
        self._since = time.perf_counter()

    def at(self, steps: int) -> bool:
        """Note how far the training is; returns whether the race is over."""
        self.steps = steps
        return self.is_over

    @property
    def is_evaluation_due(self) -> bool:
        last = self.evaluations[-1][0] if self.evaluations else 0
        return not self.is_over and self.steps // EVERY > last // EVERY

    def count_compilation(self, event: str, duration: float, **_: Any) -> None:
        """A listener of jax.monitoring."""
        if event.endswith("backend_compile_duration") and self._since is not None:
            self.compiling += duration


def beliefrl_agent(agent: str, task: str, seed: int, race: Race) -> None:
    """An agent of this library with its default settings."""
    import beliefrl

    def listen(event: beliefrl.Event) -> bool:
        if event.phase == "evaluating":
            race.pause()
        if event.evaluation is not None:  # leaves (seed, mode, episodes); mode 1 is that of mode actions
            race.record(event.evaluation.episode_return[0, 1].mean())
        return race.at(event.step)

    sizes = {"steps": 300_000, "eval_every": EVERY, "eval_episodes": EPISODES, "seed": seed, "track": ()}
    with tempfile.TemporaryDirectory() as folder:
        beliefrl.train(agent, task, f"{folder}/run", callback=listen, progress=False, **sizes)


def recurrent_ppo(task: str, seed: int, race: Race) -> None:
    """RecurrentPPO of sb3-contrib with the settings of rl-baselines3-zoo for PendulumNoVel-v1 and CartPoleNoVel-v1."""
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    import beliefrl  # noqa: F401 - registers BeliefRL/... in Gymnasium

    pendulum = {"n_steps": 1024, "gae_lambda": 0.95, "gamma": 0.9, "n_epochs": 10, "learning_rate": 1e-3}
    pendulum |= {"clip_range": 0.2, "use_sde": True, "sde_sample_freq": 4}
    cartpole = {"n_steps": 32, "batch_size": 256, "gae_lambda": 0.8, "gamma": 0.98, "n_epochs": 20}
    cartpole |= {"learning_rate": lambda left: 1e-3 * left, "clip_range": lambda left: 0.2 * left}
    settings, count, steps = (cartpole, 8, 100_000) if task == "cartpole-p" else (pendulum, 4, MOST_STEPS)

    fresh = make_vec_env(IDS[task], n_envs=EPISODES, seed=1_000_000 + seed)

    class Clock(BaseCallback):
        def _on_step(self) -> bool:
            return not race.at(self.num_timesteps)

        def _on_rollout_start(self) -> None:  # the updates on the last rollout are done
            if race.is_evaluation_due:
                race.pause()
                race.record(evaluate_policy(self.model, fresh, n_eval_episodes=EPISODES)[0])

    environments = make_vec_env(IDS[task], n_envs=count, seed=seed)
    RecurrentPPO("MlpLstmPolicy", environments, **settings, ent_coef=0.0, seed=seed).learn(steps, callback=Clock())


def memorax_sac(task: str, seed: int, race: Race) -> None:
    """Recurrent SAC of memorax. It needs a critic from us, because memorax 1.0.1 has none that fits its SAC."""
    import flashbax
    import flax.linen as nn
    import jax
    import jax.numpy as jnp
    import optax
    from gymnax.environments import spaces
    from memorax.algorithms import SAC, SACConfig
    from memorax.networks import MLP, RNN, FeatureExtractor, Network, heads

    from beliefrl import tasks

    made = tasks.make(task)
    actions, limit = made.spec.action_dim, made.spec.max_steps

    class Environment:
        """What memorax asks of an environment. Its SAC takes the end by the time limit for a terminal state."""

        def action_space(self, params: Any) -> spaces.Box:
            return spaces.Box(-1.0, 1.0, (actions,))

        def reset(self, key: Any, params: Any) -> Any:
            state, obs = made.reset(key)
            return obs, (state, 0)

        def step(self, key: Any, state: Any, action: Any, params: Any) -> Any:
            key_step, key_reset = jax.random.split(key)
            inner, obs, reward, terminated = made.step(state[0], action, key_step)
            done = terminated | (state[1] + 1 >= limit)
            begun, now = self.reset(key_reset, params), (obs, (inner, state[1] + 1))
            obs, state = jax.tree.map(lambda new, old: jnp.where(done, new, old), begun, now)
            return obs, state, reward, done, {}

    class Q(heads.ContinuousQNetwork):
        """Values with a last axis of length one, which memorax's SAC removes."""

        @nn.compact
        def __call__(self, x: Any, *, action: Any, **_: Any) -> Any:
            hidden = MLP(features=(128,))(jnp.concatenate([x, action], axis=-1))
            return nn.Dense(1)(hidden), {}

        @nn.nowrap
        def loss(self, output: Any, aux: Any, targets: Any) -> Any:
            return 0.5 * jnp.square(output[..., 0] - targets).mean()

    class Critic(nn.Module):
        """Two Qs on one recurrent network."""

        network: Network
        head1: Q
        head2: Q

        def __call__(self, obs: Any, mask: Any, action: Any, reward: Any, done: Any, carry: Any = None) -> Any:
            carry, x = self.network(obs, mask, action, reward, done, carry)
            return carry, (self.head1(x, action=action), self.head2(x, action=action))

        @nn.nowrap
        def initialize_carry(self, shape: Any) -> Any:
            return self.network.initialize_carry(shape)

    def recurrent(**head: nn.Module) -> Network:
        return Network(FeatureExtractor(MLP(features=(128,))), RNN(cell=nn.GRUCell(features=128)), **head)

    rates = {"actor_lr": 3e-4, "critic_lr": 3e-4, "alpha_lr": 3e-4, "gamma": 0.99, "tau": 0.005, "max_grad_norm": 0.5}
    counts = {"num_envs": 1, "num_eval_envs": EPISODES, "buffer_size": 100_000, "batch_size": 32}
    timing = {"train_frequency": 1, "target_update_frequency": 1, "learning_starts": EXPLORATION}
    config = SACConfig("SAC", **rates, **counts, **timing, initial_alpha=1.0, target_entropy_scale=1.0)
    networks = recurrent(head=heads.SquashedGaussian(actions)), Critic(recurrent(), Q(), Q()), heads.Alpha(1.0)
    # memorax's own buffer draws a sequence in a time that grows with its capacity; this one is of its dependency.
    buffer = flashbax.make_trajectory_buffer(
        add_batch_size=1,
        sample_batch_size=32,
        sample_sequence_length=64,
        period=1,
        min_length_time_axis=EXPLORATION,
        max_length_time_axis=100_000,
    )
    agent = SAC(config, Environment(), None, *networks, *[optax.adam(3e-4)] * 3, buffer)

    def play() -> float:
        """The mean return of the first episode of each environment."""
        _, steps = agent.evaluate(jax.random.key(1_000_000 + seed + race.steps), state, EPISODES * limit)
        reward, done = steps.reward.reshape(limit, EPISODES), steps.done.reshape(limit, EPISODES)
        return (reward * (done.cumsum(axis=0) - done == 0)).sum(axis=0).mean()

    key, state = agent.init(jax.random.key(seed))
    key, state = agent.warmup(key, state, EXPLORATION)
    while not race.at(int(state.step)):
        if race.is_evaluation_due:
            race.pause()
            race.record(play())
        key, state, _ = jax.block_until_ready(agent.train(key, state, 100))


def pomdp_baselines(checkout: str, task: str, seed: int, race: Race) -> None:
    """Recurrent TD3 of pomdp-baselines with the settings of its example notebook for the pendulum."""
    collections.Set = collections.abc.Set  # its logger needs this name, which Python 3.10 has removed
    sys.path.insert(0, checkout)
    import gymnasium
    import numpy as np
    import torch
    from buffers.seq_replay_buffer_vanilla import SeqReplayBuffer
    from policies.models.policy_rnn import ModelFreeOffPolicy_Separate_RNN
    from torchkit import pytorch_utils

    import beliefrl  # noqa: F401 - registers BeliefRL/... in Gymnasium

    torch.manual_seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - its replay draws from this one
    pytorch_utils.set_gpu_mode(False)
    environment, fresh = gymnasium.make(IDS[task]), gymnasium.make(IDS[task])
    environment.reset(seed=seed)
    environment.action_space.seed(seed)
    fresh.reset(seed=1_000_000 + seed)
    obs_dim, action_dim = environment.observation_space.shape[0], environment.action_space.shape[0]
    sizes = {"action_embedding_size": 8, "observ_embedding_size": 32, "reward_embedding_size": 8}
    sizes |= {"rnn_hidden_size": 128, "dqn_layers": [128, 128], "policy_layers": [128, 128]}
    noise = {"exploration_noise": 0.1, "target_noise": 0.2, "target_noise_clip": 0.5}
    gamma = 0.99 if task == "cartpole-p" else 0.9
    agent = ModelFreeOffPolicy_Separate_RNN(
        obs_dim, action_dim, "lstm", "td3", **sizes, lr=3e-4, gamma=gamma, tau=0.005, td3=noise
    )
    replay = SeqReplayBuffer(1_000_000, obs_dim, action_dim, sampled_seq_len=64, sample_weight_baseline=0.0)

    def episode(env: gymnasium.Env, explores: bool, acts_randomly: bool = False) -> list[tuple[Any, ...]]:
        """The steps (obs, action, reward, terminated, next_obs) of an episode."""
        steps, obs, ended = [], env.reset()[0], False
        action, reward, memory = agent.get_initial_info()
        while not ended:
            seen = torch.as_tensor(obs)[None]
            (action, *_), memory = agent.act(memory, action, reward, seen, deterministic=not explores)
            if acts_randomly:
                action = torch.as_tensor(env.action_space.sample())[None]
            after, gain, terminated, truncated, _ = env.step(action[0].numpy())
            steps.append((obs, action[0].numpy(), [gain], [terminated], after))
            obs, reward, ended = after, torch.tensor([[gain]], dtype=torch.float32), terminated or truncated
        return steps

    while not race.is_over:
        explored = race.steps >= EXPLORATION
        steps = episode(environment, explores=True, acts_randomly=not explored)
        replay.add_episode(*(np.array(column, np.float32) for column in zip(*steps, strict=True)))
        race.at(race.steps + len(steps))
        for _ in steps if explored else ():  # one update for each step
            if race.at(race.steps):
                return
            agent.update(pytorch_utils.np_to_pytorch_batch(replay.random_episodes(32)))
        if race.is_evaluation_due:
            race.pause()
            race.record(np.mean([sum(step[2][0] for step in episode(fresh, False)) for _ in range(EPISODES)]))


def run(library: str, task: str, seed: int, seconds: float, core: int, checkout: str) -> None:
    """Run one race in this process; prints its result as a line of JSON."""
    os.sched_setaffinity(0, {core})
    import jax.monitoring

    peers = {"RecurrentPPO": recurrent_ppo, "memorax SAC": memorax_sac}
    peers |= {"pomdp-baselines TD3": functools.partial(pomdp_baselines, checkout)}
    start = peers.get(library, functools.partial(beliefrl_agent, library))
    race = Race(task, seconds)
    jax.monitoring.register_event_duration_secs_listener(race.count_compilation)
    start(task, seed, race)
    result = {"library": library, "task": task, "seed": seed, "steps": race.steps, "seconds": round(race.seconds, 1)}
    result |= {"compiling": round(race.compiling, 1), "budget": seconds, "evaluations": race.evaluations}
    names = {found.metadata["Name"] for found in importlib.metadata.distributions()}
    versions = {
        name: importlib.metadata.version(name) for name in ("jax", "torch", "sb3_contrib", "memorax") if name in names
    }
    print(json.dumps(result | {"versions": versions}))


if __name__ == "__main__":
    if len(sys.argv) != 7:
        sys.exit(__doc__)
    run(sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]), sys.argv[6])
