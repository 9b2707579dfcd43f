import pytest

from triaxcald.provision.registers import Snapshot, explain, take_snapshot


@pytest.mark.parametrize("little_endian", [False, True])
async def test_a_sound_calibration_is_explained_row_by_row(make_bench, little_endian: bool) -> None:
    bench = make_bench(little_endian=little_endian)
    rows = {r.register: r for r in explain(bench.bundle, await take_snapshot(bench.device, bench.bundle))}
    assert len(rows) == 21
    scale = rows["scale_factor_x"]
    assert scale.role == "scale_factor.x"
    assert scale.raw_hex == ("9a9919c0" if little_endian else "c019999a")
    assert scale.value == pytest.approx(-2.4)
    assert all(r.within_limits for r in rows.values())
    assert rows["calibration_crc"].crc_ok is True
    assert scale.crc_ok is None


async def test_a_checksum_that_does_not_match_is_shown(bench) -> None:
    held = await take_snapshot(bench.device, bench.bundle)
    rows = explain(bench.bundle, Snapshot({**held.raw, "bias_x": bytes.fromhex("3dcccccd")}))
    assert rows[-1].register == "calibration_crc"
    assert rows[-1].crc_ok is False


async def test_a_value_outside_its_limits_is_shown_and_its_checksum_still_judged(bench) -> None:
    bench.put_in_ram("bias_x", 0.6)
    rows = {r.register: r for r in explain(bench.bundle, await take_snapshot(bench.device, bench.bundle))}
    assert not rows["bias_x"].within_limits
    assert rows["bias_y"].within_limits
    assert rows["calibration_crc"].crc_ok is True


async def test_a_register_that_holds_no_number_is_outside_its_limits_and_spoils_the_checksum(bench) -> None:
    held = await take_snapshot(bench.device, bench.bundle)
    rows = {r.register: r for r in explain(bench.bundle, Snapshot({**held.raw, "bias_x": b"\xff" * 4}))}
    assert not rows["bias_x"].within_limits
    assert rows["calibration_crc"].crc_ok is False
