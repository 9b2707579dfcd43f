"""A restart shows by a value that it takes away; no other story of the registers passes an audit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal_drivers.errors import DeviceSilent
from triaxcald.audit.traffic import Traffic
from triaxcald.provision.access import RegisterAccess
from triaxcald.provision.identity import WrongUnit
from triaxcald.provision.image import build_image
from triaxcald.provision.proof import proven_restart
from triaxcald.provision.state import DeviceState, Evidence
from triaxcald.recording import schema


def marked(bench) -> tuple[int, RegisterAccess]:
    """The last write of a calibration register, which is the one that shows the restart."""
    names = bench.image.raw
    return [(i, a) for i, a in enumerate(bench.records) if a.kind == "write" and a.register in names][-1]


def forged(bench, records: list[RegisterAccess]) -> set[str]:
    return {d.place for d in bench.differences(bench.provisioning, records, aborted=False)}


async def test_a_restart_that_took_nothing_away_is_no_proof(bench) -> None:
    await bench.provision()
    at, mark = marked(bench)
    survives = [
        replace(a, raw=mark.raw) if i > at and a.kind == "read" and a.register == mark.register else a
        for i, a in enumerate(bench.records)
    ]
    assert {"device_state", "evidence"} <= forged(bench, survives)


async def test_a_wrong_value_at_the_end_is_not_taken_for_a_proof(bench) -> None:
    await bench.provision()
    _, mark = marked(bench)
    wrong = [replace(mark), replace(mark, kind="read")]
    assert "evidence" in forged(bench, [*bench.records, *wrong])


async def test_a_wrong_value_that_is_stored_is_not_asked_for(bench) -> None:
    await bench.provision()
    at, mark = marked(bench)
    store = next(a for a in bench.records if a.kind == "write" and a.register == "store")
    assert mark.register in forged(bench, [*bench.records[: at + 2], store, *bench.records[at + 2 :]])


async def test_a_calibration_that_is_new_by_one_bit_is_written_for_itself(bench) -> None:
    beside = float(np.nextafter(np.float32(bench.old_coefficients["bias.x"]), np.float32(1)))
    changed = {**bench.old_coefficients, "bias.x": beside}
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

    raw, beside = b"\x3f\x80\x00\x00", b"\x3f\x80\x00\x01"
    traffic = Traffic(
        [
            access("read", "bias_x", raw), step("unlock_key", 0x5A17), access("write", "bias_x", beside),
            step("unlock_key", 0x5A17), step("reset", 2), access("read", "bias_x", raw),
        ],
        profile,
    )  # fmt: skip
    assert traffic.marks == {2: True}


@pytest.mark.parametrize("struck", ["unlock_key", "scale_factor_x"])
async def test_a_proof_that_nobody_answers_prevents_no_restart(bench, struck: str) -> None:
    """What is in use afterwards is what is stored; that it restarted is not shown."""

    def deaf(operation: int, done: bool) -> None:
        if bench.device.log[-1] == ("write", struck) and done == (struck == "scale_factor_x"):
            raise DeviceSilent("no reply")

    bench.device.trouble = deaf
    assert await proven_restart(bench.link, bench.bundle, "0007", bench.image.raw) is False
    assert ("write", "reset") in bench.device.log
    bench.assert_holds(bench.old)


async def test_a_proof_is_given_to_no_other_unit(bench) -> None:
    with pytest.raises(WrongUnit):
        await proven_restart(bench.link, bench.bundle, "0008", bench.image.raw)
    assert bench.device.written == []
