"""Kill a training 50 times at random times, half of them while a checkpoint is being written, and resume it each time.

    python benchmarks/kill_and_resume.py            # about ten minutes

The signal is SIGKILL. At the end, the metrics and the networks must be byte-identical to those of an uninterrupted
training. If a training ends before the last kill, it is compared, and a new training starts.
"""

import os
import pathlib
import random
import shutil
import subprocess
import sys
import tempfile
import time

import tyro

SETTINGS = {
    "steps": 3000,
    "seeds": 2,
    "eval-every": 500,
    "eval-episodes": 1,
    "checkpoint-steps": 50,
    "step-start-rl": 200,
    "pretrain-updates": 200,
    "batch-size": 32,
}


def command(*words: str) -> list[str]:
    """A `beliefrl` command."""
    return [sys.executable, "-m", "beliefrl.cli", *words]


def training(folder: pathlib.Path) -> list[str]:
    """The command that starts the training."""
    options = [word for name, value in SETTINGS.items() for word in (f"--{name}", str(value))]
    return command("train", "sac-mlp", "pendulum-v", *options, "--out", str(folder))


def is_writing(folder: pathlib.Path) -> bool:
    """Whether a checkpoint is being written."""
    return any(folder.glob("checkpoints/.*.tmp")) or any(folder.glob("checkpoints/replay/.*.tmp"))


def killed(arguments: list[str], folder: pathlib.Path, in_writing: bool, seconds: float) -> bool | None:
    """Run and kill; returns whether a checkpoint was being written, or None if the training had already ended."""
    newest = max(folder.glob("checkpoints/0*"), default=None)
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        while process.poll() is None and max(folder.glob("checkpoints/0*"), default=None) == newest:
            time.sleep(0.001)
        until = time.monotonic() + seconds
        while process.poll() is None and time.monotonic() < until + 60 * in_writing:
            if in_writing and time.monotonic() > until and is_writing(folder):
                break
        if process.poll() is not None:
            _, err = process.communicate()
            if process.returncode:
                raise SystemExit(f"the training failed: {err.decode()}")
            return None
        process.kill()
        process.wait()
    return is_writing(folder)


def learned(folder: pathlib.Path) -> dict[str, bytes]:
    """The files that must be equal: logs, networks, results."""
    paths = [*sorted((folder / "metrics").iterdir()), folder / "agent.safetensors", folder / "results.json"]
    return {path.name: path.read_bytes() for path in paths}


def main(kills: int = 50, seed: int = 0) -> None:
    """Kill `kills` times, at random times that follow from `seed`."""
    times, folder = random.Random(seed), pathlib.Path(tempfile.mkdtemp())
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder / "compiled")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    reference, run = folder / "whole", folder / "run"
    subprocess.run(training(reference), check=True, stdout=subprocess.DEVNULL)
    expected, done, writing, finished = learned(reference), 0, 0, 0
    arguments = training(run)
    while done < kills or arguments is not None:
        if done == kills:
            subprocess.run(arguments, check=True, stdout=subprocess.DEVNULL)
            found = None
        else:
            found = killed(arguments, run, in_writing=done % 2 == 1, seconds=times.uniform(0, 0.6))
        if found is None:
            finished += 1
            if learned(run) != expected:
                raise SystemExit(f"training {finished} differs from the uninterrupted one: see {folder}")
            print(f"{done} kills: training {finished} is equal to the uninterrupted one", flush=True)
            shutil.rmtree(run)
            arguments = training(run) if done < kills else None
            continue
        done, writing = done + 1, writing + found
        arguments = command("resume", str(run))
    print(f"{done} kills, {writing} of them while a checkpoint was written; {finished} trainings, all byte-identical")
    shutil.rmtree(folder)


if __name__ == "__main__":
    tyro.cli(main)
