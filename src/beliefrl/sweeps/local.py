"""Trainings of a sweep on this machine: each is a process with its own core or GPU."""

import os
import pathlib
import platform
import signal
import subprocess
import sys
from typing import IO

from beliefrl.sweeps.plan import Training

Slot = str  # a core's number, "gpu" and a GPU's name in CUDA_VISIBLE_DEVICES, "any" for any one core, or "-" for all

BEGIN = "==== a training begins ====\n"  # separates sessions in a log


class Local:
    """Starts trainings on free cores or GPUs, and collects their exit codes."""

    def __init__(self, sweep: pathlib.Path, slots: list[Slot]):
        """`slots` are the places where trainings run, one training at a time in each."""
        self.sweep, self.free = sweep, list(slots)
        self._running: dict[str, tuple[subprocess.Popen[bytes], Slot]] = {}

    @property
    def room(self) -> int:
        """How many trainings can be started now."""
        return len(self.free)

    def start(self, training: Training) -> None:
        """Start a training in a free slot."""
        slot = self.free.pop(0)
        core = slot if slot.isdigit() else "-"
        command = [sys.executable, "-m", "beliefrl.worker", core, *training.command(self.sweep)]
        with open_log(self.sweep / "logs" / f"{training.name}.log") as log:
            process = subprocess.Popen(
                command,
                env=environment(self.sweep, slot),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C goes only to the sweep, which stops its trainings
            )
        self._running[training.name] = (process, slot)

    def ended(self) -> dict[str, int]:
        """The exit codes of the trainings that have ended since the last call."""
        codes = {name: code for name, (process, _) in self._running.items() if (code := process.poll()) is not None}
        self.free += [self._running.pop(name)[1] for name in codes]
        return codes

    def interrupt(self, name: str) -> None:
        """Ask one training to write a checkpoint and stop."""
        self._running[name][0].send_signal(signal.SIGTERM)

    def stop(self) -> None:
        """Ask every training to write a checkpoint and stop, and wait for them. `ended` has their exit codes."""
        for process, _ in self._running.values():
            process.send_signal(signal.SIGTERM)
        for process, _ in self._running.values():
            process.wait()


def open_log(path: pathlib.Path) -> IO[bytes]:
    """The log of a training that is about to begin. What earlier sessions have written stays in it."""
    log = path.open("ab", buffering=0)
    log.write(BEGIN.encode())
    return log


def environment(sweep: pathlib.Path, slot: Slot) -> dict[str, str]:
    """The environment variables of a training's process."""
    cache = sweep / "compiled" / platform.node()  # programs compiled here may not run on another machine
    variables = {
        "JAX_COMPILATION_CACHE_DIR": str(cache.absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        **os.environ,
    }
    if slot.startswith("gpu"):
        variables["CUDA_VISIBLE_DEVICES"] = slot.removeprefix("gpu")
    elif slot != "-":
        variables["NPROC"] = "1"  # one XLA thread, even if the process cannot be bound to a core
    return variables


def slots(workers: int | None = None) -> list[Slot]:
    """The slots of this machine: its GPUs if it has any, otherwise its cores.

    With `workers` there are that many slots, except that each GPU has at most one.
    """
    gpus = _gpus()
    if gpus:
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")  # on a shared machine the other GPUs are not ours
        names = visible.split(",") if visible else [str(index) for index in range(gpus)]
        return [f"gpu{name.strip()}" for name in names[:gpus]][:workers]
    if hasattr(os, "sched_getaffinity"):
        cores = [str(core) for core in sorted(os.sched_getaffinity(0))]
    else:
        cores = ["any"] * (os.cpu_count() or 1)
    return cores[:workers] if workers is None or workers <= len(cores) else cores + ["any"] * (workers - len(cores))


def _gpus() -> int:
    """The number of GPUs that JAX finds. A separate process counts, since JAX reserves most of a GPU's memory."""
    count = "import jax; print(sum(device.platform == 'gpu' for device in jax.devices()))"
    found = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True)
    return int(found.stdout.strip().splitlines()[-1]) if found.returncode == 0 and found.stdout.strip() else 0
