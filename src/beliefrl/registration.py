"""Register our tasks in Gymnasium: `gymnasium.make("BeliefRL/PendulumV-v0")`. JAX is imported only by that call."""

import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

from beliefrl import catalogue


def ids() -> dict[str, str]:
    """{Gymnasium id: task name} of all tasks of this library, such as {"BeliefRL/PendulumV-v0": "pendulum-v"}."""
    return {
        f"BeliefRL/{path.partition(':')[2]}{mask[1:].upper()}-v0": name + mask
        for name, path in catalogue.TASKS.items()
        for mask in ("", *(catalogue.MASKS if "VELOCITIES" in catalogue.written(path) else ()))
    }


def register() -> None:
    """Register all tasks of this library in Gymnasium. Repeated calls have no effect."""
    from gymnasium.envs import registration

    for identifier, name in ids().items():
        if identifier not in registration.registry:
            path = catalogue.TASKS[name if name in catalogue.TASKS else name[:-2]]
            registration.register(
                identifier,
                entry_point="beliefrl.tasks.environment:TaskEnvironment",
                max_episode_steps=catalogue.written(path)["max_steps"],
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
