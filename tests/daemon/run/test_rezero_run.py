"""run --rezero: from a certificate of yesterday to new biases in the registers, and what an audit makes of it."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import Workshop
from tests.virtual_line import described, virtual_line
from triaxcal.model.directions import bias_directions
from triaxcald.audit import audit
from triaxcald.audit.conduct import Result
from triaxcald.cli.commands import main
from triaxcald.earlier_calibration import ATTACHMENT
from triaxcald.recording.reader import Recording
from triaxcald.station.guidance import guide

Run = Callable[..., Any]
K = (-2.410618, -2.403823, -2.371761)
BIAS = np.array([5.6e-3, -2.9e-3, 4.6e-3])
SHIFT = np.array([2e-3, -1.5e-3, 1e-3])
BUS = {"host": "127.0.0.1", "port": 502}
FIXTURE = {"poses": 26, "hold_s": 2.0, "move_s": 0.8}
PLAN = {"poses": 26, "hold_s": 1.0, "check_poses": 3}
CAL = {
    "format": "triaxcal.calibration/1",
    "scale_factor": list(K),
    "misalignment": [0.006, 0.004, -0.001],
    "bias": BIAS.tolist(),
    "effects": {},
    "standard_error": {"scale_factor": [1e-4] * 3, "misalignment": [5e-5] * 3, "bias": [5e-5] * 3},
}
HUMID = {
    "channel_bias:humidity": {axis: {"value": 1e-5, "standard_error": 1e-6, "unit": "g/[humidity]"} for axis in "xyz"}
}
NOBODY = {"host": "127.0.0.1", "port": 1}


def unit(serial: str | None = "4711", **more: Any) -> dict[str, Any]:
    return {"name": "left", "bus": BUS, **({"serial": serial} if serial else {}), **more}


@dataclass(frozen=True)
class Days:
    folder: Path
    certificate: Path
    second: dict[str, Any]

    @property
    def recording(self) -> Path:
        return Path(self.second["recording"])


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Days:
    """A unit that is calibrated in full, and by four poses after its biases have moved."""
    workshop = Workshop(tmp_path_factory.mktemp("days"))
    first = ran(workshop, BIAS, 3)
    assert first["exit_code"] == 0
    certificate = workshop.folder / "yesterday.json"
    certificate.write_bytes(Path(first["certificate"]).read_bytes())
    for path in workshop.folder.glob("left-4711-*"):  # the clock of the virtual line begins anew
        path.unlink()
    second = ran(workshop, BIAS + SHIFT, 9, "--rezero", str(certificate))
    assert second["exit_code"] == 0
    return Days(workshop.folder, certificate, second)


def ran(workshop: Any, bias: np.ndarray, seed: int, *options: str, scale: float = 1.0) -> dict[str, Any]:
    """The unit's part of what `run` says of it."""
    sensor = {"scale_factor": [k * scale for k in K], "bias": bias.tolist()}
    device = workshop.device("left.toml", bus=BUS, sensor=sensor, fixture=FIXTURE, seed=seed)
    station = workshop.station(unit(), plan=PLAN, limits={"rms_g": 2e-4, "verification_rms_g": 2e-4})
    out, err = io.StringIO(), io.StringIO()
    with virtual_line(described(device)), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        main(["run", str(station), "--json", *options])
    found: dict[str, Any] = json.loads(out.getvalue())["units"][0]
    return found


@pytest.mark.slow
def test_four_poses_are_recorded_and_the_biases_are_new(days: Days) -> None:
    certificate = json.loads(Path(days.second["certificate"]).read_text())
    result = certificate["result"]
    calibration, yesterday = result["calibration"], json.loads(days.certificate.read_text())["result"]["calibration"]
    assert result["format"] == "triaxcal.rezero/1"
    assert certificate["recording"]["poses"] == len(calibration["poses"]) == 4
    assert [calibration[n] for n in ("scale_factor", "misalignment")] == [
        yesterday[n] for n in ("scale_factor", "misalignment")
    ]
    assert np.allclose(calibration["bias"], BIAS + SHIFT, atol=5e-4)
    assert result["after"]["rms_g"] < 0.3 * result["before"]["rms_g"]
    assert days.second["before"] == result["before"]


@pytest.mark.slow
def test_the_device_is_written_and_its_own_output_verified(days: Days) -> None:
    outcome = days.second["outcome"]
    assert (outcome["verdict"], outcome["device_state"]) == ("pass", "new_verified")
    written = set(days.second["registers_written"])
    assert written
    assert days.second["verification"]["after_rms_g"] < 2e-4 < days.second["verification"]["before_rms_g"]


@pytest.mark.slow
def test_the_recording_carries_the_calibration_and_an_audit_recomputes_the_result(days: Days) -> None:
    with Recording.open(days.recording) as recording:
        assert recording.attachments[ATTACHMENT] == days.certificate.read_bytes()
    found = audit(days.recording)
    assert found.differences == ()
    assert found.result is Result.SAME_BYTES
    assert "certificate.json" in found.checked
    assert "report.html" in found.checked


@pytest.mark.slow
@pytest.mark.parametrize("without", [True, False])
def test_an_audit_with_another_calibration_differs(days: Days, rewrite: Callable[..., Path], without: bool) -> None:
    other = days.certificate.read_text().replace('"4711"', '"4712"').encode()

    def changed(name: str, data: bytes) -> bytes | None:
        return data if name != ATTACHMENT else None if without else other

    assert audit(rewrite(days.recording, attachment=changed)).result is Result.DIFFERS


@pytest.mark.slow
def test_a_unit_whose_scale_factors_have_changed_is_refused_and_nothing_is_written(days: Days, workshop: Any) -> None:
    found = ran(workshop, BIAS + SHIFT, 11, "--rezero", str(days.certificate), scale=1.01)
    assert found["exit_code"] == 3
    assert "no longer fit" in found["error"]
    outcome = found["outcome"]
    assert (outcome["verdict"], outcome["code"], outcome["device_state"]) == ("aborted", "refused", "untouched")
    assert audit(Path(found["recording"])).differences == ()


@pytest.mark.slow
def test_its_certificate_can_be_renewed_the_day_after(days: Days, triaxcal: Run) -> None:
    certificate = days.second["certificate"]
    done = triaxcal("rezero", certificate, days.recording, "--json")
    assert done.code == 0, done
    assert done.json["unit"]["serial"] == "4711"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unit": {"serial": "0815"}}, "is of the unit with serial 0815"),
        ({"scale_factor": [2.4, -2.4, -2.37]}, "scale_factor.x is 2.4, of another sign"),
        ({"reference": 1.001}, "was made for the reference 1.001"),
        ({"reference": 9.80665, "units": {"reference": "m/s^2"}}, "was made for the reference 9.80665"),
        ({"units": {"output": "mV", "reference": "g"}}, "is of outputs in mV"),
        ({"effects": HUMID, "channel_reference": {"humidity": 40.0}}, "needs humidity, which unit left does not send"),
    ],
)
def test_another_unit_and_other_signs_and_references_are_refused_before_anything_is_opened(
    workshop: Any, triaxcal: Run, change: dict[str, Any], words: str
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, **change}))
    station = workshop.station(unit(bus=NOBODY))
    before = sorted(p.name for p in workshop.folder.iterdir())
    triaxcal("run", station, "--rezero", cal).failed(3, "refused: cal.json: ", words)
    assert sorted(p.name for p in workshop.folder.iterdir()) == before


def test_a_calibration_that_does_not_say_how_uncertain_it_is_is_refused_at_once(workshop: Any, triaxcal: Run) -> None:
    cal = workshop.write("cal.json", json.dumps({n: v for n, v in CAL.items() if n != "standard_error"}))
    triaxcal("run", workshop.station(unit(bus=NOBODY)), "--rezero", cal).failed(3, "how uncertain")


def test_a_unit_whose_serial_only_the_device_tells_is_refused_before_the_first_pose(
    workshop: Any, triaxcal: Run
) -> None:
    cal = workshop.write("cal.json", json.dumps({**CAL, "unit": {"serial": "0815"}}))
    with workshop.serve(workshop.device()) as served:
        station = workshop.station(unit(None, bus=served.bus))
        done = triaxcal("run", station, "--rezero", cal)
    done.failed(3, "is of the unit with serial 0815", "4711")
    assert not list(workshop.folder.glob("*.mcap"))


@pytest.mark.parametrize("content", ["", "{}", "[1]"])
def test_what_is_no_calibration_is_bad_input(workshop: Any, triaxcal: Run, content: str) -> None:
    cal = workshop.write("cal.json", content)
    triaxcal("run", workshop.station(unit(bus=NOBODY)), "--rezero", cal).failed(2, "cal.json")


def test_of_several_units_each_has_its_own_file(workshop: Any, triaxcal: Run) -> None:
    other = {"name": "right", "serial": "4712", "bus": {"host": "127.0.0.1", "port": 2}}
    station = workshop.station(unit(bus=NOBODY), other)
    cal = workshop.write("cal.json", json.dumps({**CAL, "unit": {"serial": "4711"}}))
    nobodys = workshop.write("nobodys.json", json.dumps(CAL))
    triaxcal("run", station, "--rezero", cal).failed(3, "no calibration to renew the biases of: right")
    triaxcal("run", station, "--rezero", nobodys).failed(3, "nobodys.json: is not of one unit")


@pytest.mark.parametrize(("value", "code"), [(2, 2), ("4", 2), (4.5, 2)])
def test_a_plan_of_fewer_than_three_is_bad_input(workshop: Any, triaxcal: Run, value: Any, code: int) -> None:
    station = workshop.station(unit(bus=NOBODY), plan={"rezero_poses": value})
    triaxcal("run", station).failed(code, "plan.rezero_poses")


def test_the_operator_is_asked_for_the_directions_that_determine_the_biases() -> None:
    targets = bias_directions(4)
    state = guide([], wanted=4, hold_s=1.0, apart_deg=10.0, now_s=0.0, nominal_scale_factor=(1, 1, 1), targets=targets)
    assert state.missing == tuple(label for label, _ in targets)
    assert state.text == f"next: {targets[0][0]} up"
