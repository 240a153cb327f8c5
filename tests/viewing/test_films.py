"""Videos, film strips and demos: every frame at its time, and no half-written file."""

import dataclasses
import fnmatch
import os
import pathlib
import re
import subprocess
import sys
import tomllib
import types

import numpy as np
import pytest
from PIL import Image, ImageSequence

import beliefrl
from beliefrl import play, tasks
from beliefrl.cli import main
from beliefrl.commands import pictures
from beliefrl.commands.pictures import FilmOptions, PredictOptions, VideoOptions
from beliefrl.errors import UserError
from beliefrl.tasks.gymnasium import GymnasiumTask
from beliefrl.training.restore import restore_seed
from beliefrl.viewing import demo, encoders, films, prediction
from inputs import same
from worlds import Counter, CountingAgent, saved

TASK = tasks.make("pendulum-p", max_steps=5)


@pytest.fixture
def run(tmp_path):
    return saved(tmp_path / "run", "sac-mlp", TASK)


@pytest.fixture
def counted(tmp_path):
    """A run on an environment that shows the time step in its picture, and that environment."""
    task = GymnasiumTask(Counter)
    return saved(tmp_path / "run", "sac-mlp", task), task


def shown(path):
    """For each frame of a GIF: the time step that `Counter` shows, and its duration in milliseconds."""
    frames = [(np.array(frame.convert("RGB"))[0, 0, 0], frame.info["duration"]) for frame in frames_of(path)]
    return [(round(int(level) / 10), duration) for level, duration in frames]


def frames_of(path):
    with Image.open(path) as image:
        yield from ImageSequence.Iterator(image)


def test_a_film_shows_every_step_of_every_episode(tmp_path, counted):
    run, task = counted
    played = films.video(run, tmp_path / "film.gif", fps=20.0, episodes=2, steps=4, task=task)
    assert shown(tmp_path / "film.gif") == [(time, 50) for time in (0, 1, 2, 3, 4, 0, 1, 2, 3, 4)]
    assert [episode.total for episode in played] == [10.0, 10.0]


def test_the_episodes_of_a_film_are_those_that_play_plays(tmp_path):
    run = saved(tmp_path / "run", "sac-mlp", TASK, seeds=2)
    played = films.video(run, tmp_path / "film.gif", seed=5, episode_seed=7, sampled=True, episodes=2, steps=4)
    assert len(played) == 2
    for episode, episode_seed in zip(played, (7, 8), strict=True):
        assert same(episode.steps, play(run, seed=5, episode_seed=episode_seed, sampled=True, steps=4).steps)


def test_real_time_leaves_steps_out_where_they_are_too_many_a_second(tmp_path, counted):
    """Every third of 125 steps per second is shown, 41.7 per second; a GIF counts in hundredths of a second."""
    run, task = counted
    films.video(run, tmp_path / "film.gif", task=task)
    assert shown(tmp_path / "film.gif") == [(time, 20) for time in (0, 3, 6, 9)]


@pytest.mark.extra
def test_an_mp4_is_as_long_as_the_episode(tmp_path, run):
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    beliefrl.video(run, tmp_path / "film.mp4")  # a step takes a twentieth of a second
    read = [ffmpeg, "-loglevel", "error", "-i", tmp_path / "film.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    pixels = subprocess.run(read, capture_output=True, check=True).stdout
    assert len(pixels) == 6 * 480 * 512 * 3  # a square, and the line of text below it
    info = subprocess.run([ffmpeg, "-i", tmp_path / "film.mp4"], capture_output=True, text=True).stderr
    assert "20 fps" in info
    assert "yuv420p" in info


class Failing(Counter):
    def step(self, action):
        if self.steps == 3:
            raise RuntimeError("the battery is empty")
        return super().step(action)


class Growing(Counter):
    def render(self):
        return np.zeros((20, 30 + self.steps, 3), np.uint8)


@pytest.mark.parametrize(("make", "sentence"), [(Failing, "the battery is empty"), (Growing, "of different sizes")])
@pytest.mark.parametrize("ending", ["gif", pytest.param("mp4", marks=pytest.mark.extra)])
def test_a_film_that_fails_leaves_the_old_one(tmp_path, counted, make, sentence, ending):
    if ending == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / f"film.{ending}"
    path.write_bytes(b"old")
    with pytest.raises(UserError, match=sentence):
        films.video(counted[0], path, task=GymnasiumTask(make))
    assert path.read_bytes() == b"old"
    assert {each.name for each in tmp_path.iterdir()} == {"run", path.name}


def test_a_line_below_the_picture_leaves_it_as_it_is_and_its_sides_even():
    pixels = np.random.default_rng(0).integers(0, 256, (21, 33, 3), np.uint8)
    image = films.caption(pixels, "step 3   return -1.5")
    np.testing.assert_array_equal(image[:21, :33], pixels)
    assert image.shape[0] % 2 == image.shape[1] % 2 == 0
    assert image[22:].min() < 100 < 200 < image[22:].max()  # ink on paper


@pytest.mark.parametrize(
    ("line", "why"),
    [("echo 'Unknown encoder libx264' >&2", "Unknown encoder libx264"), ("", "ffmpeg ended with code 1")],
)
def test_an_mp4_that_cannot_be_encoded_says_what_ffmpeg_said(tmp_path, monkeypatch, line, why):
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\nexec 0<&-\n{line}\nexit 1\n")
    program.chmod(0o700)
    package = types.SimpleNamespace(get_ffmpeg_exe=lambda: str(program))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", package)

    def write():
        with encoders.encoder(tmp_path / "film.mp4", ".mp4", 10.0) as add:
            for _ in range(1000):
                add(np.zeros((100, 100, 3), np.uint8))

    with pytest.raises(UserError, match=rf"cannot be written \({why}\): choose another file"):
        write()
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_an_mp4_without_its_encoder_is_an_error_in_one_sentence(tmp_path, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(UserError, match=r"pip install 'beliefrl\[video\]', or make a \.gif"):
        films.video(run, tmp_path / "film.mp4")


def test_a_strip_is_evenly_spaced_from_the_first_timestep_to_the_last(run):
    for frames, start, steps, expected in ((3, 0, None, [0, 2, 5]), (8, 0, 3, [0, 1, 2, 3]), (3, 3, None, [3, 4, 5])):
        assert list(films._strip(run, restore_seed(run), frames, start, (0, False, steps)).frames) == expected
    ends = f"the episode of {run.folder} ends at step 5"
    for start, steps, sentence in (
        (5, None, ends),
        (-1, None, "it must be a whole number"),
        (3, 3, "less than steps=3"),
    ):
        with pytest.raises(UserError, match=f"^start={start} is impossible: .*{re.escape(sentence)}"):
            films.film([run], start=start, steps=steps)


def test_a_strip_says_that_the_numbers_below_its_frames_are_steps(run, monkeypatch):
    drawn = []
    monkeypatch.setattr(films.figures, "save", lambda figure, path: drawn.append(figure) or path)
    films.film([run], frames=3)
    assert [text.get_text() for text in drawn[0].texts][1:] == ["step 0", "step 2", "step 5"]


def test_a_strip_shows_the_episode_that_play_plays(tmp_path, monkeypatch):
    run = saved(tmp_path / "run", "sac-mlp", TASK, seeds=2)
    rows = []
    monkeypatch.setattr(films, "_draw_strips", lambda _, made: rows.extend(made))
    monkeypatch.setattr(films.figures, "save", lambda _, path: path)
    films.film([run], seed=5, episode_seed=7, sampled=True, steps=4)
    assert same(rows[0].steps, play(run, seed=5, episode_seed=7, sampled=True, steps=4).steps)


def test_a_strip_has_a_row_for_each_run(tmp_path, run):
    other = saved(tmp_path / "other", "sac-mlp", TASK)
    heights = []
    for runs in ([run], [run, other]):
        with Image.open(films.film(runs, frames=2)) as image:
            heights.append(image.height)
            assert image.width == 2 * 225
    assert heights[1] == pytest.approx(2 * heights[0], abs=1)
    assert (run.folder / "film.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.usefixtures("unchecked")
def test_frames_are_a_whole_number(run):
    with pytest.raises(UserError, match=r"^frames=2\.5 is impossible: it must be a whole number from 2 to 100"):
        films.film([run], frames=2.5)


@pytest.mark.slow
def test_the_commands_write_their_files(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = saved(tmp_path / "run", "slac", TASK)
    for line in (
        "video run film.gif --steps 2 --episodes 2 --episode-seed 7",
        "film run --frames 2 --out strip.png",
        "predict run --start 2 --samples 2 --horizon 2",
    ):
        main(line.split())
    out, err = capsys.readouterr()
    assert err == ""
    for seed in (7, 8):
        assert f"episode {seed}: 2 steps, {play(run, episode_seed=seed, steps=2).summary}\n" in out
    for line in ("film.gif", "strip.png and strip.pdf", "run/predictions.png and run/predictions.pdf"):
        assert f"written to {line}\n" in out
    names = ("film.gif", "strip.png", "strip.pdf", "run/predictions.png", "run/predictions.pdf")
    assert all((tmp_path / name).stat().st_size > 1000 for name in names)


PLAYED = "--seed 5 --episode-seed 7 --sampled --best --agent worlds:CountingAgent"
AS_PLAYED = {"seed": 5, "episode_seed": 7, "sampled": True, "best": True, "agent": CountingAgent}


@pytest.mark.parametrize(
    ("line", "options", "rest"),
    [
        ("video run f.gif --episodes 2 --fps 3 --steps 4", VideoOptions, {"episodes": 2, "fps": 3.0, "steps": 4}),
        ("film run other --frames 3 --start 1 --steps 4", FilmOptions, {"frames": 3, "start": 1, "steps": 4}),
        (
            "predict run --model keep --start 3 --horizon 4 --samples 2 --entries 0 1",
            PredictOptions,
            {"model": "keep", "start": 3, "horizon": 4, "samples": 2, "entries": (0, 1)},
        ),
    ],
    ids=["video", "film", "predict"],
)
def test_a_command_hands_on_all_of_its_options(run, monkeypatch, line, options, rest):
    given = {}
    monkeypatch.chdir(run.folder.parent)
    monkeypatch.setattr(films, "video", lambda *_, **named: given.update(named) or [])
    monkeypatch.setattr(films, "film", lambda *_, **named: given.update(named) or pathlib.Path("film.png"))
    monkeypatch.setattr(prediction, "predictions", lambda _, **named: given.update(named))
    monkeypatch.setattr(prediction, "draw_predictions", lambda _, path, entries: given.update(entries=entries) or path)
    main([*line.split(), *PLAYED.split()])
    assert given == AS_PLAYED | rest
    assert {field.name for field in dataclasses.fields(options)} - {"run", "runs", "out"} == given.keys()


def test_a_gif_of_a_photograph_has_the_colours_of_the_photograph():
    """A drawing may lose a little of its colours, for speed; a picture of many colours must not become worse."""
    x, y = np.meshgrid(np.arange(96), np.arange(64))
    photograph = np.stack([2.6 * x, 4 * y, x + y], -1).astype(np.uint8)
    drawing = np.where((x < 48)[..., None], np.uint8([251, 250, 247]), np.uint8([200, 85, 61]))
    for pixels, most in ((photograph, 4), (drawing, 2)):
        found = np.array(encoders._reduced(Image.fromarray(pixels)).convert("RGB"))
        assert np.abs(found.astype(int) - pixels).mean() < most


@pytest.fixture
def window(monkeypatch):
    """pygame, drawing into nowhere."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    return pytest.importorskip("pygame")


def test_a_window_shows_every_frame_and_is_closed_at_the_end(run, window, monkeypatch):
    shown = []
    monkeypatch.setattr(
        window.display, "flip", lambda: shown.append(window.surfarray.array3d(window.display.get_surface()))
    )
    films.video(run, None, fps=1000.0)
    assert [picture.shape for picture in shown] == 6 * [(480, 512, 3)]
    assert window.display.get_surface() is None


def test_closing_the_window_ends_the_film(run, window, monkeypatch):
    monkeypatch.setattr(window.display, "flip", lambda: window.event.post(window.event.Event(window.QUIT)))
    with pytest.raises(KeyboardInterrupt, match="the window was closed"):
        films.video(run, None, fps=1000.0)
    assert not window.display.get_init()


def test_no_window_is_drawn_where_nobody_sees_it(run, window, monkeypatch):
    for name in ("SDL_VIDEODRIVER", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":987")
    monkeypatch.setattr(window.display, "get_driver", lambda: "offscreen")
    with pytest.raises(UserError, match=r"A window cannot be opened .*: write a video instead"):
        films.video(run, None)


# Demos


def test_the_package_contains_the_demos_and_the_help_names_them(capsys):
    assert demo.names() == ["cartpole-v", "pendulum-v", "target-reaching"]
    text = (pathlib.Path(__file__).parents[2] / "pyproject.toml").read_text()
    (pattern,) = tomllib.loads(text)["tool"]["setuptools"]["package-data"]["beliefrl.viewing"]
    with pytest.raises(SystemExit):
        main(["demo", "--help"])
    shown = capsys.readouterr().out
    for file in demo.FOLDER.iterdir():
        assert fnmatch.fnmatch(f"{demo.FOLDER.name}/{file.name}", pattern)
        assert file.stat().st_size < 300_000
        assert file.stem in shown
        assert file.stem in demo.demo.__doc__


@pytest.mark.parametrize(("task", "tolerance"), [("cartpole-v", 100), ("pendulum-v", 100), ("target-reaching", 50)])
@pytest.mark.slow
def test_a_demo_is_a_run_that_acts_as_well_as_it_says(tmp_path, task, tolerance):
    run = beliefrl.demo(task, tmp_path / "run")
    assert run.config["task"] == task
    assert run.damage() == []
    returns = beliefrl.evaluate(run, 10, progress=False)["mode"]["mean"]
    assert returns == pytest.approx(run.results()["mode"]["mean"], abs=tolerance)
    with pytest.raises(UserError, match="run exists already"):
        beliefrl.demo(task, run.folder)


def test_a_demo_that_cannot_be_unpacked_leaves_no_folder(tmp_path, monkeypatch):
    def full(self, folder):
        (folder / "config.json").write_text("{}")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(demo.zipfile.ZipFile, "extractall", full)
    with pytest.raises(UserError, match=r"run cannot be made \(No space left on device\): choose another folder"):
        beliefrl.demo("pendulum-v", tmp_path / "run")
    assert not list(tmp_path.iterdir())


@pytest.fixture
def no_display(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.chdir(tmp_path)


def test_without_a_display_a_demo_writes_a_film_and_says_how_the_agent_was_trained(
    tmp_path, no_display, monkeypatch, capsys
):
    monkeypatch.setattr(pictures, "SPARING", 1.0)  # frame per second
    main(["demo", "--unpack", "run"])
    first, trained, *_, episode, copied, written = capsys.readouterr().out.splitlines()
    assert first.startswith("predictive-sac on pendulum-v: 10,000 steps, seed ")
    assert first.endswith(", the best of 0, 1, 2")
    assert trained.startswith("trained on cpu, 20")
    assert episode.startswith("episode 4: 200 steps, return -")
    assert (copied, written) == ("copied to run", "written to beliefrl-demo-pendulum-v.gif")
    assert len(list(frames_of(tmp_path / "beliefrl-demo-pendulum-v.gif"))) == 11
    assert beliefrl.Run("run").config["task"] == "pendulum-v"


def test_with_a_display_a_demo_opens_a_window_and_writes_nothing(tmp_path, no_display, monkeypatch, capsys):
    paths = []
    monkeypatch.setattr(films, "video", lambda run, path, **_: paths.append(path) or [])
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    main(["demo"])
    main(["demo", "--out", "film.gif"])
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)  # pygame is not installed
    main(["demo"])
    assert paths == [None, pathlib.Path("film.gif"), pathlib.Path("beliefrl-demo-pendulum-v.gif")]
    assert list(tmp_path.iterdir()) == []
    capsys.readouterr()


def test_an_environment_that_changes_the_working_directory_does_not_move_the_film(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "here").mkdir()

    class Moving(Counter):
        def __init__(self, render_mode=None):
            super().__init__(render_mode)
            os.chdir(tmp_path / "elsewhere")

    monkeypatch.chdir(tmp_path / "here")
    task = GymnasiumTask(Moving)
    run = saved(tmp_path / "run", "sac-mlp", task)
    os.chdir(tmp_path / "here")
    films.video(run, "film.gif", fps=20.0, steps=2, task=task)
    assert (tmp_path / "here" / "film.gif").exists()
    os.chdir(tmp_path / "here")
    assert films.film(run, "film.png", frames=2, steps=2, task=task) == pathlib.Path("film.png")
    assert (tmp_path / "here" / "film.png").exists()
    os.chdir(tmp_path)
    run = beliefrl.Run("run")
    assert films.film(run, frames=2, steps=2, task=task) == tmp_path / "run" / "film.png"
    assert not any((tmp_path / "elsewhere").iterdir())
