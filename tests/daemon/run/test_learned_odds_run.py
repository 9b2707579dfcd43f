"""run --odds and the station's odds: carried in the recording, used by the fit, and by the audit again."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Workshop
from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit
from triaxcald.audit.conduct import Result
from triaxcald.cli.commands import main
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import ODDS_FILE

Run = Callable[..., Any]
BUS = {"host": "127.0.0.1", "port": 502}
NOBODY = {"host": "127.0.0.1", "port": 1}
PLAN = {"poses": 14, "hold_s": 1.0, "check_poses": 3}
ODDS = {
    "format": "triaxcal.odds/1",
    "part_number": "P 7",
    "units": 40,
    "effects": {"temperature_bias": {"odds": 0.5, "units": 31.2}, "hysteresis": {"odds": 0.002, "units": 0.1}},
    "unmodelled_probability": 0.08,
}


@dataclass(frozen=True)
class Made:
    recording: Path
    odds: Path
    result: dict[str, Any]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """The run of a unit by a station that names learned odds."""
    workshop = Workshop(tmp_path_factory.mktemp("odds"))
    odds = workshop.write("odds.json", json.dumps(ODDS))
    device = workshop.device("left.toml", bus=BUS, seed=3)
    station = workshop.station(
        {"name": "left", "serial": "4711", "bus": BUS}, odds="odds.json", plan=PLAN, work={"part_number": "P 7"},
        limits={"rms_g": 1e-2},
    )  # fmt: skip
    out = io.StringIO()
    with virtual_line(described(device)), contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        main(["run", str(station), "--json"])
    found = json.loads(out.getvalue())["units"][0]
    return Made(Path(found["recording"]), odds, json.loads(Path(found["certificate"]).read_text())["result"])


@pytest.mark.slow
def test_the_recording_carries_the_odds_and_an_audit_recomputes_with_them(made: Made) -> None:
    with Recording.open(made.recording) as recording:
        assert recording.attachments[ODDS_FILE] == made.odds.read_bytes()
        assert recording.metadata["odds"] == {"file": "odds.json"}
    assert made.result["odds"]["effects"] == {"temperature_bias": 0.5, "hysteresis": 0.002}
    assert made.result["odds"]["units"] == 40
    found = audit(made.recording)
    assert found.differences == ()
    assert found.result is Result.SAME_BYTES
    assert "certificate.json" in found.checked


@pytest.mark.slow
@pytest.mark.parametrize("without", [True, False])
def test_an_audit_with_other_odds_or_without_them_differs(
    made: Made, rewrite: Callable[..., Path], without: bool
) -> None:
    other = json.dumps({**ODDS, "units": 41}).encode()

    def changed(name: str, data: bytes) -> bytes | None:
        return data if name != ODDS_FILE else None if without else other

    assert audit(rewrite(made.recording, attachment=changed)).result is Result.DIFFERS


@pytest.mark.slow
def test_diagnose_of_the_recording_goes_by_its_odds_and_an_option_replaces_them(made: Made, triaxcal: Run) -> None:
    own = triaxcal("diagnose", made.recording, "--json").json
    assert own["odds"] == made.result["odds"]
    assert own["probabilities"] == made.result["probabilities"]
    other = made.odds.with_name("other.json")
    other.write_text(json.dumps({**ODDS, "units": 7}))
    assert triaxcal("diagnose", made.recording, "--odds", other, "--json").json["odds"]["units"] == 7
    other.write_text(json.dumps({**ODDS, "part_number": "Q"}))
    triaxcal("diagnose", made.recording, "--odds", other).failed(2, "other.json", "part number Q", "P 7")


WRONG = {
    "another part number": (ODDS, ("part number P 7", "P 8")),
    "another format": ({**ODDS, "format": "triaxcal.loop/1"}, ("triaxcal.odds/1", "triaxcal.loop/1")),
    "no odds": ({**ODDS, "effects": {"hysteresis": {"odds": 0.0}}}, ("effects.hysteresis.odds",)),
    "more than even odds": ({**ODDS, "effects": {"hysteresis": {"odds": 2.0}}}, ("effects.hysteresis.odds",)),
    "a certain unmodelled part": ({**ODDS, "unmodelled_probability": 1.0}, ("unmodelled_probability",)),
    "a list": ([1], ("JSON",)),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("by_option", [True, False])
def test_wrong_odds_are_bad_input_before_anything_is_opened(
    workshop: Any, triaxcal: Run, case: str, by_option: bool
) -> None:
    content, words = WRONG[case]
    odds = workshop.write("odds.json", json.dumps(content))
    station = workshop.station(
        {"name": "left", "serial": "4711", "bus": NOBODY}, work={"part_number": "P 8"},
        **({} if by_option else {"odds": "odds.json"}),
    )  # fmt: skip
    before = sorted(p.name for p in workshop.folder.iterdir())
    triaxcal("run", station, *(("--odds", odds) if by_option else ())).failed(2, "odds.json", *words)
    assert sorted(p.name for p in workshop.folder.iterdir()) == before


def test_odds_that_are_not_there_are_bad_input(workshop: Any, triaxcal: Run) -> None:
    station = workshop.station({"name": "left", "serial": "4711", "bus": NOBODY}, odds="none.json")
    triaxcal("run", station).failed(2, "none.json")
