"""Where the trainings of a sweep run: on this machine, each with its own core or GPU, or on a Ray cluster.

All machines of a cluster must see the sweep's folder under the same path. If a machine is lost, Ray restarts its
trainings on other machines, where they continue from their last checkpoints.
"""

import contextlib
import os
import pathlib
import platform
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import IO, Any, NamedTuple

from beliefrl.errors import UserError
from beliefrl.sweeps.plan import Training
from beliefrl.sweeps.sources import PLAN

RETRIES = 3  # restarts of a training whose machine is lost
BEGIN = "==== a training begins ====\n"  # separates sessions in a log
GPU = "CUDA_VISIBLE_DEVICES"
ONE_THREAD = {"NPROC": "1"}  # of XLA, even if the process cannot be bound to a core


class Slot(NamedTuple):
    """A place for one training at a time. By default it is the whole machine."""

    core: str = "-"  # to which its process is bound; "-" is none
    variables: Mapping[str, str] = MappingProxyType({})  # of its process's environment


class Local:
    """Starts trainings on free cores or GPUs, and collects their exit codes."""

    def __init__(self, sweep: pathlib.Path, slots: list[Slot]):
        """`slots` are the places where trainings run, one training at a time in each."""
        self.sweep, self.free = sweep, list(slots)
        self.has_gpus = any(GPU in slot.variables for slot in slots)
        self._running: dict[str, tuple[subprocess.Popen[bytes], Slot]] = {}

    @property
    def room(self) -> int:
        """How many trainings can be started now."""
        return len(self.free)

    def start(self, training: Training) -> None:
        """Start a training in a free slot."""
        slot = self.free.pop(0)
        command = worker(slot.core, training.command(self.sweep))
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


def worker(core: str, command: list[str]) -> list[str]:
    """The command of a process that runs a training for this process."""
    return [sys.executable, "-m", "beliefrl.worker", str(os.getpid()), core, *command]


def open_log(path: pathlib.Path) -> IO[bytes]:
    """The log of a training that is about to begin. What earlier sessions have written stays in it."""
    log = path.open("ab", buffering=0)
    log.write(BEGIN.encode())
    return log


def environment(sweep: pathlib.Path, slot: Slot) -> dict[str, str]:
    """The environment variables of a training's process."""
    cache = sweep / "compiled" / platform.node()  # programs compiled here may not run on another machine
    return {
        "JAX_COMPILATION_CACHE_DIR": str(cache.absolute()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        **os.environ,
        **slot.variables,
    }


def slots(workers: int | None = None) -> list[Slot]:
    """The slots of this machine: its GPUs if it has any, otherwise its cores.

    With `workers` there are that many slots, except that each GPU has at most one. Trainings are bound to cores only if
    there is one for each core: another sweep may use the others, and would be bound to the same ones.
    """
    gpus = _gpus()
    if gpus:
        visible = os.environ.get(GPU)  # on a shared machine the other GPUs are not ours
        names = visible.split(",") if visible else [str(index) for index in range(gpus)]
        return [Slot(variables={GPU: name.strip()}) for name in names[:gpus]][:workers]
    any_core = Slot(variables=ONE_THREAD)
    if hasattr(os, "sched_getaffinity"):
        cores = [Slot(str(core), ONE_THREAD) for core in sorted(os.sched_getaffinity(0))]
    else:
        cores = [any_core] * (os.cpu_count() or 1)
    return cores if workers in (None, len(cores)) else [any_core] * (workers or 0)


def _gpus() -> int:
    """The number of GPUs that JAX finds. A separate process counts, since JAX reserves most of a GPU's memory."""
    count = "import jax; print(sum(device.platform == 'gpu' for device in jax.devices()))"
    found = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True)
    return int(found.stdout.strip().splitlines()[-1]) if found.returncode == 0 and found.stdout.strip() else 0


class Cluster:
    """Starts trainings on a Ray cluster, and collects their exit codes."""

    def __init__(self, sweep: pathlib.Path, address: str, workers: int | None = None):
        """Connect to the head at `address`, HOST:PORT, or "auto" for a head on this machine.

        Raises:
            UserError: Ray is not installed, or there is no such cluster.
        """
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise UserError("--ray needs Ray: pip install 'beliefrl[sweep]'.") from None
        self._ray, self.sweep, self._workers = ray, sweep.absolute(), workers
        try:
            _check_reachable(address)
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            reason = str(error).splitlines()[0].rstrip(".")
            raise UserError(
                f"There is no Ray cluster at {address} ({reason}): `ray start --head` starts one."
            ) from None
        self.has_gpus = ray.cluster_resources().get("GPU", 0) >= 1
        kind: dict[str, Any] = {"num_cpus": 1, "num_gpus": 1} if self.has_gpus else {"num_cpus": 1}
        self._train = ray.remote(**kind, max_retries=RETRIES)(train_on_node)
        self._running: dict[str, Any] = {}

    @property
    def room(self) -> int:
        """How many trainings can be started now. It grows and shrinks with the cluster."""
        total = self._ray.cluster_resources().get("GPU" if self.has_gpus else "CPU", 0)
        most = 1 if self._workers == 0 else self._workers or total
        return max(0, int(min(total, most)) - len(self._running))

    def start(self, training: Training) -> None:
        log = self.sweep / "logs" / f"{training.name}.log"
        command = training.command(self.sweep)
        self._running[training.name] = self._train.remote(str(self.sweep), str(log), command, self.has_gpus)

    def ended(self) -> dict[str, int]:
        """The exit codes of the trainings that have ended since the last call."""
        names = {reference: name for name, reference in self._running.items()}
        done, _ = self._ray.wait(list(names), num_returns=len(names), timeout=0) if names else ([], [])
        codes = {}
        for reference in done:
            name = names[reference]
            del self._running[name]
            try:
                codes[name] = self._ray.get(reference)
            except self._ray.exceptions.RayError as error:
                codes[name] = 1
                with (self.sweep / "logs" / f"{name}.log").open("a") as log:
                    log.write(f"\nbeliefrl: {' '.join(str(error).split())}\n")
        return codes

    def stop(self) -> None:
        """Ask every training to write a checkpoint and stop, wait for them, and disconnect from the cluster."""
        for reference in self._running.values():
            self._ray.cancel(reference, force=False)
        for reference in self._running.values():
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.get(reference)
        self._running = {}
        self._ray.shutdown()


def _check_reachable(address: str) -> None:
    """Raise an OSError if nothing listens at `address`. Ray itself would keep trying for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=10).close()


def train_on_node(sweep: str, log: str, command: list[str], on_gpu: bool) -> int:
    """Run one training as a separate process on a machine of the cluster; returns its exit code."""
    if not (pathlib.Path(sweep) / PLAN).exists():
        raise FileNotFoundError(f"{socket.gethostname()} does not see {sweep}: the folder must be on all machines.")
    slot = Slot(variables={GPU: os.environ.get(GPU, "0")} if on_gpu else ONE_THREAD)
    with open_log(pathlib.Path(log)) as out:
        process = subprocess.Popen(
            worker(slot.core, command),
            env=environment(pathlib.Path(sweep), slot),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
        )
        try:
            while process.poll() is None:
                time.sleep(0.2)  # Ray could not interrupt wait() to cancel the training
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            raise
        return process.returncode
