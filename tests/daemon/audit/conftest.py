"""Audits in this process that share what is computed from the same raw records."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.audit import Audit, audit, conduct, results, text


class Auditor:
    """`audit`, with results and reports computed once for the same inputs."""

    def __init__(self) -> None:
        self._again: dict[str, Any] = {}
        self._reports: dict[Any, str] = {}
        self._draw = conduct.report_of

    def __call__(self, path: Path) -> Audit:
        return audit(path, compute=self.compute)

    def lines(self, path: Path) -> list[str]:
        return [text.difference(d) for d in self(path).differences]

    def compute(self, recording: Any, raw: Any) -> Any:
        files = {n: d.hex() for n, d in recording.attachments.items() if n.endswith(".toml") or "/" in n}
        inputs = [files, {k: recording.metadata.get(k) for k in ("unit", "software")}, recording.ends_with]
        key = hashlib.sha256(json.dumps(inputs).encode() + raw.whole.hexdigest().encode()).hexdigest()
        if key not in self._again:
            self._again[key] = results.compute(recording, raw)
        return self._again[key]

    def draw(self, again: Any, ending: Any, held: Any) -> str:
        key = (id(again), ending, held.state, held.evidence)
        if key not in self._reports:
            self._reports[key] = self._draw(again, ending, held)
        return self._reports[key]


@pytest.fixture(scope="module")
def auditor() -> Any:
    found = Auditor()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conduct, "report_of", found.draw)
        yield found


@pytest.fixture
def said(auditor: Auditor) -> Callable[[Path], list[str]]:
    """The differences of a recording, as lines."""
    return auditor.lines
