"""Trainings of a sweep on a Ray cluster, each on a free core or GPU.

All machines must see the sweep's folder under the same path. If a machine is lost, Ray restarts its trainings on other
machines, where they continue from their last checkpoints.
"""

import contextlib
import os
import pathlib
import socket
import subprocess
import sys
import time
from typing import Any

from beliefrl.sweeps.local import environment, open_log
from beliefrl.sweeps.plan import Training
from beliefrl.sweeps.sources import PLAN
from beliefrl.types import UserError

RETRIES = 3  # restarts of a training whose machine is lost


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
        """How many trainings can be started now. It may grow with the cluster."""
        total = self._ray.cluster_resources().get("GPU" if self.has_gpus else "CPU", 0)
        return int(min(total, self._workers or total)) - len(self._running)

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
    slot = f"gpu{os.environ.get('CUDA_VISIBLE_DEVICES', '0')}" if on_gpu else "any"
    with open_log(pathlib.Path(log)) as out:
        process = subprocess.Popen(
            [sys.executable, "-m", "beliefrl.worker", "-", *command],
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
