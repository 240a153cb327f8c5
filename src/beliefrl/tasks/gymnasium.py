"""Any Gymnasium environment as a task: flat and masked observations, actions in [-1, 1], and clear messages for faults.

Such a task runs on the host, not in a compiled program (`host_loop`). It has a `spec`, and makes environments whose
episodes follow the same rules as those of `rollout` (`seen_environment`).
"""

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import gymnasium

from beliefrl.catalogue import our_task_names
from beliefrl.errors import UserError, said, short
from beliefrl.tasks.faults import NONE, Faults
from beliefrl.tasks.interface import Interface, check_measures, interface_of
from beliefrl.tasks.repeat import LONGEST
from beliefrl.tasks.seen_environment import Environment, FaultyEnvironment
from beliefrl.tasks.settings import settings_kept
from beliefrl.types import LARGEST, Spec, check_range


@dataclasses.dataclass(frozen=True, eq=False)
class GymnasiumTask:
    """A Gymnasium environment with a bounded Box of actions and an observation that flattens to numbers."""

    make: Callable[..., gymnasium.Env[Any, Any]]
    """Makes one environment; called with `arguments`."""
    name: str = ""
    """Name in messages and runs; empty: the name of `make`."""
    arguments: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Keyword arguments for `make`."""
    indices: tuple[int, ...] | None = None
    """Entries of the flat observation that the agent sees; None: all."""
    max_steps: int | None = None
    """Time limit in steps of the environment, which truncates episodes; None: the environment's own limit."""
    measures: tuple[str, ...] = ()
    """Entries of the environment's info whose last value in an episode is logged; `is_success` is "success", too."""
    faults: Faults = NONE
    """Missing and faulty sensors."""
    steps_per_action: int = 1
    """Steps of the environment for which an action is applied. For the agent they are one step."""

    def __post_init__(self) -> None:
        """Set the default name. Raise a UserError for an impossible time limit, or if `make` makes no environments."""
        if not callable(self.make):
            raise UserError(f"GymnasiumTask needs a class or function that makes environments, not {short(self.make)}.")
        if isinstance(self.measures, str):
            raise UserError(f"measures={self.measures!r} is a text: give a tuple, ({self.measures!r},).")
        if not isinstance(self.measures, tuple) or not all(isinstance(name, str) for name in self.measures):
            raise UserError(f"measures={short(self.measures)} is impossible: give a tuple of names, ('success',).")
        check_measures(self.measures, "The task")
        if self.max_steps is not None:
            check_range(self, ("max_steps",), 1)
        check_range(self, ("steps_per_action",), 1, LONGEST)
        name = self.name or getattr(self.make, "__qualname__", type(self.make).__name__)
        if name in our_task_names() and not hasattr(self.make, "id"):  # a run would be opened with that task
            name = f"{self.make.__module__}:{name}"
        object.__setattr__(self, "name", name)

    @cached_property
    def _seen(self) -> tuple[Spec, Interface]:
        with settings_kept(), contextlib.closing(self.environment()) as environment:
            interface = interface_of(environment, self.name)
        size = self.faults.observed_size(environment.indices.size)
        return Spec(size, len(interface.low), environment.limit or LARGEST, self.measures), interface

    @property
    def spec(self) -> Spec:
        """Sizes of the observation and the action, and the time limit in steps.

        Raises:
            UserError: the environment cannot be made, or its spaces are not supported.
        """
        return self._seen[0]

    @property
    def interface(self) -> Interface:
        """What the agent sees and does; raises as `spec`."""
        return self._seen[1]

    @property
    def entry_names(self) -> tuple[str, ...]:
        """The name of each entry that the agent sees; raises as `spec`."""
        return self.interface.entries

    def environment(self, seed: str = "") -> Environment:
        """Make one environment, as the agent sees it. `seed` identifies it in error messages.

        Raises:
            UserError: the environment cannot be made, its spaces are not supported, or the noise does not fit its
                observation.
        """
        return Environment(self, seed) if self.faults == NONE else FaultyEnvironment(self, seed)

    def bare(self) -> Any:
        """Make one environment as it is, without any checks. It may be anything.

        Raises:
            UserError: the environment cannot be made.
        """
        try:
            return self.make(**self.arguments)
        except UserError:
            raise
        except (Exception, SystemExit) as error:  # an environment may raise anything
            raise UserError(f"{self.name} cannot be made: {said(error)}.") from None
