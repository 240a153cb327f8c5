"""Predictions against the inference model and a loop by hand; and played episodes: time steps, actions, frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import beliefrl
from beliefrl import tasks
from beliefrl.agents.slac import SLACAgent
from beliefrl.analysis import figures
from beliefrl.errors import UserError
from beliefrl.models import latent_model, variational_model
from beliefrl.models.nets import Gaussian, draw
from beliefrl.models.variational_model import VRM
from beliefrl.policy import Policy
from beliefrl.tasks.drawing import paint
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.types import Timestep, perception
from beliefrl.viewing import prediction
from beliefrl.viewing.episodes import Player
from worlds import Counter, Counting, CountingAgent, begun, saved, tiny

TASK = tasks.make("pendulum-p", max_steps=12)
TIME, START, X, ACTION, Z = 7, 4, 3, 1, 4


def close(ours, theirs):
    jax.tree.map(lambda our, their: np.testing.assert_allclose(our, their, rtol=1e-5, atol=1e-6), ours, theirs)


def normal(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def episode():
    """A made-up episode."""
    is_first = jnp.arange(TIME) == 0
    reward, prev_action = jnp.where(is_first, 0.0, normal(1, TIME)), normal(2, TIME, ACTION)
    prev_action = jnp.where(is_first[:, None], 0.0, prev_action)
    return Timestep(normal(0, TIME, X - 1), reward, prev_action, is_first, jnp.zeros(TIME, bool))


def vrm(deterministic):
    return jax.jit(lambda key: draw(key, VRM(X, ACTION, 8, Z, 8, deterministic)))(jax.random.key(3))


EPISODE, NOISE = episode(), (normal(4, TIME, Z), normal(5, TIME, X))
INPUTS = perception(EPISODE), EPISODE.prev_action
ALL, BEFORE = jnp.arange(TIME) >= 0, jnp.arange(TIME) < START


@jax.jit
def predicted_by_hand(model, seen):
    """START steps by the inference model; the rest, too, if all are `seen`, or else from the model's own samples."""
    x, prev_action = INPUTS
    batched = (leaf[:, None] for leaf in (x, prev_action, EPISODE.is_first, NOISE[0]))
    inferred = jax.tree.map(lambda leaf: leaf[:, 0], model.infer(model.start(1), *batched))
    decoded = jax.vmap(model.decode)(inferred.before, inferred.z)
    state, rows = jax.tree.map(lambda leaf: leaf[START - 1], inferred.state), []
    for t in range(START, TIME):
        if model.deterministic:  # z does not depend on x
            timestep = jnp.zeros(X), prev_action[t], jnp.array(False), jnp.zeros(Z)
            start = jax.tree.map(lambda leaf: leaf[None], state)
            z = model.infer(start, *(leaf[None, None] for leaf in timestep)).z[0, 0]
        else:
            prior = model.prior(state.d, prev_action[t])
            z = prior.mean + prior.sigma * NOISE[0][t]
        rows.append(model.decode(state.d, z))
        draw = rows[-1].mean + (0.0 if model.deterministic else rows[-1].sigma) * NOISE[1][t]
        state = model.next_state(state, draw, z)
    alone = jax.tree.map(lambda known, *own: jnp.stack([*known[:START], *own]), decoded, *rows)
    mean, sigma = jax.tree.map(lambda all_seen, own: jnp.where(seen.all(), all_seen, own), decoded, alone)
    return Gaussian(mean, jnp.zeros_like(sigma) if model.deterministic else sigma)


@pytest.mark.parametrize("deterministic", [False, True])
def test_the_open_loop_decodes_the_posterior_and_the_closed_loop_goes_on_from_its_own_draws(deterministic):
    model = vrm(deterministic)
    ask = jax.jit(lambda model, seen: variational_model.predict(model, *INPUTS, seen, NOISE))
    for seen in (ALL, BEFORE):
        close(ask(model, seen), predicted_by_hand(model, seen))
    assert not np.allclose(ask(model, ALL).mean[START:], ask(model, BEFORE).mean[START:])


@pytest.mark.slow
def test_slacs_open_loop_is_what_is_decoded_from_the_posterior():
    model = begun("slac", TASK.spec, jax.random.key(3)).model
    noise = normal(4, TIME, 2), normal(5, TIME, 4)

    @jax.jit
    def both(model):
        batched = (leaf[:, None] for leaf in (*INPUTS, EPISODE.is_first))
        latents = model.infer(*batched, tuple(leaf[:, None] for leaf in noise))
        z1, z2 = latents.z1[:, 0], latents.z2[:, 0]
        reward = model.reward(z1[:-1], z2[:-1], INPUTS[1][1:], z1[1:], z2[1:])
        return latent_model.predict(model, *INPUTS, ALL, noise), model.decoder(z1, z2), reward

    (mean, sigma), obs, reward = both(model)
    close(Gaussian(mean[:, :-1], sigma[:, :-1]), obs)
    close(Gaussian(mean[1:, -1:], sigma[1:, -1:]), reward)
    assert np.isnan(mean[0, -1])


ASKED = [("vrm", "first"), ("vrm-deterministic", "keep"), ("slac", "latent"), ("predictive-sac", "lstm")]


@pytest.mark.parametrize(("name", "model"), ASKED)
def test_the_closed_loop_sees_nothing_from_its_start_on_but_actions(name, model):
    agent = tiny(name)
    state, key = begun(name, TASK.spec, jax.random.key(0)), jax.random.key(1)
    ask = jax.jit(lambda steps, seen: agent.predict(state, model, steps, seen, key))
    blind = EPISODE._replace(
        obs=jnp.where(BEFORE[:, None], EPISODE.obs, jnp.nan), reward=jnp.where(BEFORE, EPISODE.reward, jnp.nan)
    )
    closed = ask(EPISODE, BEFORE)
    close(ask(blind, BEFORE), closed)
    still = EPISODE._replace(prev_action=jnp.where(BEFORE[:, None], EPISODE.prev_action, 0.0))
    assert not np.allclose(ask(still, BEFORE).mean[START:], closed.mean[START:])
    opened = ask(EPISODE, ALL)
    close(*(jax.tree.map(lambda leaf: leaf[:START], loop) for loop in (opened, closed)))
    assert not np.allclose(opened.mean[START + 1 :], closed.mean[START + 1 :])


class Dice:
    """Predicts a random number, drawn with its key, with σ = 2."""

    def predict(self, state, model, steps, seen, key):
        mean = jnp.full((3, 2), jax.random.normal(key, ()))
        return Gaussian(mean, jnp.full((3, 2), 2.0))


def test_many_draws_are_one_mixture():
    drawn = [float(jax.random.normal(key, ())) for key in jax.random.split(jax.random.key(7), 50)]
    mean, sigma = prediction.predict(Dice(), (), "", EPISODE, ALL, 50, jax.random.key(7))
    np.testing.assert_allclose(mean, np.full((3, 2), np.mean(drawn)), rtol=1e-5)
    np.testing.assert_allclose(sigma, np.full((3, 2), np.sqrt(4.0 + np.var(drawn))), rtol=1e-5)


def few(run, **changes):
    return beliefrl.predictions(run, **{"samples": 2, "start": 3, "horizon": 4} | changes)


@pytest.mark.parametrize(
    ("episode", "seed"), [({}, 4), ({"seed": 5, "episode_seed": 7, "sampled": True}, 5)], ids=["usual", "chosen"]
)
def test_a_prediction_stands_beside_the_truth_of_its_time(tmp_path, monkeypatch, episode, seed):
    """A model that copies its input makes no error in the open loop, and in the closed loop only from `start` on."""

    def copy(self, state, model, step, seen, key):
        x = perception(step)
        return Gaussian(jnp.where(seen[:, None], x, x + 2.0), jnp.zeros_like(x))

    monkeypatch.setattr(SLACAgent, "predict", copy)
    run = saved(tmp_path / "run", "slac", TASK, seeds=2)
    predicted = few(run, **episode)
    played = perception(beliefrl.play(run, **episode).steps)
    np.testing.assert_allclose(predicted.truth, played[:7])
    np.testing.assert_allclose(predicted.open_loop.mean, predicted.truth)
    np.testing.assert_allclose(
        predicted.closed_loop.mean - predicted.truth, np.repeat([0.0, 2.0], (9, 12)).reshape(7, 3)
    )
    opened, closed = predicted.errors()
    assert opened.tolist() == [0.0] * 3
    np.testing.assert_allclose(closed, 2.0)
    assert predicted.entries == (0, 1)
    assert predicted.title == f"slac on pendulum-p, seed {seed}: latent model"


@pytest.mark.nightly
def test_a_short_episode_is_seen_to_its_half(tmp_path):
    run = saved(tmp_path / "run", "vrm-keep", TASK)
    assert few(run, start=None, horizon=1).start == 6  # whatever the horizon is
    predicted = few(run, start=None, horizon=100)
    assert predicted.start == 6
    assert predicted.truth.shape == (13, 3)
    assert all(np.isfinite(leaf).all() for leaf in (*predicted.open_loop, *predicted.closed_loop))


@pytest.mark.parametrize(
    ("name", "changes", "sentence"),
    [
        ("sac-mlp", {}, "is a run of sac-mlp, which offers no predictions"),
        ("sac-lstm", {}, "is a run of sac-lstm, which offers no predictions"),
        ("vrm-keep", {"model": "first"}, "vrm-keep has no model 'first': it has keep"),
        ("predictive-sac", {"model": "keep"}, "predictive-sac has no model 'keep': it has lstm"),
        ("slac", {"model": "keep"}, "slac has no model 'keep': it has latent"),
        ("slac", {"start": 13}, "start=13 is impossible: the episode has 13 timesteps, so give 12 or less"),
    ],
)
def test_what_cannot_be_predicted_is_an_error_in_one_sentence(tmp_path, name, changes, sentence):
    run = saved(tmp_path / "run", name, TASK)
    with pytest.raises(UserError, match=sentence):
        few(run, **changes)


@pytest.mark.slow
def test_the_figure_has_a_row_for_each_entry_that_is_asked_for(tmp_path):
    predicted = few(saved(tmp_path / "run", "slac", tasks.make("pendulum", (2, 0), max_steps=12)))
    assert predicted.entries == (2, 0)
    heights = {}
    for entries in ((2, 0), (0,), None):
        path = prediction.draw_predictions(predicted, tmp_path / "picture", entries)
        assert path == tmp_path / "picture.png"
        with Image.open(path) as image:
            heights[entries] = image.height
        assert (tmp_path / "picture.pdf").read_bytes().startswith(b"%PDF")
    assert heights[None] == heights[2, 0] > heights[0,]
    with pytest.raises(UserError, match="entries=1 is impossible: the agent sees 2, 0 of the observation"):
        prediction.draw_predictions(predicted, tmp_path / "picture", (1,))


def test_rows_have_the_names_of_what_they_show_and_time_is_in_steps(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or path)
    predicted = few(saved(tmp_path / "run", "slac", tasks.make("pendulum", (2, 0), max_steps=12)))
    assert predicted.names == ("θ̇ (rad/s)", "cos θ", "reward")
    prediction.draw_predictions(predicted, tmp_path / "picture")
    prediction.draw_predictions(
        predicted._replace(names=("entry 7", "a name of many words", "reward")), tmp_path / "picture", (0,)
    )
    whole, part = ([axis.get_ylabel() for axis in figure.axes] for figure in drawn)
    assert whole == ["θ̇ (rad/s)", "cos θ", "reward"]
    assert part == ["a name of many\nwords", "reward"]
    assert [axis.get_xlabel() for axis in drawn[0].axes] == ["", "", "step"]


# An episode of a trained agent: the recorded time steps, the agent's actions, the requested frames.

SHORT = tasks.make("pendulum-p", max_steps=6)


def player(task=SHORT, name="sac-lstm", rendered=False):
    return Player(tiny(name), task, begun(name, task.spec, jax.random.key(0)), rendered=rendered)


@pytest.mark.parametrize(("ends", "last"), [(1000, 7), (4, 4)])
def test_every_timestep_is_where_it_belongs(ends, last):
    agent, task = CountingAgent(), Counting(ends)
    steps, total, measures, frames = Player(agent, task, agent.init(jax.random.key(0), task.spec)).play()
    assert steps.obs.ravel().tolist() == list(range(last + 1))
    assert steps.reward.tolist() == list(range(last + 1))  # what came with the count
    assert steps.prev_action.ravel().tolist() == [0.0] + [0.5] * last
    assert steps.is_first.tolist() == [True] + [False] * last
    assert steps.terminated.tolist() == [False] * last + [ends == 4]
    assert total == sum(range(last + 1))
    assert measures == {"success": float(last >= 5)}
    assert frames == {}


@pytest.mark.parametrize("name", ["sac-lstm", "sac-mlp"])
def test_mode_actions_are_those_of_the_policy(name):
    playing = player(name=name)
    steps = playing.play(3).steps
    policy, memory = Policy(playing.agent, SHORT.spec, playing._state), None
    for t in range(6):
        action, memory = policy.predict(steps.obs[t], steps.reward[t], memory)
        np.testing.assert_allclose(steps.prev_action[t + 1], action, rtol=1e-5, atol=1e-6)


def test_a_seed_is_an_episode():
    with player() as playing:
        mode, again, other = (playing.play(seed) for seed in (3, 3, 4))
        sample, sample_again = (playing.play(3, sampled=True) for _ in range(2))
    for one, two in ((mode, again), (sample, sample_again)):
        jax.tree.map(np.testing.assert_array_equal, one, two)
    assert not np.allclose(mode.steps.obs, other.steps.obs)
    np.testing.assert_array_equal(mode.steps.obs[0], sample.steps.obs[0])
    assert not np.allclose(mode.steps.prev_action, sample.steps.prev_action)


def test_frames_are_of_the_timesteps_asked_for_and_the_last():
    with player(rendered=True) as playing:
        frames = playing.play(0, at={0, 2}).frames
        assert list(frames) == [0, 2, 6]
        np.testing.assert_array_equal(frames[6], paint(playing.environment._picture()))
        assert not np.array_equal(frames[0], frames[6])
        watched = []
        kept = playing.play(0, steps=3, at=range(0, 100, 2), watch=watched.append)
    assert [frame.time for frame in watched] == [0, 2, 3]
    np.testing.assert_array_equal(watched[1].pixels, frames[2])
    assert watched[2].total == pytest.approx(kept.total)
    assert kept.frames == {}


def test_a_gymnasium_environment_is_played_and_seen_in_the_same_way():
    with player(GymnasiumTask(Counter, arguments={"ends": 4}), "sac-mlp", rendered=True) as playing:
        steps, total, measures, frames = playing.play(at=range(100))
    assert steps.obs[:, 1].tolist() == [0, 1, 2, 3, 4]
    assert steps.terminated.tolist() == [False] * 4 + [True]
    assert total == 10
    assert measures == {}
    assert {time: frame[0, 0, 0] for time, frame in frames.items()} == {0: 0, 1: 10, 2: 20, 3: 30, 4: 40}


class Blind(Counter):
    def __init__(self, ends=9):
        super().__init__(None, ends)


class Broken(Counter):
    def render(self):
        raise RuntimeError("no screen")


class Grey(Counter):
    def render(self):
        return np.zeros((20, 30))


@pytest.mark.parametrize(
    ("task", "sentence"),
    [
        (GymnasiumTask(Blind), r"Blind cannot be rendered: give it a render_mode='rgb_array' \(.*TypeError"),
        (GymnasiumTask(Broken), "Broken cannot be rendered here: RuntimeError: no screen"),
        (GymnasiumTask(Grey), r"Grey renders float64 of shape \(20, 30\), but rgb_array must be uint8"),
        (Counting(), "Counting cannot be rendered: give it a method draw"),
    ],
)
def test_what_cannot_be_played_is_an_error_in_one_sentence(task, sentence):
    with pytest.raises(UserError, match=sentence), player(task, "sac-mlp", rendered=True) as playing:
        playing.play(at=(0,))


def test_a_runs_seed_is_played_by_its_number(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", SHORT, seeds=2)
    first, same, second = (beliefrl.play(run, seed) for seed in (None, 4, 5))
    np.testing.assert_array_equal(first.steps.prev_action, same.steps.prev_action)
    assert not np.allclose(first.steps.prev_action, second.steps.prev_action)
    with pytest.raises(UserError, match="has no seed 6: it has 4, 5"):
        beliefrl.play(run, 6)


def test_timesteps_of_frames_may_be_an_array(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", SHORT)
    assert list(beliefrl.play(run, at=np.array([0]), steps=2).frames) == [0, 2]
