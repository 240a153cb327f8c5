"""What runs in the process of an environment: it makes the environment, and ends when the training has ended."""

import multiprocessing
import os
import signal
import threading
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from beliefrl.errors import Fault, UserError
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.stop import SIGNALS

CLOSING = 60.0  # seconds that an environment has to close


def _end_with_parent() -> None:
    """End this process if its parent has ended and the environment, which hangs, has not been closed."""
    parent: Any = multiprocessing.parent_process()
    parent.join()
    time.sleep(CLOSING)
    os._exit(1)


def _ignore(number: int, frame: Any) -> None:
    """A handler that does nothing."""


class Factory:
    """Makes one lane's environment, in this process or a worker."""

    def __init__(self, task: GymnasiumTask, lane: str):
        self.task, self.lane, self.process = task, lane, os.getpid()
        self.sizes = task.spec.obs_dim, task.spec.action_dim

    def __call__(self) -> Any:
        if os.getpid() == self.process:
            return self.task.environment(self.lane)
        threading.Thread(target=_end_with_parent, daemon=True).start()
        for number in SIGNALS:  # sent to all processes of a job: the training saves, then ends these
            if signal.getsignal(number) != signal.SIG_IGN:  # by `nohup`
                signal.signal(number, _ignore)  # not SIG_IGN, which a program that the environment starts would inherit
        try:
            return self.task.environment(self.lane)
        except UserError as error:
            return _NotMade(f"{self.lane}: {error}", *self.sizes)


class _NotMade(gymnasium.Env[Any, Any]):
    """In place of an environment that cannot be made in its process: `reset` says why."""

    def __init__(self, why: str, obs: int, action: int):
        self.why = why
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs,), np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (action,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        raise Fault(self.why)
