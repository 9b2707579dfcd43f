"""How far a long computation is, for somebody who waits for it: a callback that
whoever calls gives, and no output."""

from __future__ import annotations

from enum import StrEnum
from typing import Protocol


class Stage(StrEnum):
    """What is being done."""

    POSES = "poses"
    FIT = "fit"
    EFFECTS = "effects"
    ERRORS = "errors"
    ADVICE = "advice"


class Progress(Protocol):
    def __call__(self, stage: Stage, done: float | None = None) -> None:
        """At the beginning of a stage, and as it goes on: ``done`` is about the
        share of it that is done, None where nobody knows."""
        ...


def unreported(stage: Stage, done: float | None = None) -> None:
    """The default progress, which reports nothing."""
