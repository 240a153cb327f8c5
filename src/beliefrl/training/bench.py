"""The cost of a step: milliseconds per environment step at any sizes, in parts, and the speed of the machine.

The task is synthetic: its observations are noise. `ms_per_step` is the time of the training loop, including the
pre-training divided by the 100,000 steps of the paper's scalability table. Each part named `alone` is timed in a
program of its own. The sum of the parts can exceed the whole, because there each call writes networks and optimisers
to new memory, and each update is a call. The loop updates them in place, and makes all updates of a cycle in one
program. So the parts show what is large, and not the shares of a step. Timings are medians.
"""

import dataclasses
import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from beliefrl.agents import Agent
from beliefrl.errors import UserError
from beliefrl.runs.options import Options, Precision
from beliefrl.training import phases
from beliefrl.training import replay as ring
from beliefrl.training.rounding import at_precision
from beliefrl.training.rounds import stretch_length
from beliefrl.training.schedule import capacity
from beliefrl.types import Spec, check_range

PAPER_STEPS = 100_000  # steps of the wall-clock times in the paper's scalability table
REPEATS = 9


@dataclasses.dataclass(frozen=True)
class Noise:
    """A task of given sizes whose observations are noise."""

    obs_dim: int
    action_dim: int

    def __post_init__(self) -> None:
        check_range(self, ("obs_dim", "action_dim"), 1)

    @property
    def spec(self) -> Spec:
        return Spec(self.obs_dim, self.action_dim, max_steps=1000)

    def reset(self, key: Key[Array, ""]) -> tuple[tuple[()], Float[Array, " obs"]]:
        return (), jax.random.normal(key, (self.obs_dim,))

    def step(
        self, state: tuple[()], action: Float[Array, " action"], key: Key[Array, ""]
    ) -> tuple[tuple[()], Float[Array, " obs"], Float[Array, ""], Bool[Array, ""]]:
        return (), jax.random.normal(key, (self.obs_dim,)), jnp.mean(action), jnp.array(False)


def median_seconds(call: Callable[[], Any]) -> float:
    """The median time of a call after a first one; waits for the results."""
    jax.block_until_ready(call())
    times = []
    for _ in range(REPEATS):
        before = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - before)
    return statistics.median(times)


def matmul_gflops() -> float:
    """The machine's measured rate of a large float32 matrix product, in GFLOP/s."""
    matrix = jax.random.normal(jax.random.key(0), (2048, 2048))
    product = jax.jit(lambda a: a @ a)
    return 2 * matrix.shape[0] ** 3 / median_seconds(lambda: product(matrix)) / 1e9


def parameters(tree: Any) -> int:
    """The number of numbers in the arrays of a tree."""
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


class _Timed:
    """Calls phases in turn on the same seeds, and times each."""

    def __init__(self, agent: Agent, task: Noise, seeds: int):
        self.agent, self.step = agent, 0
        room = capacity(agent, Options(steps=max(PAPER_STEPS // seeds, agent.step_start_rl)))
        self.program = phases.compile_program(agent, task, capacity=room, episodes=1)
        self.keys = jax.random.split(jax.random.key(0), seeds)
        self.seeds = jax.block_until_ready(self.program.begin(self.keys))

    def explore(self, steps: int) -> float:
        return self._call(lambda seeds: self.program.explore(seeds, self.step, steps)[0], steps)

    def pretrain(self, updates: int) -> float:
        return self._call(lambda seeds: self.program.pretrain(seeds, 0, updates)[0], 0)

    def learn(self, cycles: int) -> float:
        return self._call(lambda seeds: self.program.learn(seeds, self.step, cycles)[0], cycles * self.agent.cycle)

    def _call(self, phase: Callable[[phases.SeedState], phases.SeedState], steps: int) -> float:
        """Seconds of one call."""
        before = time.perf_counter()
        self.seeds = jax.block_until_ready(phase(self.seeds))
        self.step += steps
        return time.perf_counter() - before


def bench(
    agent: Agent,
    obs: int,
    actions: int,
    seeds: int = 1,
    precision: Precision = Options.precision,
    started: float | None = None,
) -> dict[str, Any]:
    """Time an agent's training with observations and actions of these sizes, `seeds` of them in one program.

    Args:
        agent: the agent with its hyperparameters.
        obs, actions: sizes of the task's observation and action.
        seeds: all times are for a step of all seeds together.
        precision: of matrix products, as in a training.
        started: `time.time()` at which the program began, for `first_training_step_s`.

    Returns:
        ms_per_step; acting_alone_ms, controller_update_alone_ms and model_update_alone_ms (see the module's docstring);
        pretraining_ms; all of these per environment step. pretraining_ms_per_update; first_training_step_s (from the
        program's start to the end of the first cycle of learning, with exploration and pre-training shortened to one
        block); compile_s, its part for compilation; matmul_gflops; gflop_per_step, of the updates' matrix products that
        are executed (`_flop`); share_of_peak, the rate of gflop_per_step in the loop divided by matmul_gflops, the rate
        of float32; parameters of one seed; obs, actions, seeds, precision, device.
    """
    if not 1 <= seeds <= 2 * PAPER_STEPS:
        raise UserError(f"seeds={seeds} is impossible: it must be from 1 to {2 * PAPER_STEPS}.")
    with jax.default_matmul_precision(Options(precision=precision).precision):  # checked there
        measured = _bench(agent, obs, actions, seeds, time.time() if started is None else started)
    return measured | {"precision": precision, "device": str(jax.devices()[0].device_kind)}


def _bench(agent: Agent, obs: int, actions: int, seeds: int, started: float) -> dict[str, Any]:
    stretch = stretch_length(agent)
    cycles = stretch // agent.cycle
    timed = _Timed(agent, Noise(obs, actions), seeds)
    first = [timed.explore(stretch), timed.pretrain(1) if agent.pretrain_updates else 0.0, timed.learn(1)]
    first_training_step = time.time() - started

    acting = _per(timed.explore, stretch)
    pretraining = _per(timed.pretrain, 10) if agent.pretrain_updates else 0.0
    whole = _per(lambda count: timed.learn(count // agent.cycle), cycles * agent.cycle)
    parts, flop = _update_parts(agent, timed)
    pretraining_per_step = pretraining * agent.pretrain_updates / PAPER_STEPS
    peak = matmul_gflops()
    return {
        "ms_per_step": 1e3 * (whole + pretraining_per_step),
        "acting_alone_ms": 1e3 * acting,
        **{f"{name}_alone_ms": 1e3 * seconds for name, seconds in parts.items()},
        "pretraining_ms": 1e3 * pretraining_per_step,
        "pretraining_ms_per_update": 1e3 * pretraining,
        "first_training_step_s": first_training_step,
        "compile_s": sum(first),
        "matmul_gflops": peak,
        "gflop_per_step": flop / 1e9,
        "share_of_peak": flop / whole / 1e9 / peak,
        "parameters": parameters(agent.networks(timed.seeds.state)) // seeds,
        "obs": obs,
        "actions": actions,
        "seeds": seeds,
    }


def _per(call: Callable[[int], float], count: int) -> float:
    """Median seconds of a call divided by `count`; the first call is not counted."""
    return statistics.median([call(count) for _ in range(REPEATS + 1)][1:]) / count


def _update_parts(agent: Agent, timed: _Timed) -> tuple[dict[str, float], float]:
    """The updates' seconds per environment step, and their floating-point operations (`_flop`)."""
    seeds = timed.seeds

    def read(seed: phases.SeedState, key: Key[Array, ""]):
        return ring.windows(seed.replay, seed.readers, key, agent.cycle_windows, agent.window)[0]

    windows = jax.jit(jax.vmap(read))(seeds, timed.keys)
    given = (seeds.state, windows, timed.keys)

    def mapped(function: Callable[..., Any]) -> Callable[..., Any]:
        return jax.jit(jax.vmap(function))

    # If only the state is an output, XLA removes the beliefs, so the difference is their cost.
    has_model = bool(jax.eval_shape(mapped(lambda *args: agent.begin_cycle(*args)[2]), *given))
    model = mapped(lambda *args: at_precision(agent.begin_cycle)(*args)[0])
    begin = mapped(lambda *args: at_precision(agent.begin_cycle)(*args)[:2])
    update = mapped(lambda *args: at_precision(agent.update)(*args)[0])
    state, batches = begin(*given)
    batch = jax.tree.map(lambda leaf: leaf[:, 0], batches)
    updates = jax.tree.leaves(batches)[0].shape[1] / agent.cycle  # per environment step

    s_begin = median_seconds(lambda: begin(*given))
    s_model = median_seconds(lambda: model(*given)) if has_model else 0.0
    s_update = median_seconds(lambda: update(state, batch, timed.keys)) * updates
    parts = {
        "controller_update": s_update + max(s_begin - s_model, 0.0) / agent.cycle,
        "model_update": s_model / agent.cycle,
    }
    flop = _flop(begin, *given) / agent.cycle + _flop(update, state, batch, timed.keys) * updates
    return parts, flop


def _flop(function: Callable[..., Any], *args: Any) -> float:
    """Floating-point operations of the matrix products that are executed; products in loops count for each iteration.

    A product that is written twice with the same factors (as W_s s in Q(s, a) and Q(s, ã)) is executed once and counted
    once. A product over an axis of length 1 is an outer product, which XLA computes entry by entry. Like all other
    operations on single entries, it is not counted (1.4 % of the operations of VRM's controller update).
    """

    def count(jaxpr: Any) -> float:
        total, known = 0.0, {}  # known: a number for each value that was computed, by how it is computed
        values = {variable: variable for variable in [*jaxpr.constvars, *jaxpr.invars]}
        for equation in jaxpr.eqns:
            name, parameters = equation.primitive.name, equation.params
            factors = tuple(str(v) if hasattr(v, "val") else values[v] for v in equation.invars)  # val: of a constant
            if name == "stop_gradient":
                values[equation.outvars[0]] = factors[0]
                continue
            how = name, factors, str(parameters)
            is_new = how not in known
            number = known.setdefault(how, len(known))
            values.update({variable: (number, index) for index, variable in enumerate(equation.outvars)})
            if not is_new:
                continue
            if name == "dot_general":
                contracted = parameters["dimension_numbers"][0][0]
                length = math.prod(equation.invars[0].aval.shape[axis] for axis in contracted)
                total += 2 * math.prod(equation.outvars[0].aval.shape) * length * (length > 1)
            inner = [getattr(value, "jaxpr", value) for value in jax.tree.leaves(list(parameters.values()))]
            runs = parameters["length"] if name == "scan" else 1
            total += runs * sum(count(part) for part in inner if hasattr(part, "eqns"))
        return total

    return count(jax.make_jaxpr(function)(*args).jaxpr)
