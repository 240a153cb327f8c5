"""One training of a sweep in a process of its own: `python -m beliefrl.worker [CORE] train ...`.

It runs the command line's `train` on one core, and stops (with a checkpoint) if its parent process dies.
"""

import ctypes
import os
import signal
import sys

STOP_WITH_PARENT = 1  # prctl's PR_SET_PDEATHSIG


def main(argv: list[str]) -> None:
    """Train on the core that is named first; `-` is any core."""
    parent = os.getppid()
    core, *command = argv
    if core != "-":
        os.sched_setaffinity(0, {int(core)})  # before XLA counts the cores
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(STOP_WITH_PARENT, signal.SIGTERM)
        if os.getppid() != parent:
            raise SystemExit(128 + signal.SIGTERM)
    sys.argv = ["beliefrl", *command]  # recorded in the run's config
    from beliefrl import cli

    cli.main(command)


if __name__ == "__main__":
    main(sys.argv[1:])
