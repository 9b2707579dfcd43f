"""What the metrology refuses, and why."""

from __future__ import annotations

from collections.abc import Sequence


class TriaxcalError(Exception):
    """Root of everything this package raises on purpose."""


class InvalidData(TriaxcalError):
    """Numbers that cannot be what they are said to be: shapes, NaN, times that
    run backwards."""


class Refused(TriaxcalError):
    """The data cannot carry the answer.

    ``wanted`` names the poses that would mend it (labels of
    `triaxcal.model.directions`), best first.
    """

    def __init__(self, message: str, *, wanted: Sequence[str] = ()) -> None:
        super().__init__(message)
        self.wanted = tuple(wanted)


class NotStill(Refused):
    """The fit went where no still triad's poses lead it; ``how`` it ended."""

    def __init__(self, how: str) -> None:
        super().__init__(f"{how}; the poses do not look like those of one still triad")


class MissingChannel(UserWarning):
    """A channel that an effect needs was not given, and counts as at its
    reference."""
