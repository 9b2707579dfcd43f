"""What the recordings beside certificates tell of a fleet: steps of converters, and mountings."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from tests.daemon.fleet.worlds import line, write
from triaxcald.cli.commands import main
from triaxcald.fleet.recorded import Recorded, recorded_in, step_of
from triaxcald.mounting import rotation
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import CALIBRATION
from triaxcald.recording.writer import RecordingWriter

GOLDEN = Path(__file__).parents[3] / "recordings"
STEP_V = 10 / 2**23
"""Of the reference unit: 24 bits, ±10 V."""


def readings(rng: Generator, noise: float) -> np.ndarray:
    """(600,3) of six poses in steps of gravity, 10,000 codes a g."""
    means = rng.normal(0, 7000, (6, 3)) + rng.uniform(-300, 300, 3)
    return np.repeat(means, 100, axis=0) + rng.normal(0, noise, (600, 3))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("factor", [1.0, 10 / 2**23, 0.000244, 3.9e-3])
@pytest.mark.parametrize("codes", [1, 4, 16])
def test_step_of_a_converter(seed: int, factor: float, codes: int) -> None:
    """Also where the low bits are always zero, as of values that fill a word from the left."""
    whole = np.rint(readings(np.random.default_rng(seed), 3.0 * codes) / codes) * codes
    assert step_of(whole * factor) == pytest.approx(codes * factor, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("offset", [0.0, 2.5, 12.0])  # around the last two, single precision has one spacing
def test_floating_point_outputs_have_no_step(seed: int, kind: type[np.floating[Any]], offset: float) -> None:
    values = readings(np.random.default_rng(seed), 3.0) / 4e4 + offset
    assert step_of(values.astype(kind).astype(float)) is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("factor", [10 / 2**16, 9.80665 / 16384])
def test_step_of_a_converter_behind_single_precision(seed: int, factor: float) -> None:
    whole = np.rint(readings(np.random.default_rng(seed), 3.0)) + 32768
    assert step_of((whole * factor).astype(np.float32).astype(float)) == pytest.approx(factor, rel=1e-5)


def test_rubbish_has_no_step() -> None:
    values = np.random.default_rng(1).uniform(-1, 1, (600, 3)) * np.logspace(-320, 99, 600)[:, None]
    assert step_of(values) is None


def test_few_codes_have_no_step() -> None:
    assert step_of(np.tile([[0.0, 5.0, 10.0], [5.0, 5.0, 15.0]], (300, 1))) is None


@pytest.mark.parametrize("name", ["can-second-order", "modbus-temperature-bias"])
def test_recording_of_a_station_tells_the_step_and_the_mounting(name: str) -> None:
    found = recorded_in(GOLDEN / f"{name}.mcap", None)
    assert found.resolution == pytest.approx(STEP_V, rel=1e-9)
    assert found.mounting is not None
    np.testing.assert_array_equal(found.mounting, np.eye(3))


def mounted(path: Path, mounting: str) -> Path:
    """The recording on CAN, of a station whose file has ``mounting``."""
    with Recording.open(GOLDEN / "can-second-order.mcap") as golden:
        writer = RecordingWriter(path, metadata={k: golden.metadata[k] for k in ("station", "unit", "run", "work")})
        for name, data in golden.attachments.items():
            line = f'\nmounting = "{mounting}"\n'.encode()
            writer.attach(name, "text/plain", data + line if name == "station.toml" else data)
        for batch in golden.raw(CALIBRATION):
            writer.raw(CALIBRATION, batch)
        writer.close()
    return path


def test_mounting_turns_the_axes_of_the_unit_to_those_of_the_fixture(tmp_path: Path) -> None:
    found = recorded_in(mounted(tmp_path / "a.mcap", "-y+x+z"), "another slot").mounting
    assert found is not None
    np.testing.assert_array_equal(found @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(found @ [0, 1, 0], [1, 0, 0])


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "changed"])
def test_recording_that_cannot_be_read_tells_nothing(tmp_path: Path, damage: str) -> None:
    data, path = (GOLDEN / "can-second-order.mcap").read_bytes(), tmp_path / "a.mcap"
    if damage != "missing":
        path.write_bytes({"empty": b"", "cut": data[:5000], "changed": data[:5000] + b"x" + data[5001:]}[damage])
    found = recorded_in(path, None)
    assert (found.mounting, found.resolution) == (Recorded().mounting, Recorded().resolution) == (None, None)


# Fleets. Each certificate is the golden one with poses of another unit.

ALIGNED, TURNED = "+x+y+z", "-y+x+z"
Poses = list[dict[str, Any]]


def fleet_of(folder: Path, in_slot_b: str, poses_of: Callable[[dict[str, Any], Poses, Generator], None]) -> Path:
    """80 units of three batches, on three fixtures; slot b has its own mounting. ``poses_of`` changes the poses of a
    document."""
    rng = np.random.default_rng(5)
    with Recording.open(GOLDEN / "can-second-order.mcap") as recording:
        paper = json.loads(recording.attachments["certificate.json"])
    documents, papers = line(units=80, repeated=0, shift=0.0), []
    for i, document in enumerate(documents):
        document["recording"] = f"{document['serial']}.mcap"
        document["work"]["batch"] = f"B{1 + i // 2 % 3}"
        papers.append(copy.deepcopy(paper))
        poses_of(document, papers[-1]["result"]["calibration"]["poses"], rng)
    write(folder, documents, papers)
    golden = folder / "golden.mcap"
    shutil.copy(GOLDEN / "can-second-order.mcap", golden)
    turned = mounted(folder / "turned.mcap", in_slot_b)
    for document in documents:
        (folder / document["recording"]).hardlink_to(turned if document["unit"] == "b" else golden)
    turned.unlink()
    golden.unlink()
    return folder


def wrong_bit(document: dict[str, Any], poses: Poses, rng: Generator) -> None:
    """Converters of batch B2 have a wrong bit on y."""
    scale, shift = 1 + rng.normal(0, 2e-3, 3), rng.normal(0, 3e-2, 3)
    for pose in poses:
        pose["mean"] = [float(v) for v in np.array(pose["mean"]) * scale + shift]
        wrong = 8e-5 * np.sign(np.sin(2 * np.pi * pose["mean"][1] / (STEP_V * 2**15)))
        wave = wrong * pose["direction"][1] if document["work"]["batch"] == "B2" else 0.0
        pose["residual_g"] = pose["before_residual_g"] = float(rng.normal(0, pose["standard_error_g"]) + wave)


def tilt(document: dict[str, Any], poses: Poses, rng: Generator) -> None:
    """Fixture F2 is bent about its x axis. An operator holds each pose to half a degree."""
    mounting = rotation(TURNED) if document["unit"] == "b" else np.eye(3)
    bent = Rotation.from_euler("x", 0.02 if document["work"]["fixture"] == "F2" else 0.0).as_matrix()
    for pose in poses:
        held = Rotation.from_rotvec(rng.normal(0, 0.008, 3)).as_matrix() @ bent
        pose["direction"] = [float(v) for v in mounting.T @ held @ mounting @ pose["direction"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "in_slot_b", "kind", "place", "figure"),
    [
        (wrong_bit, ALIGNED, "batch", "B2", "goes with the reading"),
        (tilt, TURNED, "fixture", "F2", "rotation.x"),
    ],
)
def test_effect_of_a_place_that_recordings_make_visible(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], effect: Any, in_slot_b: str, kind: str, place: str, figure: str
) -> None:
    folder = fleet_of(tmp_path / "runs", in_slot_b, effect)
    assert main(["fleet", str(folder), "--json"]) == 0
    (product,) = json.loads(capsys.readouterr().out)["products"]
    found = product["places"][0]
    assert (found["kind"], found["place"], found["verdict"]) == (kind, place, "named")
    assert figure in found["figure"]
    assert {of["place"] for of in product["places"]} == {place}  # one effect may leave a second pattern there


def bent(pose: dict[str, Any], mounting: np.ndarray, rng: Generator, fixture: float, unit: float) -> None:
    """A pose in a fixture bent about its x axis, of a sensor tilted in its housing about its own x axis."""
    held = Rotation.from_rotvec(rng.normal(0, 0.002, 3)) * Rotation.from_euler("x", fixture)
    own = Rotation.from_euler("x", unit).as_matrix()
    pose["direction"] = [float(v) for v in own @ mounting.T @ held.as_matrix() @ mounting @ pose["direction"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fixture", "unit", "lost"), [(0.02, 0.02, ""), (0.02, 0.0, "first half"), (0.0, 0.02, "line1")]
)
def test_what_all_units_and_fixtures_share_is_no_effect_of_a_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], fixture: float, unit: float, lost: str
) -> None:
    """Also where a part of the recordings is lost: the mounting of these runs is not known."""

    def poses_of(document: dict[str, Any], poses: Poses, rng: Generator) -> None:
        mounting = rotation(TURNED) if document["unit"] == "b" else np.eye(3)
        for pose in poses:
            bent(pose, mounting, rng, fixture, unit)

    folder = fleet_of(tmp_path / "runs", TURNED, poses_of)
    paths = sorted(folder.glob("*.mcap"))
    for i, path in enumerate(paths):
        if (lost == "first half" and i < 40) or (lost == "line1" and i % 2 == 0):
            path.unlink()
    assert main(["fleet", str(folder), "--json"]) == 0
    (product,) = json.loads(capsys.readouterr().out)["products"]
    assert [place["text"] for place in product["places"]] == []
