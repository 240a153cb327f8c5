"""Trainings of a sweep on a Ray cluster: wherever it has a core or a GPU to give.

The sweep's folder must be one that all its machines see, by the same path. A training whose machine is lost is started
again by Ray elsewhere, and goes on from its last checkpoint.
"""

import contextlib
import os
import pathlib
import socket
import subprocess
import sys
import time
from typing import Any

from beliefrl.sweeps.files import PLAN
from beliefrl.sweeps.local import environment
from beliefrl.sweeps.plan import Training
from beliefrl.types import UserError

RETRIES = 3  # of a training whose machine is lost


class Cluster:
    """Starts trainings on a Ray cluster, and tells which have ended."""

    def __init__(self, sweep: pathlib.Path, address: str, workers: int | None = None):
        """Connect; `address` is HOST:PORT of the head, or auto for one that runs on this machine.

        Raises:
            UserError: Ray is not installed, or there is no such cluster.
        """
        try:
            import ray  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise UserError("--ray needs Ray: pip install 'beliefrl[sweep]'.") from None
        self._ray, self.sweep, self._workers = ray, sweep.absolute(), workers
        try:
            _knock(address)
            ray.init(address=address, log_to_driver=False, configure_logging=False)
        except (ConnectionError, RuntimeError, ValueError, OSError) as error:
            why = str(error).splitlines()[0].rstrip(".")
            raise UserError(f"There is no Ray cluster at {address} ({why}): `ray start --head` starts one.") from None
        self.has_gpus = ray.cluster_resources().get("GPU", 0) >= 1
        kind: dict[str, Any] = {"num_cpus": 1, "num_gpus": 1} if self.has_gpus else {"num_cpus": 1}
        self._train = ray.remote(**kind, max_retries=RETRIES)(train_there)
        self._running: dict[str, Any] = {}

    @property
    def room(self) -> int:
        """How many trainings can be started now: what the cluster has, which may grow."""
        has = self._ray.cluster_resources().get("GPU" if self.has_gpus else "CPU", 0)
        return int(min(has, self._workers or has)) - len(self._running)

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
        """Ask every training for a checkpoint, wait until they have ended, and leave the cluster."""
        for reference in self._running.values():
            self._ray.cancel(reference, force=False)
        for reference in self._running.values():
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.get(reference)
        self._running = {}
        self._ray.shutdown()


def _knock(address: str) -> None:
    """Raise an OSError where nobody answers: Ray itself would try for minutes."""
    host, _, port = address.rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=10).close()


def train_there(sweep: str, log: str, command: list[str], on_gpu: bool) -> int:
    """On a machine of the cluster: one training in a process of its own; returns its exit code."""
    if not (pathlib.Path(sweep) / PLAN).exists():
        raise FileNotFoundError(f"{socket.gethostname()} does not see {sweep}: the folder must be on all machines.")
    slot = f"gpu{os.environ.get('CUDA_VISIBLE_DEVICES', '0')}" if on_gpu else "any"
    with pathlib.Path(log).open("ab") as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "beliefrl.worker", "-", *command],
            env=environment(pathlib.Path(sweep), slot),
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=out,
        )
        try:
            while process.poll() is None:
                time.sleep(0.2)  # not wait(): Ray's cancelling could not interrupt it
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
            raise
        return process.returncode
