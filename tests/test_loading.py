"""A policy of a run on a Gymnasium environment needs no environment: the robot may be elsewhere."""

import json

import numpy as np
import pytest

from beliefrl import UserError, load
from beliefrl.runs.run import Run
from beliefrl.tasks.faults import Faults
from beliefrl.tasks.gymnasium import GymnasiumTask
from worlds import saved
from wrong import Fine


class Known(Fine):
    """Counts how many environments were made."""

    entry_names = ("angle", "speed")
    made = 0

    def __init__(self):
        Known.made += 1
        super().__init__()


def robot(folder, task, agent="predictive-sac"):
    """A run on this task, with the interface that a training records; forget how many environments that made."""
    run = saved(folder, agent, task)
    config = json.loads((folder / "config.json").read_text()) | {"interface": task.interface._asdict()}
    (folder / "config.json").write_text(json.dumps(config))
    Known.made = 0
    return Run(run.folder)


@pytest.mark.parametrize(
    ("task", "size"),
    [
        (GymnasiumTask(Known), 2),
        (GymnasiumTask(Known, indices=(1,)), 1),
        (GymnasiumTask(Known, faults=Faults(flicker=0.2, flicker_flag=True)), 3),
    ],
)
def test_no_environment_is_made(tmp_path, task, size):
    run = robot(tmp_path / "run", task)
    policy = load(run)
    assert (policy.spec.obs_dim, policy.spec.action_dim, Known.made) == (size, 1, 0)
    given = load(run, task=task)
    np.testing.assert_array_equal(policy.predict(np.ones(size))[0], given.predict(np.ones(size))[0])


def test_a_given_task_must_have_the_same_interface(tmp_path):
    class Renamed(Known):
        entry_names = ("speed", "angle")

    run = robot(tmp_path / "run", GymnasiumTask(Known))
    with pytest.raises(UserError, match="was trained in another environment: observed entries before"):
        load(run, task=Renamed)


def test_without_an_environment_the_export_is_compared_on_random_observations(tmp_path):
    onnx = pytest.importorskip("onnx")
    run = robot(tmp_path / "run", GymnasiumTask(Known, indices=(1,)))
    assert load(run).export(tmp_path / "policy.onnx") < 1e-5
    assert Known.made == 0  # the folder does not say where its class is
    about = {each.key: each.value for each in onnx.load(tmp_path / "policy.onnx").metadata_props}
    assert {name: json.loads(about[name]) for name in ("entries", "low", "high")} == {
        "entries": ["speed"],
        "low": [-2.0],
        "high": [6.0],
    }


@pytest.mark.parametrize(("name", "needed"), [("predictive-sac", True), ("sac-mlp", False), ("sac-lstm", False)])
def test_a_reward_that_the_agent_observes_cannot_be_left_out(tmp_path, name, needed):
    policy = load(robot(tmp_path / "run", GymnasiumTask(Known), name))
    _, state = policy.predict(np.ones(2))
    action, _ = policy.predict(np.ones(2), 0.0, state)
    if needed:
        with pytest.raises(UserError, match=f"reward is missing: {name} observes it"):
            policy.predict(np.ones(2), state=state)
    else:
        np.testing.assert_array_equal(policy.predict(np.ones(2), state=state)[0], action)
    policy.predict(np.ones(2), state=state, episode_start=True)
