"""Audits that share what is computed from the same raw records, also with the other workers of a test run."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from triaxcald.audit import Audit, audit, conduct, results, text


class Auditor:
    """`audit`, with results and reports computed once for the same inputs."""

    def __init__(self, once: Callable[[str, Callable[[Path], None]], Path]) -> None:
        self._once = once
        self._again: dict[str, Any] = {}
        self._reports: dict[str, str] = {}
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
            made = self._made(f"again-{key[:24]}", lambda: pickle.dumps(results.compute(recording, raw)))
            self._again[key] = pickle.loads(made)
        return self._again[key]

    def draw(self, again: Any, ending: Any, held: Any, *, pictures: bool = True) -> str:
        of = next((key for key, held_again in self._again.items() if held_again is again), None)
        if of is None or not pictures:
            # A certificate that was taken over from a recording of an earlier version is in it.
            return self._draw(again, ending, held, pictures=pictures)
        key = hashlib.sha256(repr((of, ending, held.state, held.evidence)).encode()).hexdigest()
        if key not in self._reports:
            made = self._made(f"report-{key[:24]}", lambda: self._draw(again, ending, held).encode())
            self._reports[key] = made.decode()
        return self._reports[key]

    def _made(self, name: str, make: Callable[[], bytes]) -> bytes:
        def write(folder: Path) -> None:
            (folder / "made.bin").write_bytes(make())

        return (self._once(f"audit-{name}", write) / "made.bin").read_bytes()


@pytest.fixture(scope="module")
def auditor(once: Callable[..., Path]) -> Iterator[Auditor]:
    found = Auditor(once)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(conduct, "report_of", found.draw)
        yield found


@pytest.fixture
def said(auditor: Auditor) -> Callable[[Path], list[str]]:
    """The differences of a recording, as lines."""
    return auditor.lines
