"""A restart shows by a value that it takes away; no other story of the registers passes an audit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal_drivers.errors import DeviceSilent
from triaxcald.audit.traffic import Traffic
from triaxcald.provision.access import RegisterAccess, SequenceStalled
from triaxcald.provision.identity import WrongUnit
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import build_image
from triaxcald.provision.restart_check import Restart, checked_restart, may_probe
from triaxcald.provision.state import DeviceState, Evidence
from triaxcald.recording import schema
from triaxcald.simulation.unit import Faults

NOT_SHOWN = Restart(acknowledged=True, probe_gone=False)


def probed(bench) -> tuple[int, RegisterAccess]:
    """The last write of a calibration register, which is the one that shows the restart."""
    names = bench.image.raw
    return [(i, a) for i, a in enumerate(bench.records) if a.kind == "write" and a.register in names][-1]


def forged(bench, records: list[RegisterAccess]) -> set[str]:
    return {d.place for d in bench.differences(bench.provisioning, records, aborted=False)}


async def test_a_restart_that_took_nothing_away_is_no_proof(bench) -> None:
    await bench.provision()
    at, probe = probed(bench)
    survives = [
        replace(a, raw=probe.raw) if i > at and a.kind == "read" and a.register == probe.register else a
        for i, a in enumerate(bench.records)
    ]
    assert {"device_state", "evidence"} <= forged(bench, survives)


async def test_a_wrong_value_at_the_end_is_not_taken_for_a_proof(bench) -> None:
    await bench.provision()
    _, probe = probed(bench)
    wrong = [replace(probe), replace(probe, kind="read")]
    assert "evidence" in forged(bench, [*bench.records, *wrong])


async def test_a_wrong_value_that_is_stored_is_not_asked_for(bench) -> None:
    await bench.provision()
    at, probe = probed(bench)
    store = next(a for a in bench.records if a.kind == "write" and a.register == "store")
    assert probe.register in forged(bench, [*bench.records[: at + 2], store, *bench.records[at + 2 :]])


async def test_a_calibration_that_is_new_by_one_bit_is_written_for_itself(bench) -> None:
    neighbouring_values = float(np.nextafter(np.float32(bench.old_coefficients["bias.x"]), np.float32(1)))
    changed = {**bench.old_coefficients, "bias.x": neighbouring_values}
    bench.image = build_image(bench.profile, changed, date_days=bench.old_date_days)
    report = await bench.provision()  # judged by the rules of an audit, too
    assert report.written == ["bias_x", "calibration_crc"]
    assert (report.held.state, report.held.evidence) == (DeviceState.NEW_VERIFIED, Evidence.RESTART)


def test_a_key_that_store_and_restart_share_is_no_store(bench) -> None:
    key = {"write": "unlock_key", "value": 0x5A17}
    shared = {
        "unlock": (key,),
        "store": (key, {"write": "store", "value": 1}),
        "reset": (key, {"write": "reset", "value": 2}),
    }
    sequences = type(bench.profile.sequences).model_validate(shared)
    profile = bench.profile.model_copy(update={"sequences": sequences})

    def access(kind: schema.Operation, register: str, raw: bytes) -> schema.RegisterAccess:
        return schema.RegisterAccess(0, register, kind, raw)

    def step(register: str, value: int) -> schema.RegisterAccess:
        return access("write", register, profile.encode(register, value))

    raw, neighbouring_values = b"\x3c\x00\x00\x00", b"\x3c\x00\x00\x01"
    traffic = Traffic(
        [
            access("read", "bias_x", raw), step("unlock_key", 0x5A17), access("write", "bias_x", neighbouring_values),
            step("unlock_key", 0x5A17), step("reset", 2), access("read", "bias_x", raw),
        ],
        profile,
        [("bias_x", raw)],
    )  # fmt: skip
    (probe,) = traffic.marks.marks
    assert (probe.at, probe.over, probe.gone_at) == ([2], True, 5)


@pytest.mark.parametrize("struck", ["unlock_key", "scale_factor_x"])
async def test_a_proof_that_nobody_answers_prevents_no_restart(bench, struck: str) -> None:
    """What is in use afterwards is what is stored; that it restarted is not shown."""

    def deaf(operation: int, done: bool) -> None:
        if bench.device.log[-1] == ("write", struck) and done == (struck == "scale_factor_x"):
            raise DeviceSilent("no reply")

    bench.device.trouble = deaf
    assert await checked_restart(bench.link, bench.bundle, "0007", bench.image.raw) == NOT_SHOWN
    assert ("write", "reset") in bench.device.log
    bench.assert_holds(bench.old)


async def test_a_proof_is_given_to_no_other_unit(bench) -> None:
    with pytest.raises(WrongUnit):
        await checked_restart(bench.link, bench.bundle, "0008", bench.image.raw)
    assert bench.device.written == []


async def test_an_undoing_after_a_proof_passes_an_audit(bench) -> None:
    """The register that shows the restart is the same in old and new, and the store of the undoing follows."""
    changed = {**bench.old_coefficients, "bias.x": 0.125}
    bench.image = build_image(bench.profile, changed, date_days=bench.old_date_days)
    report = await bench.provision()
    await report.undo()
    assert report.held.state is DeviceState.OLD
    assert bench.differences(report, bench.records, aborted=True) == []
    bench.assert_holds(bench.old)


async def test_a_proof_before_the_first_reading_passes_an_audit(bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process was killed between write and store; the restart that the journal asks for has to show."""

    class Killed(BaseException): ...

    async def nothing(self: Provisioning) -> None: ...

    def kill(operation: int, done: bool) -> None:
        if bench.device.log[-1] == ("write", "store") and not done:
            raise Killed

    bench.device.trouble = kill
    with monkeypatch.context() as gone:
        gone.setattr(Provisioning, "_give_up", nothing)
        gone.setattr(Provisioning, "finish", lambda self: None)
        gone.setattr(type(bench), "assert_traffic_shows", lambda *_, **__: None)
        with pytest.raises(Killed):
            await bench.provision()
    bench.device.trouble = lambda operation, done: None
    bench.link = bench.connected()
    report = await bench.provision()
    assert report.held.state is DeviceState.NEW_VERIFIED
    bench.assert_holds(bench.new)


async def test_a_value_does_not_stay_in_use_where_the_restart_stalls(bench) -> None:
    def ignored(operation: int, done: bool) -> None:
        if bench.device.log[-1] == ("write", "reset") and not done:
            raise SequenceStalled("it is not back")

    bench.device.trouble = ignored
    with pytest.raises(SequenceStalled):
        await checked_restart(bench.link, bench.bundle, "0007", bench.image.raw)
    bench.assert_holds(bench.old)


async def test_a_value_that_is_acknowledged_and_not_kept_shows_nothing(make_bench) -> None:
    """As of a device that is locked, and ignores writes and restarts in silence."""
    bench = make_bench(faults=Faults(corrupt_write={"scale_factor_x": 0x01}))
    assert await checked_restart(bench.link, bench.bundle, "0007", bench.image.raw) == NOT_SHOWN
    assert ("write", "reset") in bench.device.log


def test_nothing_is_marked_where_another_sequence_stores(bench) -> None:
    assert may_probe(bench.profile)
    store = {"write": "store", "value": 0x65766173}
    for other in ("lock", "reset"):
        sequences = bench.profile.sequences.model_dump()
        sequences[other] = (store, *sequences[other])
        update = {"sequences": type(bench.profile.sequences).model_validate(sequences)}
        assert not may_probe(bench.profile.model_copy(update=update))
