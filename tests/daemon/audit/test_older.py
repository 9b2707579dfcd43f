"""Audits of a recording of 0.1.0: what its search found is taken as it stands, and all the rest has to agree."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from tests.daemon.audit.forging import Forgery
from triaxcald.audit import audit, text
from triaxcald.audit.older import as_searched
from triaxcald.certificate import Certified
from triaxcald.station.config import Limits

EARLIER = Path(__file__).parents[3] / "recordings" / "by-0.1.0.mcap"


@pytest.mark.slow
def test_what_its_search_found_is_taken_as_it_stands_and_that_is_said() -> None:
    found = audit(EARLIER)
    assert found.differences == ()
    assert text.heading(found).startswith(f"{EARLIER}: agrees, as far as this version can tell (certificate.json, ")
    assert any("named effects by a search that is gone" in note for note in text.notes(found.notes))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda c: c["result"]["calibration"]["poses"][3]["mean"].__setitem__(0, 1.0),
            "certificate.json: result.calibration.poses[3].mean[0]: stored 1.0, computed again ",
        ),
        (
            lambda c: c["registers"]["words"][0].update(wanted=-2.5),
            "certificate.json: registers.words[0].raw: stored ",
        ),
        (
            lambda c: c["registers"]["words"][0].update(raw="000020c0", wanted=-2.5),
            "registers-after.json: scale_factor_x: the device holds ",
        ),
        (
            lambda c: c["result"]["after"].update(rms_g=7e-5),
            'certificate.json: verdict: stored "within limits", computed again "outside limits"',
        ),
        (lambda c: c.update(verdict="not judged"), 'certificate.json: verdict: stored "not judged", computed again "'),
        (lambda c: c["recording"].update(poses=25), "certificate.json: recording.poses: stored 25, computed again 2"),
        (lambda c: c["result"].pop("calibration"), "certificate.json: cannot be computed again: "),
    ],
)
def test_a_certificate_that_was_changed_differs(
    change: Callable[[Any], object], says: str, tmp_path: Path, said: Callable[[Path], list[str]]
) -> None:
    forgery = Forgery.of(EARLIER)
    forgery.edit("certificate.json", change)
    assert any(line.startswith(says) for line in said(forgery.write(tmp_path / "changed.mcap")))


def test_frames_too_short_for_their_message_were_errors_then() -> None:
    result: dict[str, Any] = {"calibration": {"poses": []}, "after": {"rms_g": 1e-5}}
    stored = {"recording": {"errors": 3}, "result": result, "registers": None}
    again = {"recording": {"errors": 1, "malformed": 2}, "result": result}
    made = as_searched(Certified(again, cast(Any, None), None, True), stored, cast(Any, None), Limits())
    assert made.document["recording"]["errors"] == 3
