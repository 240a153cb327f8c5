"""A run's folder for reading, with the logs read once."""

import os
from collections.abc import Iterator

from beliefrl.runs.records import Row
from beliefrl.runs.run import Run


class CachedRun(Run):
    """A run that reads its logs once and caches its evaluations and which seeds have diverged."""

    KINDS = ("evaluation", "diverged")

    def __init__(self, folder: str | os.PathLike[str]):
        super().__init__(folder)
        self._rows: dict[int, list[Row]] = {}

    def rows(self, seed: int, kind: str | None = None) -> Iterator[Row]:
        if kind not in self.KINDS:
            return super().rows(seed, kind)
        if seed not in self._rows:
            self._rows[seed] = [row for row in super().rows(seed) if row["kind"] in self.KINDS]
        return (row for row in self._rows[seed] if row["kind"] == kind)
