"""Trainings of a sweep on this machine: a process each, on a core or a GPU of its own."""

import os
import pathlib
import platform
import signal
import subprocess
import sys
from typing import IO

from beliefrl.sweeps.plan import Training

Slot = str  # a core's number, or a GPU's as gpu0, or - for anywhere


class Local:
    """Starts trainings on free cores or GPUs, and tells which have ended."""

    def __init__(self, sweep: pathlib.Path, slots: list[Slot]):
        """`slots` is where trainings can run, one at a time each; `-` is with all the cores."""
        self.sweep, self.free = sweep, list(slots)
        self._running: dict[str, tuple[subprocess.Popen[bytes], Slot, IO[bytes]]] = {}

    @property
    def room(self) -> int:
        """How many trainings can be started now."""
        return len(self.free)

    def start(self, training: Training) -> None:
        """Start a training that is not running."""
        slot = self.free.pop(0)
        log = (self.sweep / "logs" / f"{training.name}.log").open("ab")
        core = slot if slot.isdigit() else "-"
        command = [sys.executable, "-m", "beliefrl.worker", core, *training.command(self.sweep)]
        process = subprocess.Popen(
            command,
            env=environment(self.sweep, slot),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C goes to the sweep, which passes it on
        )
        self._running[training.name] = (process, slot, log)

    def ended(self) -> dict[str, int]:
        """The exit codes of the trainings that have ended since the last call."""
        codes = {name: code for name, (process, *_) in self._running.items() if (code := process.poll()) is not None}
        for name in codes:
            _, slot, log = self._running.pop(name)
            log.close()
            self.free.append(slot)
        return codes

    def stop(self) -> None:
        """Ask every training for a checkpoint, and wait until they have ended."""
        for process, *_ in self._running.values():
            process.send_signal(signal.SIGTERM)
        for process, *_ in self._running.values():
            process.wait()
        self.ended()


def environment(sweep: pathlib.Path, slot: Slot) -> dict[str, str]:
    """The environment variables of a training."""
    cache = sweep / "compiled" / platform.node()  # another machine may not be able to run what this one compiles
    variables = {
        "JAX_COMPILATION_CACHE_DIR": str(cache.absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        **os.environ,
    }
    if slot.startswith("gpu"):
        variables["CUDA_VISIBLE_DEVICES"] = slot.removeprefix("gpu")
    elif slot != "-":
        variables["NPROC"] = "1"  # threads of XLA, where no core can be chosen
    return variables


def slots(workers: int | None = None) -> list[Slot]:
    """Where trainings can run on this machine: its GPUs if it has any, or else its cores; `workers` of them at most."""
    gpus = _gpus()
    if gpus:
        return [f"gpu{index}" for index in range(min(workers or gpus, gpus))]
    if hasattr(os, "sched_getaffinity"):
        cores = [str(core) for core in sorted(os.sched_getaffinity(0))]
    else:
        cores = ["any"] * (os.cpu_count() or 1)
    return cores[:workers] if workers is None or workers <= len(cores) else cores + ["any"] * (workers - len(cores))


def _gpus() -> int:
    """How many GPUs JAX finds. Another process looks, since looking takes most of a GPU's memory."""
    look = "import jax; print(sum(device.platform == 'gpu' for device in jax.devices()))"
    found = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True)
    return int(found.stdout.strip().splitlines()[-1]) if found.returncode == 0 and found.stdout.strip() else 0
