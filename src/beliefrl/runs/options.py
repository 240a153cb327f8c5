"""The options of a training: how long, how often and how it is evaluated, with the range of each."""

import dataclasses
from typing import Literal, get_args

from beliefrl.runs import trackers
from beliefrl.types import UserError, check_choice, check_range

MOST_EPISODES = 100_000  # in parallel
Processes = Literal["auto", "always", "never"]
Precision = Literal["float32", "tensorfloat32"]  # by their names in JAX


@dataclasses.dataclass(frozen=True)
class Options:
    """How long a training is, and how it is evaluated and saved."""

    steps: int = 20_000
    """Environment steps of each seed, rounded up to whole cycles of the agent."""
    seeds: int = 1
    """How many seeds are trained, side by side in one program."""
    seed: int = 0
    """Number of the first seed; the others follow it."""
    eval_every: int = 2_000
    """Environment steps between two evaluations (Appendix B)."""
    eval_episodes: int = 5
    """Episodes of each evaluation, with sampled actions and again with mode actions."""
    replay_capacity: int = 1_000_000
    """Most timesteps that a seed's replay keeps; new ones replace the oldest."""
    processes: Processes = "auto"
    """Gymnasium environments: a process for each (always), for none (never), or where a measurement says that it pays
    (auto). From Python, auto is never, and a script that says always must guard its main module with `if __name__ ==
    "__main__":`."""
    checkpoint_steps: int = 2_000
    """Environment steps between two checkpoints of everything (0: none by steps)."""
    checkpoint_minutes: float = 10.0
    """Minutes between two checkpoints, if they pass sooner (0: none by time)."""
    keep_checkpoints: int = 2
    """How many of the last checkpoints are kept."""
    precision: Precision = "float32"
    """Precision of matrix products: float32, or tensorfloat32, which lets an NVIDIA GPU (Ampere or later) round their
    factors to 10 bits of mantissa to be faster. A CPU computes in float32 either way."""
    track: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Trackers that get the numbers besides the run's own logs: tensorboard, wandb (extra `wandb`; offline unless
    WANDB_MODE says otherwise), both, or none."""

    def __post_init__(self) -> None:
        """Refuse impossible values with a UserError."""
        check_range(self, ("steps", "eval_every", "replay_capacity"), 1)
        check_range(self, ("eval_episodes",), 1, MOST_EPISODES)
        check_range(self, ("checkpoint_steps", "checkpoint_minutes"), 0)
        check_range(self, ("keep_checkpoints",), 1, 1_000_000)
        check_range(self, ("seeds",), 1, 10_000)
        check_range(self, ("seed",), 0, 2_000_000_000)
        check_choice(self, "processes", get_args(Processes))
        check_choice(self, "precision", get_args(Precision))
        if not isinstance(self.track, tuple):
            raise UserError(f"track={self.track} is impossible: it must be a tuple of names.")
        for name in self.track:
            if name not in tuple(trackers.TRACKERS):
                raise UserError(f"track={name} is impossible: it must be {' or '.join(trackers.TRACKERS)}.")
