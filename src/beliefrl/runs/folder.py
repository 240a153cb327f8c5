"""The folder of a run: making it, locking it against other processes, and clearing it if nothing was saved."""

import contextlib
import errno
import json
import os
import pathlib
import platform
import re
import shlex
import shutil
from typing import Any

from beliefrl.errors import UserError, cause
from beliefrl.runs import records
from beliefrl.runs.arrays import write_whole
from beliefrl.types import plain

MAKING = r"metrics|lock|\.config\.json\.tmp"  # files that are made before config.json
UNSAVED = (  # files of a training that has saved no agent and no checkpoint
    rf"{MAKING}|config\.json|metrics/seed-\d+\.jsonl|\.[\w.-]+\.tmp|(tensorboard|wandb)(/.*)?"
    r"|initial(-replay)?\.safetensors|checkpoints(/replay(/.*)?|/\.[^/]*\.tmp(/.*)?)?"
)
HELD = (errno.EAGAIN, errno.EWOULDBLOCK, errno.EACCES)  # of a lock that another process has


def make(folder: pathlib.Path, config: dict[str, Any]) -> None:
    """Make the folder of a new run.

    An existing folder is used if it is empty, or if its training saved nothing; see `clear`.

    Raises:
        UserError: the folder contains other files, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        clear(folder)
        (folder / "metrics").mkdir()
        write_config(folder, config)
    except OSError as error:
        raise UserError(f"The run folder {folder} cannot be made ({cause(error)}): choose another --out.") from None


def clear(folder: pathlib.Path) -> None:
    """Remove the files of a training that ended before it saved anything; the folder itself stays.

    Raises:
        UserError: the folder contains an agent, a checkpoint or a file that no training writes; or it is in use.
    """
    inside = [path.relative_to(folder).as_posix() for path in folder.rglob("*")]
    is_run = _is_of_training(folder)
    if not all(re.fullmatch(UNSAVED if is_run else MAKING, name) for name in inside):
        command = f"beliefrl resume {shlex.quote(str(folder))}"
        go_on, in_python = (f", or `{command}`", " or resume=True") if is_run else ("", "")
        raise UserError(f"{folder} exists already: choose another --out{go_on}; in Python out={in_python}.")
    if not inside:
        return
    with locked(folder, "is being trained"):
        for path in folder.iterdir():
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.name != "lock":
                path.unlink()


def set_aside(folder: pathlib.Path) -> pathlib.Path | None:
    """Move the logs, agents and results of a training that begins again to before-1, before-2, ....

    Returns None, and moves nothing, if no agent was saved.
    """
    (folder / "metrics").mkdir(exist_ok=True)  # missing after a kill in this function
    if not (folder / "agent.safetensors").exists():
        return None
    number = 1
    while (aside := folder / f"before-{number}").exists():
        number += 1
    aside.mkdir()
    # After a kill the rest is moved by the next call, because the agent is the last one.
    for name in ("metrics", "results.json", "curve.png", "best.safetensors", "agent.safetensors"):
        if (folder / name).exists():
            (folder / name).rename(aside / name)
    (folder / "metrics").mkdir()
    return aside


def write_config(folder: pathlib.Path, config: dict[str, Any]) -> None:
    """Write config.json atomically."""
    write_whole(folder / "config.json", (json.dumps(plain(config), indent=2) + "\n").encode())


def locked(folder: pathlib.Path, doing: str) -> Any:
    """An open file that no other process can lock. The system unlocks it when this process ends.

    On Windows, and on a file system without locks, nothing is locked.

    Raises:
        UserError: the folder cannot be written, or another process has locked it.
    """
    try:
        file = (folder / "lock").open("a+")
    except OSError as error:
        raise UserError(f"{folder} cannot be written ({cause(error)}): make it writable, or copy it.") from None
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # this system has no fcntl
        return file
    except OSError as error:
        if error.errno not in HELD:  # a file system without locks
            return file
        file.seek(0)
        who = file.read().strip() or "another"
        file.close()
        raise UserError(f"{folder} {doing} by process {who}: stop it, or wait until it has ended.") from None
    try:
        file.truncate(0)
        file.write(f"{os.getpid()} on {platform.node()}")
        file.flush()
    except OSError as error:
        with contextlib.suppress(OSError):
            file.close()
        raise UserError(f"{folder} cannot be written ({cause(error)}): free some space.") from None
    return file


def is_locked(folder: pathlib.Path) -> bool:
    """Whether another process has locked the folder. False if it does not exist, or if nothing can be locked."""
    try:
        import fcntl

        file = (folder / "lock").open("r+")
    except (ImportError, OSError):
        return False
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError as error:
            return error.errno in HELD
    return False


def _is_of_training(folder: pathlib.Path) -> bool:
    """Whether a training wrote the config.json in the folder."""
    return records.is_complete(records.parsed(folder / "config.json"))


def folder_name(text: str) -> str:
    """The text as the name of a folder: special characters become dashes."""
    return re.sub(r"[^\w.=,-]+", "-", text)


def free_folder(name: str, parent: str = "runs") -> pathlib.Path:
    """The first of runs/NAME-1, runs/NAME-2, ... that does not exist; NAME is a `folder_name`."""
    number, name = 1, folder_name(name)
    while os.path.exists(folder := pathlib.Path(parent) / f"{name}-{number}"):  # noqa: PTH110 - as in `train`
        number += 1
    return folder
