"""Recordings that earlier versions made are audited, and the audit names the version."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from tests.daemon.audit.forging import Forgery
from triaxcald.audit import audit, text
from triaxcald.audit.conduct import Audit, Result
from triaxcald.inputs import measure

MADE_BY = Path(__file__).parent.parent / "recordings" / "made-by"
EVERY = sorted(MADE_BY.glob("*/*.mcap"))
STATED = 1.0
"""Standard errors within which coefficients of another version have to lie."""


def place(path: Path) -> str:
    return f"{path.parent.name}/{path.stem}"


def registers_off(found: Audit) -> list[str]:
    return [d.part for d in found.differences if d.part.startswith(("registers-", "/registers", "raw"))]


@pytest.mark.slow
@pytest.mark.parametrize("path", EVERY, ids=place)
def test_an_earlier_recording_is_audited_and_its_version_named(path: Path) -> None:
    found = audit(path)
    assert found.made_by == path.parent.name != version("triaxcal")
    assert found.verdict == "pass"
    assert "certificate.json" in found.checked
    if found.result is Result.DIFFERS:
        assert f"triaxcal {found.made_by}" in text.heading(found)
    assert found.furthest is not None
    assert found.furthest[0] < STATED
    # The device holds what its own version asked for.
    assert registers_off(found) == []


@pytest.mark.slow
@pytest.mark.parametrize("path", EVERY[:1], ids=place)
def test_a_changed_register_of_an_earlier_recording_is_found(path: Path, tmp_path: Path) -> None:
    forged = Forgery.of(path)
    forged.edit("registers-after.json", lambda held: held.update(bias_x="00" * (len(held["bias_x"]) // 2)))
    assert "registers-after.json" in registers_off(audit(forged.write(tmp_path / "forged.mcap")))


@pytest.mark.slow
@pytest.mark.parametrize("path", EVERY[:1], ids=place)
def test_a_changed_coefficient_of_an_earlier_recording_is_found(path: Path, tmp_path: Path) -> None:
    def change(certificate: dict) -> None:  # type: ignore[type-arg]
        calibration = certificate["result"]["calibration"]
        calibration["bias"][0] += 3 * calibration["standard_error"]["bias"][0]

    forged = Forgery.of(path)
    forged.edit("certificate.json", change)
    found = audit(forged.write(tmp_path / "forged.mcap"))
    assert found.furthest == (pytest.approx(3, rel=0.1), "bias[0]")


@pytest.mark.parametrize("path", EVERY, ids=place)
def test_an_earlier_recording_can_be_measured_again(path: Path) -> None:
    assert len(measure(str(path)).poses) >= 26
