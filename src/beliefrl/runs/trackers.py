"""Trackers, which receive a run's numbers besides its own log: TensorBoard, Weights & Biases. `--track` selects them.

By default nothing is sent over the network. Runs of Weights & Biases are offline, in the run's folder. The user uploads
them with `wandb sync`, or sets WANDB_MODE=online.
"""

import importlib.util
import os
import pathlib
import shutil
import time
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from beliefrl.errors import UserError, said


@runtime_checkable
class Tracker(Protocol):
    """Receives the numbers of one seed."""

    is_whole: bool  # whether it receives all entries again when a training is resumed, or only the new ones

    def log(self, step: int, values: dict[str, float]) -> None: ...
    def flush(self) -> None: ...
    def close(self) -> None: ...


class TensorBoard:
    """Event files in tensorboard/seed-N.

    tensorboardX's SummaryWriter writes in a thread of its own. On a full disk that thread ends, and the caller
    waits for it forever. So the events are written here, and an error is raised where it occurs.
    """

    is_whole = True

    def __init__(self, folder: pathlib.Path, seed: int, config: dict[str, Any]):
        from tensorboardX.event_file_writer import EventsWriter  # 0.5 s to import
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - defined at import
        from tensorboardX.summary import scalar

        path = folder / "tensorboard" / f"seed-{seed}"
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True, exist_ok=True)  # a network file system may keep open files
        self._writer, self._event, self._scalar = EventsWriter(str(path / "events")), Event, scalar

    def log(self, step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            event = self._event(wall_time=time.time(), step=step, summary=self._scalar(name, value))
            self._writer.write_event(event)

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


class WandB:
    """A run of Weights & Biases for each seed, all in one group, in wandb/."""

    is_whole = False

    def __init__(self, folder: pathlib.Path, seed: int, config: dict[str, Any]):
        import wandb  # pyright: ignore[reportMissingImports]

        name = f"{folder.name}-seed-{seed}"
        self._run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "beliefrl"),
            group=folder.name,
            name=name,
            id=f"{config.get('started', '')}-{name}".replace(":", "-").replace("+", "-"),
            dir=str(folder),
            config={**config, "seed": seed},
            mode=_mode(),
            resume="allow",
            reinit="create_new",
            settings=wandb.Settings(console="off", silent=True),
        )
        self._run.define_metric("step")
        self._run.define_metric("*", step_metric="step")

    def log(self, step: int, values: dict[str, float]) -> None:
        self._run.log({"step": step, **values})

    def flush(self) -> None:
        """Nothing to do: wandb writes in a thread."""

    def close(self) -> None:
        self._run.finish()


def _mode() -> Any:
    return os.environ.get("WANDB_MODE", "offline")


TRACKERS: dict[str, type[TensorBoard] | type[WandB]] = {"tensorboard": TensorBoard, "wandb": WandB}


def check(names: Sequence[str]) -> None:
    """Raise a UserError if the package of a tracker is not installed."""
    if "wandb" in names and importlib.util.find_spec("wandb") is None:
        raise UserError("track=wandb needs Weights & Biases: pip install 'beliefrl[wandb]'.")


def open_all(names: Sequence[str], folder: pathlib.Path, seed: int, config: dict[str, Any]) -> list[Tracker]:
    """The trackers of a seed.

    Raises:
        UserError: one of them cannot be opened.
    """
    opened: list[Tracker] = []
    for name in names:
        try:
            opened.append(TRACKERS[name](folder, seed, config))
        except Exception as error:  # the library may raise anything
            for tracker in opened:
                tracker.close()
            raise UserError(f"track={name} cannot be opened: {said(error)}.") from None
    return opened
