"""The names of agents, tasks and known environments, and our tasks in Gymnasium's registry.

Nothing here imports JAX, so the command line lists names at once. Descriptions of agents and tasks are read from the
source of their classes. A known environment is a Gymnasium environment whose velocities are known.

`gymnasium.make("BeliefRL/PendulumV-v0")` makes one of our tasks. Only this call imports JAX.
"""

import ast
import difflib
import functools
import pathlib
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NamedTuple

from beliefrl.errors import UserError
from beliefrl.imports import declared

AGENT_GROUP = "beliefrl.agents"  # of entry points
TASK_GROUP = "beliefrl.tasks"


class Named(NamedTuple):
    """An agent's class and settings."""

    path: str  # module:Class
    about: str = ""  # description; empty: the first line of the class's docstring
    hyperparameters: dict[str, Any] = {}  # those that differ from the class's defaults


VRM = "beliefrl.agents.vrm:VRMAgent"
AGENTS: dict[str, Named] = {
    "vrm": Named(VRM),
    "sac-mlp": Named("beliefrl.agents.sac_mlp:SACMLPAgent"),
    "sac-lstm": Named("beliefrl.agents.sac_lstm:SACLSTMAgent"),
    "slac": Named("beliefrl.agents.slac:SLACAgent"),
    "predictive-sac": Named("beliefrl.agents.predictive_sac:PredictiveSACAgent"),
    "vrm-single": Named(VRM, "Ablation: one model that is pre-trained and keeps learning.", {"models": "single"}),
    "vrm-first": Named(VRM, "Ablation: only the first-impression model.", {"models": "first"}),
    "vrm-keep": Named(VRM, "Ablation: only the keep-learning model.", {"models": "keep"}),
    "vrm-deterministic": Named(
        VRM, "Ablation: models without noise, trained on squared error.", {"deterministic": True}
    ),
}
TASKS: dict[str, str] = {
    "pendulum": "beliefrl.tasks.pendulum:Pendulum",
    "cartpole": "beliefrl.tasks.cartpole:CartPole",
    "target-reaching": "beliefrl.tasks.target_reaching:TargetReaching",
}
MASKS = {"-v": "velocities", "-p": "positions"}


def agent_names() -> dict[str, str]:
    """The name and a description of every agent: ours, then those of installed packages, which are not imported."""
    ours = {name: agent.about or written(agent.path)["__doc__"] for name, agent in AGENTS.items()}
    return ours | _declared(AGENT_GROUP, ours)


def check_agent(name: str) -> None:
    """Raise a UserError if there is no agent of that name. A `module:Class` is not imported, and so not checked."""
    if name in AGENTS or ":" in name:
        return
    there = agent_names()
    if name not in there:
        near = difflib.get_close_matches(name, there, n=1)
        every = ", ".join(there)
        hint = f"did you mean {near[0]}?" if near else f"there is {every}, and MODULE:CLASS for one of your own."
        raise UserError(f"There is no agent {name!r}: {hint}")


def task_names() -> dict[str, str]:
    """The name and a description of every task: ours, then those of installed packages, which are not imported."""
    ours = our_task_names()
    return ours | _declared(TASK_GROUP, ours)


def our_task_names() -> dict[str, str]:
    """The name and a description of this library's tasks, in the order of the paper's table (Appendix B)."""
    listed = {}
    for name, path in TASKS.items():
        task = written(path)
        listed |= _masked(name, task["__doc__"], task.get("VELOCITIES", ()), task.get("POSITIONS", ()))
    for name, robot in ROBOTS.items():
        listed |= _masked(name, f"{robot.about} Needs the extra `{robot.extra}`.", robot.velocities, robot.positions)
    return listed


def environment_names() -> dict[str, str]:
    """The name and a description of each Gymnasium environment with known velocities, and of the form "gym:ID"."""
    listed = {}
    for known in GYMNASIUMS:
        extra = f" Needs the extra `{known.extra}`." if known.extra else ""
        listed[PREFIX + known.id] = f"{known.about} --observe velocities or positions.{extra}"
    listed[ANY] = "Any other Gymnasium environment with bounded continuous actions; --observe takes indices."
    return listed


@functools.cache
def written(path: str) -> dict[str, Any]:
    """The literal attributes and the docstring of one of our classes, module:Class, read from its source.

    Returns {name: value} of the annotated attributes with literal values, and the first line of the docstring as
    "__doc__". Imports nothing.
    """
    module, _, name = path.partition(":")
    file = pathlib.Path(__file__).parent.joinpath(*module.split(".")[1:]).with_suffix(".py")
    tree = ast.parse(file.read_text(encoding="utf-8"))
    kind = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    values: dict[str, Any] = {"__doc__": (ast.get_docstring(kind) or "").split("\n")[0]}
    for node in kind.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            try:
                values[node.target.id] = ast.literal_eval(node.value)
            except ValueError:  # computed
                continue
    return values


def split_mask(task: str) -> tuple[str, str | None]:
    """The name of a task without -v or -p, and which entries it shows: "velocities", "positions", or None for all."""
    mask = task[-2:]
    return (task[:-2], MASKS[mask]) if mask in MASKS else (task, None)


@functools.cache
def usual_constants(task: str) -> dict[str, Any] | None:
    """The default constants of one of our tasks, with lists for tuples as in JSON; None for a task of a package.

    Those of a `gym:ID` are its arguments, which are all given by the user.
    """
    base, _ = split_mask(task)
    if base in TASKS:
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in written(TASKS[base]).items()
        }
    if base in ROBOTS:
        return dict(ROBOTS[base].arguments)
    return {} if task.startswith(PREFIX) else None


def _declared(group: str, ours: dict[str, str]) -> dict[str, str]:
    return {name: f"{value}, of an installed package." for name, value in declared(group, ours).items()}


def _masked(name: str, about: str, velocities: tuple[int, ...], positions: tuple[int, ...]) -> dict[str, str]:
    """The description of a task, and of its versions that observe a part of the observation."""
    listed = {name: about}
    if velocities:
        listed[f"{name}-v"] = f"{name}, velocities only: entries {_listed(velocities)} of its observation"
        listed[f"{name}-p"] = f"{name}, no velocities: entries {_listed(positions)} of its observation"
    return listed


def _listed(indices: tuple[int, ...]) -> str:
    return ", ".join(map(str, indices))


PREFIX = "gym:"
BULLET = "pybullet_envs_gymnasium"


class Known(NamedTuple):
    """An environment with known velocities and positions in its observation."""

    id: str
    about: str
    velocities: tuple[int, ...]
    positions: tuple[int, ...]  # all other entries
    extra: str | None = None  # the extra of this package that it needs
    names: tuple[str, ...] = ()  # of the entries, if the environment itself has none; a unit follows in brackets
    arguments: tuple[tuple[str, Any], ...] = ()  # of gymnasium.make, (name, value)


def _known(
    id: str, about: str, size: int, velocities: tuple[int, ...], extra: str | None = None, names: tuple[str, ...] = ()
) -> Known:
    return Known(id, about, velocities, tuple(i for i in range(size) if i not in velocities), extra, names)


def _bullet(robot: str, joints: int, feet: int) -> Known:
    velocities = (3, 4, 5, *range(9, 8 + 2 * joints, 2))
    about = f"PyBullet's {robot}: run forward."
    id = f"{BULLET}:{robot}BulletEnv-v0"
    return _known(id, about, 8 + 2 * joints + feet, velocities, "robots")


def _mujoco(id: str, size: int, velocities: tuple[int, ...], names: tuple[str, ...] = ()) -> Known:
    return _known(id, f"MuJoCo's {id.split('-')[0]}.", size, velocities, "mujoco", names)


MUJOCO = {
    "hopper": _mujoco("Hopper-v5", 11, tuple(range(5, 11))),
    "walker2d": _mujoco("Walker2d-v5", 17, tuple(range(8, 17))),
    "ant": _mujoco("Ant-v5", 105, tuple(range(13, 27))),
    "halfcheetah": _mujoco("HalfCheetah-v5", 17, tuple(range(8, 17))),
}


ANY = "gym:ID or gym:PACKAGE:ID"

ROBOTS: dict[str, Known] = {
    "hopper": _bullet("Hopper", joints=3, feet=1),
    "walker2d": _bullet("Walker2D", joints=6, feet=2),
    "ant": _bullet("Ant", joints=8, feet=4),
    "halfcheetah": _bullet("HalfCheetah", joints=6, feet=6),
    "mujoco-hopper": MUJOCO["hopper"],
    "mujoco-walker2d": MUJOCO["walker2d"],
    "mujoco-ant": MUJOCO["ant"]._replace(  # without the contact forces, the last 78 numbers
        positions=tuple(range(13)), arguments=(("include_cfrc_ext_in_observation", False),)
    ),
    "mujoco-halfcheetah": MUJOCO["halfcheetah"],
}

GYMNASIUMS: tuple[Known, ...] = (
    _known("Pendulum-v1", "Gymnasium's pendulum.", 3, (2,), names=("cos θ", "sin θ", "θ̇ (rad/s)")),
    _known("MountainCarContinuous-v0", "A car too weak for its hill.", 2, (1,), names=("position", "velocity")),
    _mujoco("InvertedPendulum-v5", 4, (2, 3)),
    _mujoco(
        "InvertedDoublePendulum-v5",
        9,
        (5, 6, 7),
        (
            "x (m)",
            "sin θ₁",
            "sin θ₂",
            "cos θ₁",
            "cos θ₂",
            "ẋ (m/s)",
            "θ̇₁ (rad/s)",
            "θ̇₂ (rad/s)",
            "force at the end (N)",
        ),
    ),
    _mujoco("Swimmer-v5", 8, tuple(range(3, 8))),
    *MUJOCO.values(),
)

KNOWN: dict[str, Known] = {known.id: known for known in (*ROBOTS.values(), *GYMNASIUMS)}


def registered_ids() -> dict[str, str]:
    """{Gymnasium id: task name} of all tasks of this library, such as {"BeliefRL/PendulumV-v0": "pendulum-v"}."""
    return {
        f"BeliefRL/{path.partition(':')[2]}{mask[1:].upper()}-v0": name + mask
        for name, path in TASKS.items()
        for mask in ("", *(MASKS if "VELOCITIES" in written(path) else ()))
    }


def register() -> None:
    """Register all tasks of this library in Gymnasium. Repeated calls have no effect."""
    from gymnasium.envs import registration

    for identifier, name in registered_ids().items():
        if identifier not in registration.registry:
            base, _ = split_mask(name)
            registration.register(
                identifier,
                entry_point="beliefrl.tasks.environment:TaskEnvironment",
                max_episode_steps=written(TASKS[base])["max_steps"],
                kwargs={"task": name},
            )


class _WhenImported:
    """A finder of `sys.meta_path` that registers our tasks when any module imports Gymnasium.

    Importing Gymnasium here would delay the command line by a quarter of a second.
    """

    @classmethod
    def find_spec(cls, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != "gymnasium":
            return None
        found = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not cls)
        spec = next(filter(None, found), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                register()

            spec.loader.exec_module = execute_and_register
        return spec


def register_when_imported() -> None:
    """Register our tasks now if Gymnasium is already imported, otherwise when it is imported."""
    if "gymnasium" in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _WhenImported)
