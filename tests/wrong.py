"""Faulty environments, one for each kind of fault."""

import multiprocessing
import os
import pathlib
import signal
import sys
import time

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from beliefrl.training import environment_process

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)
IMAGE = spaces.Box(0, 255, (64, 64, 3), np.uint8)


class Fine(gymnasium.Env):
    """A correct environment: two numbers in the observation, one in the action, ten steps per episode."""

    observation_space = BOX
    action_space = spaces.Box(-2.0, 6.0, (1,), np.float32)

    def __init__(self, **changes):
        for name, value in changes.items():
            setattr(self, name, value)
        self.time = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.observe(), {}

    def observe(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def reward(self):
        return 1.0

    def end(self):
        return False, self.time >= 10

    def step(self, action):
        self.action, self.time = action, self.time + 1
        return (*[self.observe(), self.reward()], *self.end(), {"success": self.time >= 10})


def when(late, now):
    """A method that calls `now` at the third step of an episode, and the usual method `late` otherwise."""

    def method(self):
        return now(self) if self.time == 3 else late(self)

    return method


def with_observation(value):
    observe = when(Fine.observe, lambda self: value() if callable(value) else value)
    return type("Fine", (Fine,), {"observe": observe})


def with_reward(value):
    return type("Fine", (Fine,), {"reward": when(Fine.reward, lambda self: value)})


def with_end(*values):
    return type("Fine", (Fine,), {"end": when(Fine.end, lambda self: values)})


def with_step(function):
    def step(self, action):
        result = Fine.step(self, action)
        return function(self, result) if self.time == 3 else result

    return type("Fine", (Fine,), {"step": step})


def raising(error):
    def function(self, result):
        raise error

    return with_step(function)


def changing(self, result):
    self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    return result


class Dictionary(Fine):
    observation_space = spaces.Dict({"a": BOX, "b": spaces.Discrete(3)})

    def observe(self):
        return {"a": np.zeros(2, np.float32)} if self.time == 3 else {"a": np.ones(2, np.float32), "b": 1}


class Endless(Fine):
    def end(self):
        return False, False


def reset_of(value):
    return type("Fine", (Fine,), {"reset": lambda self, **_: value})


def failing_reset(self, **_):
    raise RuntimeError("no robot is connected")


def failing_init(self):
    raise OSError("cannot open /dev/robot")


def spaced(**given):
    return type("Fine", (Fine,), given)


def observing(space, right, wrong):
    """An environment with this space, and an observation that is not in it."""
    observe = when(lambda self: right, lambda self: wrong)
    return type("Fine", (Fine,), {"observation_space": space, "observe": observe})


UNSUPPORTED = {  # environment: a phrase of the message
    spaced(action_space=spaces.Discrete(3)): "not discrete",
    spaced(action_space=spaces.Dict({"a": BOX})): "not discrete or composite",
    spaced(action_space=spaces.Box(-np.inf, np.inf, (1,), np.float32)): "unbounded",
    spaced(action_space=spaces.Box(0, 3, (1,), np.int32)): "real numbers",
    spaced(action_space=spaces.Box(-1.0, 1.0, (), np.float32)): "at least one number",
    spaced(action_space=None): "has the actions None",
    spaced(action_space=spaces.Box(np.array([-1.0, 0.5]), np.array([1.0, 0.5]), dtype=np.float64)): (
        "an action that can only be 0.5, entry 1 of its Box"
    ),
    spaced(observation_space=IMAGE): "observes images",
    spaced(observation_space=spaces.Dict({"arm": BOX, "camera": IMAGE})): "uint8) at ['camera'])",
    spaced(observation_space=spaces.Tuple([BOX, spaces.Dict({"eye": IMAGE})])): "uint8) at [1]['eye'])",
    spaced(observation_space=spaces.Text(20)): "has the observations Text",
    spaced(observation_space=spaces.Dict({"arm": BOX, "word": spaces.Text(20)})): "at ['word']: only Box",
    spaced(observation_space=spaces.Tuple([BOX, spaces.Sequence(BOX)])): "at [1]: only Box",
    spaced(observation_space=spaces.Box(-1.0, 1.0, (5000,), np.float32)): "an observation of 5,000 numbers",
    spaced(observation_space=spaces.Dict({"arm": BOX, "cell": spaces.Discrete(10**6)})): "of 1,000,002 numbers",
    spaced(observation_space=spaces.Dict({})): "without numbers",
    spaced(observation_space=spaces.Graph(BOX, None)): "has the observations Graph",
    spaced(observation_space=spaces.Sequence(BOX)): "and Dict and Tuple of these",
    spaced(observation_space=spaces.Box(-1.0, 1.0, (0,), np.float32)): "without numbers",
    spaced(observation_space=None): "observations None",
    spaced(__init__=failing_init): "OSError: cannot open /dev/robot",
    lambda: None: "robot has the actions None",
}

PAIR = spaces.MultiDiscrete([2, 3])
BOXES = spaces.Dict({"arm": BOX, "imu": BOX})
UNBOUNDED = spaces.Box(-np.inf, np.inf, (2,), np.float32)
FAULTS = {  # environment: (a phrase of the message, the step that it names)
    observing(PAIR, np.array([1, 2]), np.array([2, 0])): ("does not fit its space MultiDiscrete", 3),
    observing(spaces.Discrete(3), 1, -1): ("does not fit its space Discrete", 3),
    observing(spaces.Discrete(3), 1, np.zeros(2, int)): ("does not fit its space Discrete", 3),
    observing(spaces.Dict({"a": PAIR}), {"a": [1, 2]}, {"a": [1]}): (" at ['a']", 3),
    observing(spaces.Dict({"a": spaces.MultiBinary(2)}), {"a": [0, 1]}, {"a": [0, 1, 1]}): (" at ['a']", 3),
    observing(spaces.Dict({"a": spaces.Discrete(3)}), {"a": 1}, {"a": -1}): ("does not fit its space Dict", 3),
    observing(spaces.Tuple([spaces.MultiBinary(2), BOX]), ([0, 1], np.ones(2)), ([5, 7], np.ones(2))): (
        "does not fit its space Tuple",
        3,
    ),
    raising(ZeroDivisionError("division by zero")): ("step raised ZeroDivisionError: division by zero", 3),
    raising(RuntimeError("100 %\n  of two lines\n")): ("step raised RuntimeError: 100 % of two lines", 3),
    raising(AssertionError()): ("step raised AssertionError", 3),
    with_step(lambda self, result: sys.exit("bye")): ("step raised SystemExit: bye", 3),
    with_step(lambda self, result: result[:2] + result[3:]): ("step did not return", 3),
    with_step(lambda self, result: None): ("step did not return", 3),
    with_step(changing): ("its action space changed from Box(-2.0, 6.0", 3),
    with_observation(np.array([0.0, np.nan])): ("entry 1 of the observation is nan", 3),
    with_observation(np.array([np.inf, 0.0])): ("entry 0 of the observation is inf", 3),
    with_observation(np.array([1e300, 0.0])): ("entry 0 of the observation is 1e+300", 3),
    observing(UNBOUNDED, np.zeros(2), np.array([0.0, 1e25])): (
        "entry 1 of the observation is 1e+25, but must be a number from -1e+15 to 1e+15",
        3,
    ),
    with_observation(np.array([0.0, -202.0])): ("entry 1 of the observation is -202.0, far outside its space", 3),
    with_observation(np.array([1e6, 0.0])): ("which says -1.0 to 1.0: correct the observation", 3),
    with_observation(np.zeros(3)): ("the observation has shape (3,), but its space says (2,)", 3),
    with_observation(np.zeros((1, 2))): ("the observation has shape (1, 2)", 3),
    with_observation(0.5): ("the observation has shape ()", 3),
    with_observation(np.array(["left", "right"])): ("the observation has type <U5", 3),
    with_observation(np.zeros(2, complex)): ("the observation has type complex128", 3),
    with_observation([[1.0], [2.0, 3.0]]): ("the observation has type object", 3),
    with_observation(None): ("the observation has type object", 3),
    Dictionary: ("the observation does not fit its space Dict", 3),
    observing(BOXES, {"arm": np.ones(2), "imu": np.ones(2)}, {"arm": np.ones(2), "imu": np.ones(3)}): (
        " at ['imu']",
        3,
    ),
    observing(BOXES, {"arm": np.ones(2), "imu": np.ones(2)}, {"arm": np.ones(2)}): (" at ['imu']", 3),
    observing(BOXES, {"arm": np.ones(2), "imu": np.ones(2)}, {"arm": np.ones(2), "imu": np.array([0, np.nan])}): (
        "entry 3 of the observation (imu 1) is nan",
        3,
    ),
    with_reward(float("nan")): ("the reward is nan", 3),
    with_reward(float("inf")): ("the reward is inf", 3),
    with_reward(-1e200): ("the reward is -1e+200", 3),
    with_reward(-1e25): ("the reward is -1e+25, but must be a number from -1e+15 to 1e+15", 3),
    with_reward(np.ones(1)): ("the reward is of shape (1,), but must be one number", 3),
    with_reward(None): ("the reward is None", 3),
    with_reward("much"): ("the reward is 'much'", 3),
    with_end(None, False): ("terminated is None, but must be True or False", 3),
    with_end(False, "soon"): ("truncated is 'soon'", 3),
    with_end(2, False): ("terminated is 2", 3),
    Endless: ("the episode has not ended after 25 steps", 25),
    spaced(reset=failing_reset): ("reset raised RuntimeError: no robot is connected", 0),
    reset_of(np.zeros(2, np.float32)): ("reset did not return", 0),
    reset_of((np.full(2, np.nan), {})): ("entry 0 of the observation is nan", 0),
}


def killed(self, result):
    os.kill(os.getpid(), signal.SIGKILL)


Killed = with_step(killed)
Raising = raising(ValueError("out of range"))


# A process of its own imports these, so they are in a module that it finds.
class Sleeping(Fine):
    """Its third step takes long."""

    def step(self, action):
        if self.time == 2:
            time.sleep(0.5)
        return super().step(action)


class Stuck(Fine):
    """Its third step takes a minute if the action is positive."""

    def step(self, action):
        if self.time == 2 and self.action > 0:
            time.sleep(60)
        return super().step(action)


class StuckReset(Fine):
    """Its second reset takes a minute."""

    resets = 0

    def reset(self, *, seed=None, options=None):
        self.resets += 1
        if self.resets == 2:
            time.sleep(60)
        return super().reset(seed=seed, options=options)


class Unmade(Fine):
    """Ends the second of the processes that make it."""

    def __init__(self):
        super().__init__()
        if multiprocessing.current_process().name.endswith("-1"):
            os._exit(3)


class StuckClose(Fine):
    """In a process of its own it takes a minute to close it."""

    def close(self):
        if multiprocessing.parent_process() is not None:
            time.sleep(60)


class Orphan(Stuck):
    """Writes the number of its process to a file, and waits for half a second when its parent has ended."""

    def __init__(self, folder):
        super().__init__()
        environment_process.CLOSING = 0.5
        (pathlib.Path(folder) / str(os.getpid())).touch()


class Closing(Fine):
    """Writes a file when it is closed after a step. Its third step fails if the action is positive."""

    def __init__(self, folder):
        self.folder = pathlib.Path(folder)

    def step(self, action):
        if self.time == 2 and action > 2:
            raise ValueError("out of range")
        return super().step(action)

    def close(self):
        if getattr(self, "time", 0):
            (self.folder / f"closed-{os.getpid()}-{id(self)}").touch()


class WithChild(Fine):
    """Starts a process of its own, as some simulators do."""

    def reset(self, *, seed=None, options=None):
        child = multiprocessing.get_context("spawn").Process(target=print)
        child.start()
        child.join()
        return super().reset(seed=seed, options=options)


class Single(Fine):
    """There can be one at a time in a process."""

    is_there = False

    def __init__(self):
        if Single.is_there:
            raise RuntimeError("only one simulation per process")
        Single.is_there = True
        super().__init__()

    def close(self):
        Single.is_there = False


class OnlyHere(Fine):
    """Cannot be made in another process."""

    def __init__(self):
        if multiprocessing.parent_process() is not None:
            raise OSError("the port is in use")
        super().__init__()


class Wide(Fine):
    """Switches JAX to 64 bits when it is made."""

    def __init__(self):
        jax.config.update("jax_enable_x64", True)
        super().__init__()
