"""One training of a sweep in a process of its own: `python -m beliefrl.worker PARENT CORE train ...`.

It runs the command line's `train` on one core. On Linux it stops, with a checkpoint, if its parent process dies.
"""

import ctypes
import os
import signal
import sys

STOP_WITH_PARENT = 1  # prctl's PR_SET_PDEATHSIG


def main(argv: list[str]) -> None:
    """Run a command of `beliefrl` for the process PARENT, on the core CORE; `-` is any core."""
    parent, core, *command = argv
    if core != "-":
        os.sched_setaffinity(0, {int(core)})  # before XLA counts the cores
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(STOP_WITH_PARENT, signal.SIGTERM)
        if os.getppid() != int(parent):  # it has died already
            raise SystemExit(128 + signal.SIGTERM)
    sys.argv = ["beliefrl", *command]  # recorded in the run's config
    from beliefrl import cli

    cli.main(command)


if __name__ == "__main__":
    main(sys.argv[1:])
