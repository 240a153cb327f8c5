"""Episodes of a trained agent: the environments in which it acts."""

import json

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RenderCollection

import beliefrl
from beliefrl import UserError, evaluate, load, make_env, make_task, with_faults
from beliefrl.cli import main
from beliefrl.tasks.gymnasium import GymnasiumTask
from worlds import Counter, saved
from wrong import Fine


def length(environment, policy):
    """The number of steps of an episode in which the policy acts."""
    obs, _ = environment.reset(seed=0)
    reward, state, done, steps = None, None, False, 0
    while not done:
        assert obs.shape == (policy.spec.obs_dim,)
        action, state = policy.predict(obs, reward, state)
        obs, reward, terminated, truncated, _ = environment.step(action)
        done, steps = terminated or truncated, steps + 1
    environment.close()
    return steps


def test_an_environment_is_made_from_a_run_its_folder_or_a_task(tmp_path):
    task = make_task("pendulum-v", max_steps=7)
    run = saved(tmp_path / "run", "sac-mlp", task)
    for of in (run, run.folder, str(run.folder), task):
        assert length(make_env(of), load(run)) == 7
    assert length(make_env("pendulum-v"), load(run)) == 200


def test_an_environment_of_gymnasium_shows_what_the_agent_sees(tmp_path):
    task = GymnasiumTask(Fine, indices=(1,))
    policy = load(saved(tmp_path / "run", "sac-mlp", task), task=task)
    assert length(make_env(task), policy) == 10
    assert np.array_equal(make_env(task).action_space.high, [1.0])
    assert make_env("gym:Pendulum-v1").observation_space.shape == (3,)


@pytest.mark.parametrize("faults", [None, {"noise": 0.1, "flicker_flag": True}])
@pytest.mark.filterwarnings("ignore:.*A Box observation space")
def test_it_is_a_complete_environment_of_gymnasium(faults):
    def made(**arguments):
        return make_env(make_task("gym:Pendulum-v1", faults=faults, **arguments))

    check_env(made(), skip_render_check=True)
    environment = RenderCollection(made(render_mode="rgb_array"), pop_frames=False)
    environment.reset(seed=0)
    environment.step(np.zeros(1, np.float32))
    assert [frame.ndim for frame in environment.render()] == [3, 3]
    assert environment.metadata["render_fps"] == 30


@pytest.mark.parametrize("faults", [None, {"noise": 0.1}])
def test_a_wrong_action_or_a_step_before_a_reset_is_one_sentence(faults):
    environment = make_env(with_faults(Counter, faults))
    with pytest.raises(UserError, match="The environment has no state yet: call reset first"):
        environment.step(np.zeros(1))
    environment.reset(seed=0)
    with pytest.raises(UserError, match=r"The action has the shape \(3,\): it must be \(1,\)\."):
        environment.step(np.zeros(3))


def test_what_no_environment_can_be_made_of_is_one_sentence(tmp_path):
    for of in ("pendulum-x", tmp_path / "nowhere"):
        with pytest.raises(UserError):
            beliefrl.make_env(of)


def test_an_agent_of_velocities_is_not_evaluated_on_positions(tmp_path):
    """Both have two entries, and both names imply which."""
    run = saved(tmp_path / "run", "sac-mlp", make_task("cartpole-v"))
    with pytest.raises(
        UserError, match="on velocities of the observation, and the given task shows positions: give velocities"
    ):
        evaluate(run, task=make_task("cartpole-p"))


def played(capsys, folder, *options):
    main(["evaluate", str(folder), "--episodes", "2", "--json", *options])
    return json.loads(capsys.readouterr().out)["mode"]


def test_a_run_is_evaluated_with_other_constants_and_faults(tmp_path, capsys):
    run = saved(tmp_path / "run", "sac-mlp", make_task("pendulum-v", max_steps=20, faults={"noise": 0.5}))
    before = played(capsys, run.folder)
    assert before["lengths"] == [[20, 20]]
    assert played(capsys, run.folder, "--constants", "max_steps=7")["lengths"] == [[7, 7]]
    assert played(capsys, run.folder, "--constants", "mass=3.5")["returns"] != before["returns"]
    assert played(capsys, run.folder, "--faults", "noise=0.0")["returns"] != before["returns"]
    assert played(capsys, run.folder, "--faults", "noise=0.5") == before
    with pytest.raises(SystemExit) as ended:
        played(capsys, run.folder, "--constants", "weight=3")
    assert ended.value.code == 2
    assert "The task pendulum has no constant 'weight'" in capsys.readouterr().err
