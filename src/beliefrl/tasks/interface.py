"""What a trained agent depends on in a Gymnasium environment. A run records it, and is not opened with another one."""

from typing import Any, NamedTuple

from beliefrl.errors import UserError, short

UNNAMED = "entry "


class Interface(NamedTuple):
    """The entries that the agent sees, and the bounds of its actions."""

    entries: tuple[str, ...]  # their names; "entry 2" for one without a name
    low: list[float]  # of each action
    high: list[float]

    def check(self, before: Any, folder: str) -> None:
        """Raise a UserError if it differs from the one that a run has recorded. An entry without a name fits any."""
        if not (isinstance(before, dict) and set(self._fields) <= set(before)):
            return  # an older run
        known = zip(before["entries"], self.entries, strict=False)
        named = [pair for pair in known if not any(str(name).startswith(UNNAMED) for name in pair)]
        for what, old, new in (
            ("number of observed entries", len(before["entries"]), len(self.entries)),
            ("observed entries", [old for old, _ in named], [new for _, new in named]),
            ("lower bounds of the actions", before["low"], self.low),
            ("upper bounds of the actions", before["high"], self.high),
        ):
            if old != new:
                raise UserError(
                    f"{folder} was trained in another environment: {what} before: {short(old)}, now: "
                    f"{short(new)}. Give the environment of the training, or train again."
                )
