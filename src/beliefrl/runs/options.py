"""The options of a training: its start, length, evaluations and checkpoints, with the range of each option."""

import dataclasses
from typing import Literal, get_args

from beliefrl.errors import UserError
from beliefrl.runs import trackers
from beliefrl.types import LARGEST, LAST_SEED, check_choice, check_range

MOST_EPISODES = 100_000  # they run in parallel
MOST_SECONDS = 1_000_000
Processes = Literal["auto", "always", "never"]
Precision = Literal["float32", "tensorfloat32", "bfloat16"]  # names in JAX


@dataclasses.dataclass(frozen=True)
class Options:
    """Where a training starts and ends, and how it is evaluated and saved."""

    steps: int = 20_000
    """Environment steps of each seed, rounded up to whole cycles of the agent (with `envs`: to whole rounds)."""
    seeds: int = 1
    """Number of seeds. They are trained side by side in one program."""
    seed: int = 0
    """Number of the first seed. The others have the following numbers."""
    envs: int = 1
    """Environments of each seed, which step together. Steps are counted over all of them, and the updates per step stay
    the same. With a slow Gymnasium environment and several cores, more environments make the training faster."""
    overlap: bool = False
    """Make the updates while the Gymnasium environments step. The agent then acts with the weights from before the last
    updates. This makes the training faster if most of a step is waiting, for a robot or for another program."""
    share_env: bool = False
    """Evaluate in the Gymnasium environment of the training, and not in two others. So one robot is enough for a seed.
    An evaluation ends the training's episode. It needs `envs` = 1."""
    eval_every: int = 2_000
    """Environment steps between two evaluations (Appendix B)."""
    eval_episodes: int = 5
    """Episodes in each evaluation with sampled actions, and again with mode actions."""
    stop_at: float | None = None
    """End the training when every seed's mean return of an evaluation, with sampled actions, is at least this. None:
    train for all steps."""
    stop_patience: int = 1
    """Number of consecutive evaluations in which the returns must be at least stop_at."""
    init_from: str | None = None
    """Folder of a run whose trained agent gives the initial networks. It must have the same networks. A seed
    starts from the same seed there. If that run has fewer seeds, they are reused in a cycle. None: random networks."""
    init_best: bool = False
    """Take the best agent of init_from instead of its last one."""
    init_replay: bool = False
    """Also start with the replay of init_from's last checkpoint. The task and `envs` must be the same there."""
    replay_capacity: int = 1_000_000
    """Maximum number of timesteps in a seed's replay. New ones replace the oldest."""
    processes: Processes = "auto"
    """Whether each Gymnasium environment has a process of its own: always, never, or only if a measurement shows that
    this is faster (auto). From Python, auto means never, unless own_process=True. A Python script that uses processes
    must guard its main code with `if __name__ == "__main__":`."""
    step_timeout: float | None = None
    """Maximum number of seconds of one step of a Gymnasium environment. If a step takes longer, the training is saved
    and ends with an error. A reset may take a minute, or this long if it is more. Each environment then has a process
    of its own. None: no limit."""
    checkpoint_steps: int = 2_000
    """Environment steps between two checkpoints. 0: no checkpoints by steps."""
    checkpoint_minutes: float = 10.0
    """Maximum number of minutes between two checkpoints. 0: no checkpoints by time."""
    keep_checkpoints: int = 2
    """Number of the latest checkpoints that are kept."""
    precision: Precision = "float32"
    """Precision of matrix products: float32, tensorfloat32 or bfloat16. With tensorfloat32, an NVIDIA GPU (Ampere or
    later) may round the factors to 10 bits of mantissa, which is faster. A CPU ignores tensorfloat32. With
    bfloat16, the factors of large products in the updates are rounded to 7 bits of mantissa, also on a CPU."""
    track: tuple[Literal["tensorboard", "wandb"], ...] = ("tensorboard",)
    """Trackers that receive the logged numbers, besides the run's own log: tensorboard, wandb, both, or none. wandb
    needs the extra `wandb`, and is offline unless WANDB_MODE is set."""

    def __post_init__(self) -> None:
        """Raise a UserError if a value is impossible."""
        check_range(self, ("steps", "eval_every", "replay_capacity", "stop_patience"), 1)
        check_range(self, ("eval_episodes",), 1, MOST_EPISODES)
        check_range(self, ("checkpoint_steps", "checkpoint_minutes"), 0)
        check_range(self, ("keep_checkpoints",), 1, 1_000_000)
        check_range(self, ("seeds", "envs"), 1, 10_000)
        check_range(self, ("seed",), 0, LAST_SEED)
        check_choice(self, "processes", get_args(Processes))
        check_choice(self, "precision", get_args(Precision))
        for field in dataclasses.fields(self):
            if field.type is bool:
                check_choice(self, field.name, (True, False))
        if self.share_env and self.envs > 1:
            raise UserError(f"share_env=True is impossible with envs={self.envs}: leave one of them out.")
        if self.stop_at is not None:
            check_range(self, ("stop_at",), -LARGEST)
        if self.init_from is not None and (not isinstance(self.init_from, str) or not self.init_from):
            raise UserError(f"init_from={self.init_from!r} is impossible: it must be the path of a run's folder.")
        if self.init_best and self.init_from is None:
            raise UserError("init_best=True needs init_from: name the run whose best agent is taken.")
        if self.init_replay and self.init_from is None:
            raise UserError("init_replay=True needs init_from: name the run whose replay is taken.")
        if self.step_timeout is not None:
            check_range(self, ("step_timeout",), 0.001, MOST_SECONDS)
            if self.processes == "never":
                raise UserError("step_timeout needs a process for each environment: choose processes=always or auto.")
        if not isinstance(self.track, tuple):
            raise UserError(f"track={self.track} is impossible: it must be a tuple of names.")
        for name in self.track:
            if name not in tuple(trackers.TRACKERS):
                raise UserError(f"track={name} is impossible: it must be {' or '.join(trackers.TRACKERS)}.")


OPTION_NAMES = tuple(field.name for field in dataclasses.fields(Options))
