"""Two units that send at one place: their samples are nobody's, and the command says so."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import pytest

from triaxcal_drivers.profile import READINGS
from triaxcald.audit import audit
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording

Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def _streams_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the second unit answered no request: then nothing but the streams tells that there are two."""

    async def one_answer(*_: Any) -> None: ...

    monkeypatch.setattr("triaxcald.provision.identity.require_alone", one_answer)


def two_at_one_node(workshop: Any, stack: ExitStack, channel: str, *, speed: float = 1.0) -> list[Any]:
    """Of one serial number, so that their streams alone tell them apart; the second one began later."""
    bus = {"interface": "virtual", "channel": channel, "node_id": 5}
    made = []
    for i in range(2):
        path = workshop.device(
            f"same{i}.toml", profile="triax-ref-can", serial=777, speed=speed, seed=5 + i, bus=bus,
            fixture={"poses": 12, "hold_s": 1.4 + i, "move_s": 0.6},
        )  # fmt: skip
        made.append(stack.enter_context(workshop.serve(path)))
    return made


@pytest.mark.slow
def test_the_recording_of_two_units_at_one_node_ends_and_the_other_unit_is_recorded(
    workshop: Any, triaxcal: Run, request: pytest.FixtureRequest
) -> None:
    out = workshop.folder / "out"
    out.mkdir()
    with ExitStack() as stack:
        mixed = two_at_one_node(workshop, stack, request.node.name)
        alone = stack.enter_context(workshop.serve(workshop.device("alone.toml", serial=888, speed=1.0)))
        station = workshop.station(
            {"bus": mixed[0].bus, "profile": "triax-ref-can"}, {"bus": alone.bus, "profile": "triax-ref-modbus"}
        )
        done = triaxcal("record", station, "-o", out, "--seconds", "12")
    assert done.code == 4
    assert "two units answer at" in done.err
    (path,) = out.glob("unit0-*.mcap")
    with Recording.open(path) as recording:
        ended = [e.detail for e in recording.events() if e.kind == "ended"]
        pipeline = Pipeline(bundle_of(recording), READINGS)
        pipeline.feed_all(recording.raw(CALIBRATION))
    assert ended == [{"reason": "unit gave up"}]
    assert any(line.startswith("two_senders: ") for line in pipeline.data_quality())
    (path,) = out.glob("unit1-*.mcap")
    with Recording.open(path) as recording:
        other = Pipeline(bundle_of(recording), READINGS)
        other.feed_all(recording.raw(CALIBRATION))
    assert other.seconds >= 12.0
    assert not other.two_senders


@pytest.mark.slow
def test_the_run_of_two_units_at_one_node_is_aborted_and_nothing_is_written(
    workshop: Any, triaxcal: Run, request: pytest.FixtureRequest
) -> None:
    with ExitStack() as stack:
        mixed = two_at_one_node(workshop, stack, request.node.name, speed=4.0)
        before = [unit.unit.eeprom for unit in mixed]
        plan = {"poses": 12, "hold_s": 0.6, "check_poses": 2, "comes_back_s": 0.5}
        station = workshop.station({"bus": mixed[0].bus, "profile": "triax-ref-can"}, plan=plan)
        done = triaxcal("run", station)
    assert (done.code, [unit.unit.eeprom for unit in mixed]) == (4, before)
    assert "two units answer at" in done.err
    (path,) = workshop.folder.glob("*.mcap")
    assert audit(path).differences == ()
