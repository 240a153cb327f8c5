"""Tasks and an agent with nothing in them but what a test needs to see."""

import dataclasses
from functools import partial
from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from beliefrl import agents, tasks
from beliefrl.runs.recorder import Recorder
from beliefrl.runs.run import Run
from beliefrl.types import Spec, WindowShape, transitions

TINY = {
    "vrm": {"d_size": 8, "z_size": 4, "hidden_size": 8},
    "sac-mlp": {},
    "sac-lstm": {"d_size": 8},
    "predictive-sac": {"d_size": 8, "hidden_size": 8, "observation_memory": (4.0, 32.0)},
    "slac": {"z1_size": 2, "z2_size": 4, "model_layers": (8,), "history": 3},
}


def tiny(name, **hyperparameters):
    """An agent with small networks; an ablation's name will do."""
    sizes = TINY["vrm" if name.startswith("vrm") else name]
    return agents.make(name, policy_layers=(8,), value_layers=(8,), **(sizes | hyperparameters))


@partial(jax.jit, static_argnums=(0, 1))
def begun(name, spec, key):
    """The state in which a small agent begins."""
    return tiny(name).init(key, spec)


def saved(folder, name, task, seeds=1, agent=None):
    """A run of a small agent (`agent`, if it is not `tiny(name)`) that was saved before it has learned anything."""
    begin = partial(begun, name, task.spec) if agent is None else lambda key: agent.init(key, task.spec)
    agent = tiny(name) if agent is None else agent
    states = jax.vmap(begin)(jax.random.split(jax.random.key(0), seeds))
    config = {
        "agent": name,
        "hyperparameters": dataclasses.asdict(agent),
        **tasks.describe(task),
        "options": {"steps": 100, "seed": 4, "seeds": seeds},
    }
    recorder = Recorder(folder, config)
    recorder.save(states)
    recorder.close()
    return Run(folder)


class Counter(gymnasium.Env):
    """Observes and shows how many steps the episode has had, on a picture of an odd width; terminates at `ends`."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 125}
    observation_space = spaces.Box(0.0, 100.0, (2,), np.float32)
    action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, render_mode=None, ends=9):
        self.render_mode, self.ends = render_mode, ends

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.full(2, self.steps, np.float32), float(self.steps), self.steps >= self.ends, False, {}

    def render(self):
        return np.full((20, 31, 3), 10 * self.steps, np.uint8) if self.render_mode == "rgb_array" else None


@dataclasses.dataclass(frozen=True)
class Counting:
    """Observes how many steps the episode has had; pays that number; terminates at `ends`, if that comes first."""

    ends: int = 1000
    max_steps: int = 7

    @property
    def spec(self):
        return Spec(obs_dim=1, action_dim=1, max_steps=self.max_steps, measures=("success",))

    def reset(self, key):
        return jnp.array(0), jnp.zeros(1)

    def step(self, state, action, key):
        state = state + 1
        return state, state[None].astype(float), state.astype(float), state >= self.ends

    def measures(self, state):
        return {"success": state >= 5}


class Alternating(Counting):
    """Its reward is the action, with a sign that changes at each step."""

    def step(self, state, action, key):
        state, obs, _, terminated = super().step(state, action, key)
        return state, obs, jnp.where(state % 2 == 0, action[0], -action[0]), terminated


class CountingState(NamedTuple):
    offset: Any  # what `refresh` can see changing
    seen: Any  # transitions that were checked


@dataclasses.dataclass(frozen=True)
class CountingAgent:
    """Counts the timesteps it perceives, notes the count, and checks every window that it is given.

    `broken` counts what contradicts: an observation that is not the count, a note that is not the observation, a
    transition whose parts are not one timestep apart, a terminal timestep followed by anything.
    """

    step_start_rl: int = 10
    train_interval_rl: int = 2
    pretrain_updates: int = 3
    cycle: int = 4
    pretrain_windows: int = 5
    cycle_windows: int = 8
    window: ClassVar = WindowShape(3, 6)
    empty: ClassVar = 3.0  # the count before the first: whoever takes zeros for an empty memory counts wrongly
    losses: ClassVar = ()

    def init(self, key, spec):
        return CountingState(jnp.zeros(()), jnp.zeros((), int))

    def networks(self, state):
        return state

    def reset(self, spec):
        return jnp.array(self.empty)

    def act(self, state, memory, step, key, explore):
        action = jnp.where(explore, jax.random.uniform(key, (1,), minval=-1.0), 0.5)
        return action, memory + 1

    def note(self, memory):
        return (memory - self.empty - 1,)

    def check(self, window):
        step, obs = window.step, window.step.obs[..., 0]
        valid = transitions(window, self.window.burn_in)
        now, after = slice(self.window.burn_in, -1), slice(self.window.burn_in + 1, None)
        wrong = obs[after] != obs[now] + 1
        wrong |= step.reward[after] != obs[after]
        wrong |= step.terminated[now]
        broken = jnp.sum(wrong & valid) + jnp.sum((window.note[0] != obs) & window.exists)
        return {"broken": broken.astype(float), "valid": jnp.sum(valid).astype(float)}

    def pretrain(self, state, windows, key):
        return state._replace(offset=state.offset + 1), self.check(windows)

    def begin_cycle(self, state, windows, key):
        batches = jax.tree.map(lambda leaf: leaf.reshape(len(leaf), 2, 4, *leaf.shape[2:]).swapaxes(0, 1), windows)
        return state, batches, {}

    def update(self, state, batch, key):
        metrics = self.check(batch)
        return state._replace(seen=state.seen + metrics["valid"].astype(int)), metrics


class ReadingAgent(CountingAgent):
    """Reads in order. `offset` counts the windows that continue; `broken` also counts those that begin elsewhere."""

    window: ClassVar = WindowShape(0, 6, readers=16, jump=0.25)

    def init(self, key, spec):
        return super().init(key, spec)._replace(seen=jnp.full(16, -1.0))  # the last observation of each reader

    def follow(self, state, windows):
        reader, continues = windows.reading
        obs = windows.step.obs[..., 0]
        broken = jnp.sum(continues & (obs[0] != state.seen[reader])).astype(float)
        return CountingState(state.offset + jnp.sum(continues), state.seen.at[reader].set(obs[-1])), broken

    def pretrain(self, state, windows, key):
        state, broken = self.follow(state, windows)
        metrics = self.check(windows)
        return state, metrics | {"broken": metrics["broken"] + broken}

    def begin_cycle(self, state, windows, key):
        state, broken = self.follow(state, windows)
        batches = jax.tree.map(lambda leaf: leaf[None], windows._replace(reading=None))
        return state, batches, {"jumped": broken}

    def update(self, state, batch, key):
        return state, self.check(batch)


def installed(folder, monkeypatch, group, lines="", **points):
    """The entry_points.txt of a package that is installed in a folder: NAME=MODULE:CLASS of a group."""
    info = folder / "some_package-1.0.dist-info"
    info.mkdir(parents=True)
    lines += "".join(f"{name.replace('_', '-')} = {value}\n" for name, value in points.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")
    monkeypatch.syspath_prepend(str(folder))
    return info / "entry_points.txt"


# Small agents through the phases of a training, as both loops run them.

SHARED = {"step_start_rl": 20, "policy_layers": (8,), "value_layers": (8,)}
MODELS = {"train_times_fivrm": 10, "d_size": 8, "z_size": 4, "hidden_size": 8}
SEQUENCES = {"seq_len": 8, "burn_in": 4, "batch_size": 2}


def trained(program, keys, cuts=(10, 10), learn=(10, 15), cycle=5):
    """Explore, pre-train, refresh and learn, in stretches of these lengths."""
    seeds, step, log = program.begin(keys), 0, []
    for steps in cuts:
        seeds, stretch = program.explore(seeds, step, steps)
        step += steps
    seeds, _ = program.pretrain(seeds, 0, 10)
    seeds = program.refresh(seeds)
    for steps in learn:
        seeds, stretch = program.learn(seeds, step, steps // cycle)
        log.append(jax.tree.map(np.asarray, stretch))
        step += steps
    return seeds, log


def leaves(tree):
    return [
        np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
        for x in jax.tree.leaves(tree)
    ]
