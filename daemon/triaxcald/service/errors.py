"""Errors of the service's interface, each with its code and its HTTP status."""

from __future__ import annotations

from enum import StrEnum
from typing import Any


class Problem(StrEnum):
    """Why a request is refused, or why the tray is blocked."""

    SERIAL_TWICE = "serial_twice"
    RUNNING = "running"
    REASON_MISSING = "reason_missing"
    ATTEMPTS_USED = "attempts_used"
    GOLDEN_DUE = "golden_due"
    GOLDEN_FAILED = "golden_failed"
    NOT_SIGNED_IN = "not_signed_in"
    ROLE = "role"
    ORIGIN = "origin"
    TOO_LARGE = "too_large"
    TOO_MANY = "too_many"
    UNKNOWN = "unknown"
    INVALID = "invalid"
    DISK = "disk"
    DATABASE = "database"

    @property
    def status(self) -> int:
        """The HTTP status."""
        return _STATUS.get(self, 409)


_STATUS = {
    Problem.NOT_SIGNED_IN: 401, Problem.ROLE: 403, Problem.ORIGIN: 403, Problem.TOO_LARGE: 413, Problem.TOO_MANY: 429,
    Problem.UNKNOWN: 404, Problem.INVALID: 400, Problem.DISK: 503, Problem.DATABASE: 503,
}  # fmt: skip


class ApiError(Exception):
    """A request is refused; ``message`` is one sentence for people. ``headers`` go
    with the answer."""

    def __init__(self, problem: Problem, message: str, headers: dict[str, str] | None = None) -> None:
        message = message.encode("utf-8", "replace").decode()  # JSON can name half of a surrogate pair
        super().__init__(message)
        self.problem, self.message, self.headers = problem, message, headers or {}

    @property
    def body(self) -> dict[str, Any]:
        return {"code": self.problem.value, "message": self.message}
