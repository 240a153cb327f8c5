"""Learning curves of a run whose files are written by hand."""

import json

import numpy as np
import pytest

from beliefrl.analysis.curves import draw_curve, evaluations, standard_error
from beliefrl.runs.run import Run
from beliefrl.types import UserError


def a_run(folder, seeds, success=False):
    """A run's folder with these evaluations of each seed: (step, returns with sampled actions)."""
    (folder / "metrics").mkdir()
    options = {"seed": 0, "seeds": len(seeds)}
    config = {"agent": "vrm", "hyperparameters": {}, "task": "pendulum-v", "constants": {}, "options": options}
    (folder / "config.json").write_text(json.dumps(config))
    for seed, rows in enumerate(seeds):
        lines = [{"step": 1, "kind": "update", "loss": 0.0}]
        for step, returns in rows:
            successes = {"sampled_success": [True, False], "mode_success": [True, True]} if success else {}
            lines.append({"step": step, "kind": "evaluation", "sampled": returns, "mode": [0.0], **successes})
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (folder / "metrics" / f"seed-{seed}.jsonl").write_text(text)
    return Run(folder)


TWO_SEEDS = [[(10, [1.0, 2.0]), (20, [3.0, 5.0])], [(10, [-1.0, 4.0]), (20, [7.0, 7.0])]]


def test_evaluations_are_every_seeds_means(tmp_path):
    steps, seeds = evaluations(a_run(tmp_path, TWO_SEEDS), "sampled")
    np.testing.assert_array_equal(steps, [10, 20])
    np.testing.assert_array_equal(seeds, [[1.5, 4.0], [1.5, 7.0]])


def test_evaluations_go_as_far_as_all_seeds_have_come(tmp_path):
    steps, seeds = evaluations(a_run(tmp_path, [TWO_SEEDS[0], TWO_SEEDS[1][:1]]), "sampled")
    np.testing.assert_array_equal(steps, [10])
    np.testing.assert_array_equal(seeds, [[1.5], [1.5]])


def test_success_is_read_as_a_rate(tmp_path):
    _, seeds = evaluations(a_run(tmp_path, TWO_SEEDS, success=True), "sampled_success")
    np.testing.assert_array_equal(seeds, np.full((2, 2), 0.5))


def test_standard_error_is_over_seeds():
    seeds = np.array([[1.0, 4.0], [2.0, 0.0], [6.0, 5.0]])
    np.testing.assert_allclose(standard_error(seeds), np.std(seeds, axis=0, ddof=1) / np.sqrt(3))
    np.testing.assert_array_equal(standard_error(seeds[:1]), [0.0, 0.0])


def size(picture):
    """Width and height of a PNG, in pixels."""
    content = picture.read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(content[16:20]), int.from_bytes(content[20:24])


def test_the_curve_is_a_picture_in_the_runs_folder(tmp_path):
    picture = draw_curve(a_run(tmp_path, TWO_SEEDS))
    assert picture == tmp_path / "curve.png"
    assert min(size(picture)) > 100


def test_one_seed_has_a_curve_too(tmp_path):
    assert min(size(draw_curve(a_run(tmp_path, TWO_SEEDS[:1]), tmp_path / "other.png"))) > 100


def test_success_has_a_panel_of_its_own(tmp_path):
    (tmp_path / "with").mkdir()
    (tmp_path / "without").mkdir()
    width, height = size(draw_curve(a_run(tmp_path / "without", TWO_SEEDS)))
    assert size(draw_curve(a_run(tmp_path / "with", TWO_SEEDS, success=True))) == (2 * width, height)


@pytest.mark.parametrize("seeds", [[[]], [TWO_SEEDS[0], []]], ids=["no seed", "one of two seeds"])
def test_there_is_no_curve_without_evaluations(tmp_path, seeds):
    with pytest.raises(UserError, match="no evaluation"):
        draw_curve(a_run(tmp_path, seeds))
    assert not (tmp_path / "curve.png").exists()
