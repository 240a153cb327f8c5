"""BeliefRL: recurrent reinforcement learning under partial observability.

import beliefrl

agent = beliefrl.make_agent("vrm")
task = beliefrl.make_task("pendulum-v")
run = beliefrl.train(agent, task, steps=15_000, seeds=3, out="runs/first")
print(beliefrl.evaluate(run, episodes=20))
"""

import importlib
from typing import TYPE_CHECKING, Any

from beliefrl.catalogue import register_when_imported

if TYPE_CHECKING:
    from beliefrl.agents import Agent
    from beliefrl.agents import make as make_agent
    from beliefrl.agents.hyperparameters import Range
    from beliefrl.analysis.figures import draw_curve
    from beliefrl.errors import UserError
    from beliefrl.policy import Policy, load
    from beliefrl.report import write_report
    from beliefrl.runs.options import Options
    from beliefrl.runs.run import Run
    from beliefrl.sweeps.experiments import Experiment, grid
    from beliefrl.sweeps.run import SweepStatus, sweep
    from beliefrl.sweeps.tune import Tuned, tune
    from beliefrl.tasks import Task, observe, with_action_repeat, with_faults
    from beliefrl.tasks import make as make_task
    from beliefrl.tasks.check import TaskCheck, check
    from beliefrl.tasks.environment import TaskEnvironment
    from beliefrl.tasks.faults import Faults
    from beliefrl.tasks.gymnasium import GymnasiumTask
    from beliefrl.training.evaluation import evaluate
    from beliefrl.training.restore import task_of
    from beliefrl.training.schedule import Event
    from beliefrl.training.stop import Stopped
    from beliefrl.training.train import resume, train
    from beliefrl.types import Spec, StoredTimestep, Timestep, Window, WindowShape
    from beliefrl.viewing.demo import demo
    from beliefrl.viewing.episodes import Trajectory, make_env, play
    from beliefrl.viewing.films import film, video
    from beliefrl.viewing.prediction import Predictions, draw_predictions, predictions

register_when_imported()  # gymnasium.make("BeliefRL/PendulumV-v0")

__all__ = [
    "Agent",
    "Event",
    "Experiment",
    "Faults",
    "GymnasiumTask",
    "Options",
    "Policy",
    "Predictions",
    "Range",
    "Run",
    "Spec",
    "Stopped",
    "StoredTimestep",
    "SweepStatus",
    "Task",
    "TaskCheck",
    "TaskEnvironment",
    "Timestep",
    "Trajectory",
    "Tuned",
    "UserError",
    "Window",
    "WindowShape",
    "check",
    "demo",
    "draw_curve",
    "draw_predictions",
    "evaluate",
    "film",
    "grid",
    "load",
    "make_agent",
    "make_env",
    "make_task",
    "observe",
    "play",
    "predictions",
    "resume",
    "sweep",
    "task_of",
    "train",
    "tune",
    "video",
    "with_action_repeat",
    "with_faults",
    "write_report",
]

# Each name is imported when it is first used, so `import beliefrl` and the command line's lists do not wait for JAX.
_HOMES = {
    "Agent": "agents:Agent",
    "Event": "training.schedule:Event",
    "Experiment": "sweeps.experiments:Experiment",
    "Faults": "tasks.faults:Faults",
    "GymnasiumTask": "tasks.gymnasium:GymnasiumTask",
    "Options": "runs.options:Options",
    "Policy": "policy:Policy",
    "Predictions": "viewing.prediction:Predictions",
    "Range": "agents.hyperparameters:Range",
    "Run": "runs.run:Run",
    "Spec": "types:Spec",
    "Stopped": "training.stop:Stopped",
    "StoredTimestep": "types:StoredTimestep",
    "SweepStatus": "sweeps.run:SweepStatus",
    "Task": "tasks:Task",
    "TaskCheck": "tasks.check:TaskCheck",
    "TaskEnvironment": "tasks.environment:TaskEnvironment",
    "Timestep": "types:Timestep",
    "Trajectory": "viewing.episodes:Trajectory",
    "Tuned": "sweeps.tune:Tuned",
    "UserError": "errors:UserError",
    "Window": "types:Window",
    "WindowShape": "types:WindowShape",
    "check": "tasks.check:check",
    "demo": "viewing.demo:demo",
    "draw_curve": "analysis.figures:draw_curve",
    "draw_predictions": "viewing.prediction:draw_predictions",
    "evaluate": "training.evaluation:evaluate",
    "film": "viewing.films:film",
    "grid": "sweeps.experiments:grid",
    "load": "policy:load",
    "make_agent": "agents:make",
    "make_env": "viewing.episodes:make_env",
    "make_task": "tasks:make",
    "observe": "tasks:observe",
    "play": "viewing.episodes:play",
    "predictions": "viewing.prediction:predictions",
    "resume": "training.train:resume",
    "sweep": "sweeps.run:sweep",
    "task_of": "training.restore:task_of",
    "train": "training.train:train",
    "tune": "sweeps.tune:tune",
    "video": "viewing.films:video",
    "with_action_repeat": "tasks:with_action_repeat",
    "with_faults": "tasks:with_faults",
    "write_report": "report:write_report",
}


def __getattr__(name: str) -> Any:
    """A name of `__all__`, or a module of the package."""
    module, _, attribute = _HOMES.get(name, name).partition(":")
    if name == "__version__":
        from importlib.metadata import version

        value = version("beliefrl")
    elif attribute:
        value = getattr(importlib.import_module(f"beliefrl.{module}"), attribute)
    else:
        value = _module(name)
    globals()[name] = value
    return value


def _module(name: str) -> Any:
    qualified = f"{__name__}.{name}"
    try:
        return importlib.import_module(qualified)
    except ModuleNotFoundError as error:
        if error.name != qualified:
            raise
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
