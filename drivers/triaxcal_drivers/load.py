"""What a unit takes of a line that it shares: the arithmetic of whether the line
can carry its units."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LineLoad:
    """``line`` names what units share, ``settings`` how it is driven, which
    must be the same for all of them. A unit's stream takes ``reads_per_s``
    reads, or frames, each of which keeps the line for ``read_s`` at least."""

    line: str
    settings: str
    reads_per_s: float
    read_s: float

    @property
    def share(self) -> float:
        """Of the line's time; above 1 the line cannot carry it."""
        return self.reads_per_s * self.read_s
