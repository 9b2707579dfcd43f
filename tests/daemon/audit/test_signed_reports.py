"""The report of a recording that a trusted station signed: its words are compared, its lines are taken as signed."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Metadata

from tests.daemon.audit.forging import OUTCOME, Forgery
from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import SECOND_NS, sign_anew, when
from triaxcald.audit import Audit, Policy, audit
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import State
from triaxcald.recording.schema import RECOVERY_RECORD, SIGNATURE_FILE
from triaxcald.report import charts
from triaxcald.signing.keys import new_key
from triaxcald.signing.station import StationSigning

pytestmark = pytest.mark.slow

REPORT = "report.html"
Change = Callable[[str], str]


@dataclass(frozen=True)
class Signed:
    """A folder in which a station signs whatever the report says, and audits with or without its trust file."""

    folder: Path
    run: Path
    auditor: Any

    def audited(self, change: Change, *, trust: bool = True, mended: bool = False) -> Audit:
        forgery = Forgery.of(self.run)
        report = forgery.attachment(REPORT).data.decode()
        changed = change(report)
        forgery.put(REPORT, changed.encode())
        digest = hashlib.sha256(changed.encode()).hexdigest()
        forgery.edit(OUTCOME, lambda o: o["sha256"].update({REPORT: digest}))
        forgery.seal()
        if mended:
            forgery.records.append(Metadata(RECOVERY_RECORD, {"of": "unit.mcap"}))
        path = forgery.write(self.folder / "unit.mcap")
        key = new_key(self.folder / "keys", "line", None)
        ended_ns = forgery.attachment(OUTCOME).log_time + SECOND_NS
        sign_anew(path, StationSigning(key, self.folder, "bench", None, lambda: ended_ns).sign)
        if trust:
            trusted(self.folder, when(0), key)
        return audit(path, compute=self.auditor.compute, policy=Policy())


@pytest.fixture
def signed(tmp_path: Path, finished_run: Any, auditor: Any) -> Signed:
    (tmp_path / "keys").mkdir()
    return Signed(tmp_path, finished_run.can, auditor)


def test_a_signed_report_needs_no_drawing(signed: Signed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(charts, "_svg", None)  # a call of it would fail
    found = signed.audited(lambda report: report)
    assert (found.signature.state, found.differences) == (State.TRUSTED, ())
    assert found.notes.pictures_as_signed
    assert REPORT in found.checked


def test_without_trust_the_pictures_are_drawn(signed: Signed) -> None:
    found = signed.audited(_other_line, trust=False)
    assert found.signature.state is State.UNTRUSTED
    assert (REPORT, Kind.NOT_DRAWN) in [(d.part, d.kind) for d in found.differences]
    assert not found.notes.pictures_as_signed


def test_in_a_recording_that_was_mended_the_pictures_are_drawn(signed: Signed) -> None:
    """Anybody can leave one to be mended and signed."""
    found = signed.audited(_other_line, mended=True)
    assert (found.signature.state, found.signature.mended) == (State.TRUSTED, True)
    assert {(REPORT, Kind.NOT_DRAWN), (SIGNATURE_FILE, Kind.MENDED)} <= {(d.part, d.kind) for d in found.differences}
    assert not found.notes.pictures_as_signed


def _other_line(report: str) -> str:
    """A line in the first picture that goes elsewhere."""
    at = report.index("<svg")
    return report[:at] + re.sub(r' d="M (\d+)', lambda m: f' d="M {int(m[1]) + 40}', report[at:], count=1)


def _other_figure(report: str) -> str:
    return report.replace(" µg", " ng", 1)


def _other_description(report: str) -> str:
    return re.sub(r"<title>Bars\. ", "<title>Bars, none of them long. ", report, count=1)


def _picture_less(report: str) -> str:
    return re.sub(r"<svg.*?</svg>", "", report, count=1, flags=re.DOTALL)


@pytest.mark.parametrize("change", [_other_figure, _other_description, _picture_less])
def test_the_words_of_a_signed_report_are_compared(signed: Signed, change: Change) -> None:
    found = signed.audited(change)
    assert found.signature.state is State.TRUSTED
    assert [(d.part, d.kind) for d in found.differences] == [(REPORT, Kind.NOT_DRAWN)]
