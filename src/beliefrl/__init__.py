"""BeliefRL: recurrent reinforcement learning under partial observability.

import beliefrl

agent = beliefrl.make_agent("vrm")
task = beliefrl.make_task("pendulum-v")
run = beliefrl.train(agent, task, steps=15_000, seeds=3, out="runs/first")
print(beliefrl.evaluate(run, episodes=20))
"""

from importlib.metadata import version

from beliefrl.agents import Agent
from beliefrl.agents import make as make_agent
from beliefrl.analysis.curves import draw_curve
from beliefrl.policy import Policy, load
from beliefrl.report import write_report
from beliefrl.runs.options import Options
from beliefrl.runs.run import Run
from beliefrl.sweeps.plan import Experiment, grid
from beliefrl.sweeps.run import SweepStatus, sweep
from beliefrl.tasks import Task, observe
from beliefrl.tasks import make as make_task
from beliefrl.tasks.environment import TaskEnvironment, register
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.evaluation import evaluate, task_of
from beliefrl.training.schedule import Event
from beliefrl.training.stop import Stopped
from beliefrl.training.train import resume, train
from beliefrl.types import Spec, StoredTimestep, Timestep, UserError, Window, WindowShape
from beliefrl.viewing.episodes import Trajectory, play
from beliefrl.viewing.films import film, video
from beliefrl.viewing.prediction import Predictions, draw_predictions, predictions

__version__ = version("beliefrl")
register()  # gymnasium.make("BeliefRL/PendulumV-v0")

__all__ = [
    "Agent",
    "Event",
    "Experiment",
    "GymnasiumTask",
    "Options",
    "Policy",
    "Predictions",
    "Run",
    "Spec",
    "Stopped",
    "StoredTimestep",
    "SweepStatus",
    "Task",
    "TaskEnvironment",
    "Timestep",
    "Trajectory",
    "UserError",
    "Window",
    "WindowShape",
    "draw_curve",
    "draw_predictions",
    "evaluate",
    "film",
    "grid",
    "load",
    "make_agent",
    "make_task",
    "observe",
    "play",
    "predictions",
    "resume",
    "sweep",
    "task_of",
    "train",
    "video",
    "write_report",
]
