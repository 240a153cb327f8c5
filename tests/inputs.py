"""Made-up inputs: random windows for agents, and folders of runs for figures, tables and reports."""

import json
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from beliefrl.runs.run import Run
from beliefrl.types import Spec, Timestep, Window

SPEC = Spec(obs_dim=3, action_dim=2, max_steps=50)
SMALL = {  # VRM
    "d_size": 8,
    "z_size": 4,
    "hidden_size": 8,
    "policy_layers": (8, 8),
    "value_layers": (8, 8),
    "seq_len": 6,
    "batch_size": 2,
    "burn_in": 4,
}


@partial(jax.jit, static_argnums=(1, 2))
def windows(key, batch, time, is_first=None, exists=None):
    """Random windows of `time` timesteps that begin at an episode's first, where nothing else is said.

    `is_first` and `exists` are (batch, time), what is returned (time, batch, ...).
    """
    keys = jax.random.split(key, 3)
    none = jnp.zeros((batch, time), bool)
    is_first = none.at[:, 0].set(True) if is_first is None else is_first
    action = jnp.tanh(jax.random.normal(keys[2], (batch, time, SPEC.action_dim)))
    step = Timestep(
        jax.random.normal(keys[0], (batch, time, SPEC.obs_dim)),
        jnp.where(is_first, 0.0, jax.random.normal(keys[1], (batch, time))),
        jnp.where(is_first[..., None], 0.0, action),
        is_first,
        none,
    )
    window = Window(step, (), ~none if exists is None else exists)
    return jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), window)


def same(a, b):
    """Whether two trees are equal to the last bit."""
    return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool(np.all(np.asarray(x) == np.asarray(y))), a, b)))


def differ(a, b):
    """Whether every array of two trees differs."""
    return all(jax.tree.leaves(jax.tree.map(lambda x, y: bool(np.any(np.asarray(x) != np.asarray(y))), a, b)))


def changed_where_missing(agent, state, window, exists):
    """What a cycle and its updates make of windows, and of the same with other timesteps where none exist."""
    other = windows(jax.random.key(9), *exists.shape)
    other = other._replace(note=jax.tree.map(lambda leaf: leaf + 1.0, window.note))
    exists = exists.T
    changed = jax.tree.map(
        lambda a, b: jnp.where(exists.reshape(exists.shape + (1,) * (a.ndim - 2)), a, b),
        window._replace(exists=exists, reading=None),
        other._replace(exists=exists),
    )

    @jax.jit
    def learned(window):
        after, batches, metrics = agent.begin_cycle(state, window, jax.random.key(2))
        after, more = agent.update(after, jax.tree.map(lambda leaf: leaf[0], batches), jax.random.key(3))
        return after, metrics | more

    return [learned(given._replace(exists=exists, reading=window.reading)) for given in (window, changed)]


def slope(function, at, direction, by=1e-2):
    """The derivative of a function of a tree along a direction, by central differences."""
    ahead, behind = (
        function(jax.tree.map(lambda x, d, sign=sign: x + sign * by * d, at, direction)) for sign in (1, -1)
    )
    return float((ahead - behind) / (2 * by))


def random_like(tree, key):
    """Standard normal numbers in the shape of a tree."""
    return jax.jit(_random_like)(tree, key)


def _random_like(tree, key):
    leaves, structure = jax.tree.flatten(tree)
    keys = jax.random.split(key, len(leaves))
    return structure.unflatten([jax.random.normal(k, leaf.shape) for k, leaf in zip(keys, leaves, strict=True)])


def along(gradient, direction):
    """A gradient's slope along a direction."""
    return float(sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction))))


# Folders of runs that are written by hand.

EVIL = "</script><img src=x onerror=alert(1)>"
HOUR = {"started": "2026-01-01T10:00:00+00:00", "ended": "2026-01-01T11:00:00+00:00", "device": "cpu"}
TWO_SEEDS = [[(10, [1.0, 2.0]), (20, [3.0, 5.0])], [(10, [-1.0, 4.0]), (20, [7.0, 7.0])]]
ONE_UPDATE = [(1, {"loss": 0.0})]


def a_folder(
    folder, seeds, agent="vrm", task="pendulum-v", steps=20, first=0, diverged=(), updates=ONE_UPDATE, **config
):
    """A folder with these evaluations of each seed: (step, returns with sampled actions[, successes]).

    `updates` are rows of every seed's learning: (step, {name: value}).
    """
    (folder / "metrics").mkdir(parents=True)
    options = {"seed": first, "seeds": len(seeds), "steps": steps}
    whole = {"agent": agent, "hyperparameters": {}, "task": task, "constants": {}, "options": options} | config
    (folder / "config.json").write_text(json.dumps(whole))
    for seed, rows in enumerate(seeds, first):
        lines = [{"step": step, "kind": "update", **values} for step, values in updates]
        for step, returns, *success in rows:
            rates = {"sampled_success": success[0], "mode_success": [True]} if success else {}
            lines.append({"step": step, "kind": "evaluation", "sampled": returns, "mode": [7.0], **rates})
        if seed in diverged:
            last = lines[-1]["step"] if lines else 0
            lines.append({"step": last + 5, "kind": "diverged", "why": "a loss is not finite"})
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics" / f"seed-{seed}.jsonl").write_text(text)
    return folder


def a_run(folder, seeds, steps=None, settings=None, updates=(), **rest):
    """The run in such a folder. It is finished, unless `steps` is higher than its last evaluation."""
    last = max((rows[-1][0] for rows in seeds if rows), default=1)
    steps = last if steps is None else steps
    return Run(a_folder(folder, seeds, steps=steps, hyperparameters=settings or {}, updates=updates, **rest))


def flat(*returns):
    """Evaluations at 10, 20, ... steps with one episode each."""
    return [(10 * (index + 1), [value]) for index, value in enumerate(returns)]


class Places:
    """The part of `sweeps.places.Local` that counts free slots, for fake trainings."""

    has_gpus = False

    def __init__(self, folder, slots):
        self.folder, self.slots, self.running = folder, slots, {}

    @property
    def room(self):
        return len(self.slots) - len(self.running)
