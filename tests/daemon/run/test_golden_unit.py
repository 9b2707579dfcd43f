"""The golden unit of a station: it is verified, and nothing is fitted or written."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from tests.daemon.audit.forging import Forgery
from tests.virtual_line import described, virtual_line
from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.audit import audit
from triaxcald.audit.conduct import Result
from triaxcald.recording.reader import Recording
from triaxcald.run.attempts import Attempts, settle_killed
from triaxcald.schema.outcome import Outcome
from triaxcald.schema.run import Run
from triaxcald.station.config import load_station
from triaxcald.work import Attempt, Work

GOLDEN, OTHER = "4711", "4713"
PLAN = {"poses": 9, "hold_s": 1.0, "check_poses": 4}
LIMIT_G = 2e-4
EXACT = {"scale_factor": [-2.4, -2.4, -2.4], "misalignment": [0.0, 0.0, 0.0], "bias": [0.0, 0.0, 0.0]}
"""As the registers of a new unit have it: its own output is right."""
OFF = {**EXACT, "bias": [0.004, 0.0, 0.0]}
BUS = {"host": "127.0.0.1", "port": 502}


def calibration(folder: Path, sensor: dict[str, list[float]] = EXACT, name: str = "golden.json") -> Path:
    """A calibration document of this sensor, fitted to 26 poses without noise."""
    k, b = sensor["scale_factor"], sensor["bias"]
    means = [[k[i] * (up[i] + b[i]) for i in range(3)] for _, up in tc.planning.directions(26)]
    poses = tc.estimate.poses_of_means(np.array(means), 2.0 * np.arange(26), np.full((26, 3), 1e-5), {})
    path = folder / name
    tc.calibrate(poses, signs=(-1, -1, -1)).save(path)
    return path


@pytest.fixture
def bench(workshop: Any) -> Callable[..., Any]:
    """A station with one slot, on a virtual clock: its golden unit has this ``sensor``."""

    @contextmanager
    def made(sensor: dict[str, list[float]] = EXACT, profile: str = "triax-ref-modbus", **more: Any) -> Iterator[Path]:
        golden = workshop.device("golden.toml", bus=BUS, sensor=sensor, serial=int(GOLDEN))
        other = workshop.device("other.toml", bus=BUS, serial=int(OTHER), seed=4)
        rules = {"golden": {"serial": GOLDEN, "every_h": 8, "calibration": "golden.json"}, **more.pop("rules", {})}
        station = workshop.station(
            {"name": "a", "serial": OTHER, "bus": BUS, "profile": profile},
            **{"plan": PLAN, "limits": {"verification_rms_g": LIMIT_G}, "rules": rules, **more},
        )
        with virtual_line(described(golden), described(other)):
            yield station

    return made


def without_corrected(workshop: Any) -> str:
    """A profile of the same unit that does not ask for its own output."""
    text = (BUILT_IN / "triax-ref-modbus.toml").read_text()
    before, _, rest = text.partition("[streams.corrected]")
    _, _, after = rest.partition("# Sequences")
    name = "plain.toml"
    workshop.write(name, f'{before.rstrip()}\n\n[correction]\nreadings = "before"\n\n# Sequences{after}')
    return name


def test_it_is_verified_by_its_own_output_and_nothing_is_written(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    with bench() as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--json")
    assert done.code == 0, done.err
    unit = Run.model_validate(done.json).units[0]
    outcome = Outcome.model_validate(unit.outcome).document()
    assert (outcome["verdict"], outcome["code"], outcome["device_state"]) == ("pass", "within_limits", "untouched")
    assert (outcome["measured"], outcome["registers"], outcome["sha256"]) == (None, None, {})
    assert (outcome["work"]["serial"], outcome["work"]["attempt"], outcome["serial"]) == (GOLDEN, 1, GOLDEN)
    found = outcome["verification"]
    assert found["before_rms_g"] == found["after_rms_g"] < 1e-4
    assert len(found["poses"]) >= PLAN["check_poses"]
    assert {pose["from_fit_deg"] for pose in found["poses"]} == {180.0}
    assert "golden unit: the device's own output in" in outcome["reason"]
    assert (unit.certificate, unit.report) == (None, None)
    with Recording.open(Path(str(unit.recording))) as recording:
        assert list(recording.register_accesses()) == []
        assert recording.metadata["golden"] == {"stream": "corrected"}
        assert {phase for phase, _ in recording.raw_batches()} == {"verification"}
    assert audit(Path(str(unit.recording))).result is Result.SAME_BYTES


def test_its_stages_are_identity_and_check_poses(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    with bench(fixture={"together": True}) as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--events")
    assert done.code == 0, done.err
    events = [json.loads(line) for line in done.out.splitlines()]
    assert [e["stage"] for e in events if e["event"] == "stage"] == ["identity", "check_poses"]
    poses = [e for e in events if e["event"] == "poses"]
    assert {e["wanted"] for e in poses} == {PLAN["check_poses"]}
    assert any(e["event"] == "instruction" for e in events)


def test_an_output_outside_the_limit_fails(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    with bench(OFF) as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--json")
        again = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--json")
    assert (done.code, again.code) == (1, 1)
    outcome = done.json["units"][0]["outcome"]
    assert (outcome["verdict"], outcome["code"], outcome["device_state"]) == (
        "fail", "verification_outside", "untouched",
    )  # fmt: skip
    assert outcome["verification"]["after_rms_g"] == pytest.approx(0.004 / 3**0.5, rel=0.4)
    assert again.json["units"][0]["outcome"]["work"]["attempt"] == 2
    assert audit(Path(done.json["units"][0]["recording"])).result is Result.SAME_BYTES
    assert triaxcal("audit", done.json["units"][0]["recording"]).code == 0


@pytest.mark.parametrize(("sensor", "code"), [(OFF, 0), (EXACT, 1)])
def test_without_a_corrected_stream_its_readings_count_under_the_calibration(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any], sensor: dict[str, list[float]], code: int
) -> None:
    data = calibration(workshop.folder, OFF).read_bytes()
    with bench(sensor, without_corrected(workshop)) as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--json")
    assert done.code == code, done.err
    unit = done.json["units"][0]
    assert "the readings under golden.json" in unit["outcome"]["reason"]
    assert unit["outcome"]["device_state"] == "untouched"
    with Recording.open(Path(unit["recording"])) as recording:
        assert recording.attachments["golden.json"] == data
        assert recording.metadata["golden"] == {"stream": "readings", "calibration": "golden.json"}
        assert list(recording.register_accesses()) == []
    (workshop.folder / "golden.json").unlink()  # the recording has it
    assert audit(Path(unit["recording"])).result is Result.SAME_BYTES


FORGERIES: dict[str, Callable[[Forgery], object]] = {
    "error": lambda f: [
        f.edit(name, lambda d: (d.get("verification") or d).update(after_rms_g=1e-5, before_rms_g=1e-5))
        for name in ("verification.json", "outcome.json")
    ],
    "verdict": lambda f: f.edit("outcome.json", lambda d: d.update(verdict="fail", code="verification_outside")),
    "limit": lambda f: [
        f.edit(name, lambda d: (d.get("verification") or d).update(limit_rms_g=1.0))
        for name in ("verification.json", "outcome.json")
    ],
    "kind of run": lambda f: f.drop("golden"),
    "measured": lambda f: f.edit("outcome.json", lambda d: d.update(device_state="new_verified")),
    "no verification": lambda f: (
        f.drop("verification.json"), f.edit("outcome.json", lambda d: d.update(verification=None)),
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def verified(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a golden unit."""
    from tests.conftest import Workshop
    from triaxcald.cli.commands import main

    shop = Workshop(tmp_path_factory.mktemp("golden"))
    calibration(shop.folder)
    device = shop.device(bus=BUS, sensor=EXACT)
    station = shop.station(
        {"name": "a", "serial": GOLDEN, "bus": BUS}, plan=PLAN, limits={"verification_rms_g": LIMIT_G},
        rules={"golden": {"serial": GOLDEN, "every_h": 8, "calibration": "golden.json"}},
    )  # fmt: skip
    with virtual_line(described(device)):
        assert main(["run", str(station)]) == 0
    return next(shop.folder.glob("*.mcap"))


@pytest.mark.parametrize("forged", FORGERIES)
def test_an_audit_finds_a_forged_verification(
    verified: Path, tmp_path: Path, triaxcal: Callable[..., Any], forged: str
) -> None:
    forgery = Forgery.of(verified)
    forgery.seal()
    same = forgery.write(tmp_path / "same.mcap")
    assert triaxcal("audit", same).code == 0
    FORGERIES[forged](forgery)
    forgery.seal()
    assert triaxcal("audit", forgery.write(tmp_path / "forged.mcap")).code == 1


def test_poses_on_demand_are_for_calibrations_alone(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    stop = {"uncertainty_g": 1e-6, "poses_least": 9, "poses_most": 20}
    plan = {key: value for key, value in PLAN.items() if key != "poses"} | {"stop": stop}
    with bench(EXACT, without_corrected(workshop), plan=plan) as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--events")
    assert done.code == 0, done.err
    poses = [e for line in done.out.splitlines() if (e := json.loads(line))["event"] == "poses"]
    assert {e["wanted"] for e in poses} == {PLAN["check_poses"]}
    assert triaxcal("audit", next(workshop.folder.glob("*.mcap"))).code == 0


def test_the_rules_for_products_do_not_hold_for_it(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    rules = {"serial": "9[0-9]{3}", "attempts": 1, "retest_reason": True}
    with bench(rules=rules) as station:
        for _ in range(2):
            assert triaxcal("run", station, "--serial", f"a={GOLDEN}").code == 0
        triaxcal("run", station).failed(2, "rules.serial")


def test_it_keeps_its_biases(bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]) -> None:
    file = calibration(workshop.folder)
    with bench() as station:
        triaxcal("run", station, "--serial", f"a={GOLDEN}", "--rezero", file).failed(2, "golden unit", "--rezero")


def test_a_calibration_that_is_none_is_refused_at_the_start(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    with bench() as station:
        where = "rules.golden.calibration"
        triaxcal("run", station).failed(2, where, "golden.json", "No such file")
        workshop.write("golden.json", "{}")
        triaxcal("run", station).failed(2, where, "golden.json")
        triaxcal("serve", station).failed(2, where, "golden.json")
        file = calibration(workshop.folder)
        document = json.loads(file.read_text())
        file.write_text(json.dumps({**document, "unit": {"serial": "1"}}))
        triaxcal("run", station).failed(2, where, "is of the unit with serial 1, not of 4711")
    assert not list(workshop.folder.glob("*.mcap"))


def test_a_golden_unit_that_is_not_held_still_is_no_verification(
    bench: Callable[..., Any], workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    with bench(plan={**PLAN, "hold_s": 30.0, "patience_s": 20.0}) as station:
        done = triaxcal("run", station, "--serial", f"a={GOLDEN}", "--json")
    assert done.code == 3
    outcome = done.json["units"][0]["outcome"]
    assert (outcome["code"], outcome["verification"], outcome["device_state"]) == ("no_poses", None, "untouched")
    assert triaxcal("audit", done.json["units"][0]["recording"]).code == 0


@pytest.mark.parametrize("share", [0.3, 0.9])
def test_a_golden_run_that_was_killed_is_audited(
    verified: Path, tmp_path: Path, triaxcal: Callable[..., Any], share: float
) -> None:
    """Its recording is cut off, as a killed process leaves it."""
    with Recording.open(verified) as recording:
        told, work = recording.metadata["run"], Work.recorded(recording.metadata["work"])
        (tmp_path / "station.toml").write_bytes(recording.attachments["station.toml"])
    tray = Attempts(tmp_path, "0193f0e4-0000-7000-8000-00000000000f", "bench", {"verification_rms_g": LIMIT_G})
    (tmp_path / "running").mkdir()
    file = tray.begin(Attempt(told["run"], told["started"], work, verified.name))
    file.serial = GOLDEN  # which the unit had told
    file.write()
    whole = verified.read_bytes()
    (tmp_path / verified.name).write_bytes(whole[: round(share * len(whole))])
    (killed,) = settle_killed(load_station(tmp_path / "station.toml"))
    assert (killed.document["code"], killed.document["verification"]) == ("killed", None)
    assert triaxcal("audit", tmp_path / verified.name).code == 0


@pytest.mark.slow
def test_beside_other_units_on_one_fixture_it_is_verified_while_they_are_calibrated(
    workshop: Any, triaxcal: Callable[..., Any]
) -> None:
    calibration(workshop.folder)
    buses = {slot: {"host": "127.0.0.1", "port": port} for slot, port in (("a", 502), ("b", 503))}
    devices = [
        described(workshop.device(f"{serial}.toml", bus=BUS, sensor=EXACT, serial=serial, seed=serial))
        for serial in (4711, 4713)
    ]
    station = workshop.station(
        {"name": "a", "serial": GOLDEN, "bus": buses["a"]}, {"name": "b", "serial": OTHER, "bus": buses["b"]},
        plan={**PLAN, "poses": 14}, limits={"verification_rms_g": LIMIT_G}, fixture={"together": True},
        rules={"golden": {"serial": GOLDEN, "every_h": 8, "calibration": "golden.json"}},
    )  # fmt: skip
    with virtual_line(*devices):
        done = triaxcal("run", station, "--json")
    assert done.code == 0, done.err
    golden, other = (unit["outcome"] for unit in done.json["units"])
    assert (golden["device_state"], golden["measured"]) == ("untouched", None)
    assert other["device_state"] == "new_verified"
    assert [golden["code"], other["code"]] == ["within_limits"] * 2
