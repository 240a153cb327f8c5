"""The progress of a sweep, read from logs that are being written."""

import json

from beliefrl.sweeps import progress as module
from beliefrl.sweeps.plan import Experiment, plan
from beliefrl.sweeps.progress import Forecast
from beliefrl.sweeps.run import SweepStatus
from written import a_run


def test_the_forecast_is_what_is_left_at_the_pace_seen(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    first, second, third = plan([Experiment("vrm", "pendulum", {"steps": 100}, seeds=(0, 1, 2))])
    status = SweepStatus([], [third], {first.name: first, second.name: second})
    forecast = Forecast(tmp_path)
    forecast.watch(status)
    assert forecast.seconds_left(status) is None
    now[0] = 30.0  # seconds until learning begins
    for index, training in enumerate((first, second)):
        a_run(tmp_path / training.name, [[]], first=index, updates=[(20, {"loss": 1.0})])
    forecast.watch(status)
    assert forecast.seconds_left(status) is None
    now[0] = 70.0  # 2 s per step
    for index, training in enumerate((first, second)):
        row = {"step": 40, "kind": "update", "loss": 1.0}
        (tmp_path / training.name / "metrics" / f"seed-{index}.jsonl").write_text(json.dumps(row) + "\n")
    forecast.watch(status)
    assert [each.step for each in forecast.going.values()] == [40, 40]
    assert forecast.seconds_left(status) == (2 * 60 + 2 * 60 + 30 + 2 * 100) / 2
    status = SweepStatus([first, second], [], {third.name: third})
    forecast.watch(status)
    assert list(forecast.going) == [third.name]
    assert forecast.seconds_left(status) == 30 + 200


def test_what_a_training_does_is_read_off_its_last_lines(tmp_path):
    (training,) = plan([Experiment("vrm", "pendulum", {"steps": 100}, seeds=(0,))])
    forecast, status = Forecast(tmp_path), SweepStatus([], [], {training.name: training})
    forecast.watch(status)
    (progress,) = forecast.going.values()
    assert (progress.step, progress.doing) == (0, "starting")
    run = a_run(tmp_path / training.name, [[]])
    log = run.folder / "metrics" / "seed-0.jsonl"
    for row, doing in [
        ({"step": 50, "kind": "pretrain"}, "pre-training, 50 updates"),
        ({"step": 20, "kind": "update"}, "learning"),
    ]:
        log.write_text(json.dumps(row) + "\n" + '{"step": 99, "kind": "up')
        forecast.watch(status)
        assert progress.doing == doing
    assert progress.step == 20
    log.write_text(json.dumps({"step": 30, "kind": "evaluation", "sampled": [1.0, 2.0], "mode": [0.0]}) + "\n")
    forecast.watch(status)
    assert (progress.step, progress.last_return) == (30, 1.5)
