"""What the metrology refuses, and why."""

from __future__ import annotations

from collections.abc import Sequence

from triaxcal.number_format import number_of, plain


class TriaxcalError(Exception):
    """Root of everything this package raises on purpose."""


class InvalidData(TriaxcalError):
    """Numbers that cannot be what they are said to be: shapes, NaN, times that
    run backwards."""


class TooShort(InvalidData):
    """No still pose can be found in so few samples, whatever the unit did.

    ``samples`` in ``span_s`` are those of the whole stream; with ``in_pieces``
    they would do, and are those of the longest stretch without a gap.
    ``least`` and ``least_s`` are what the shortest pose takes at their rate;
    the times are zero where a single sample tells no rate.
    """

    def __init__(self, samples: int, span_s: float, least: int, least_s: float, *, in_pieces: bool) -> None:
        takes = number_of(least, "sample") + (f" ({plain(least_s)} s at this rate)" if least_s else "")
        where = "the longest stretch without a gap" if in_pieces else "it"
        has = f"{samples} in {plain(span_s)} s" if span_s else f"{samples}"
        super().__init__(f"too short: a still pose takes at least {takes}, and {where} has {has}")


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
