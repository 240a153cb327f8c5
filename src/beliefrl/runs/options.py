"""The options of a training: its length, evaluations and checkpoints, with the range of each option."""

import dataclasses
from typing import Literal, get_args

from beliefrl.runs import trackers
from beliefrl.types import UserError, check_choice, check_range

MOST_EPISODES = 100_000  # they run in parallel
Processes = Literal["auto", "always", "never"]
Precision = Literal["float32", "tensorfloat32"]  # names in JAX


@dataclasses.dataclass(frozen=True)
class Options:
    """The length of a training, and how it is evaluated and saved."""

    steps: int = 20_000
    """Environment steps of each seed, rounded up to whole cycles of the agent."""
    seeds: int = 1
    """Number of seeds. They are trained side by side in one program."""
    seed: int = 0
    """Number of the first seed. The others have the following numbers."""
    eval_every: int = 2_000
    """Environment steps between two evaluations (Appendix B)."""
    eval_episodes: int = 5
    """Episodes in each evaluation with sampled actions, and again with mode actions."""
    replay_capacity: int = 1_000_000
    """Maximum number of timesteps in a seed's replay. New ones replace the oldest."""
    processes: Processes = "auto"
    """Whether each Gymnasium environment has a process of its own: always, never, or only if a measurement shows that
    this is faster (auto). From Python, auto means never, unless own_process=True. A Python script that uses processes
    must guard its main code with `if __name__ == "__main__":`."""
    checkpoint_steps: int = 2_000
    """Environment steps between two checkpoints. 0: no checkpoints by steps."""
    checkpoint_minutes: float = 10.0
    """Maximum number of minutes between two checkpoints. 0: no checkpoints by time."""
    keep_checkpoints: int = 2
    """Number of the latest checkpoints that are kept."""
    precision: Precision = "float32"
    """Precision of matrix products: float32 or tensorfloat32. With tensorfloat32, an NVIDIA GPU (Ampere or later) may
    round the factors to 10 bits of mantissa, which is faster. A CPU always computes in float32."""
    track: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Trackers that receive the logged numbers, besides the run's own log: tensorboard, wandb, both, or none. wandb
    needs the extra `wandb`, and is offline unless WANDB_MODE is set."""

    def __post_init__(self) -> None:
        """Raise a UserError if a value is impossible."""
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
