import struct

import numpy as np
import pytest

from triaxcald.simulation.unit import (
    CALIBRATION,
    COVERED,
    INVALID_CORRECTED,
    TABLE,
    ConstantPhysics,
    Faults,
    ReferenceUnit,
    RegisterFault,
    Status,
    UnitSilent,
)

# raw bytes of the factory calibration, by hand: -2.4 three times, 15 zeros, 25.0, date 0
FACTORY = bytes.fromhex("c019999a" * 3 + "00000000" * 15 + "41c80000" + "00000000")


def unit(volts: tuple[float, float, float] = (0.0, 0.0, -2.4), temperature_c: float = 25.0, **more) -> ReferenceUnit:
    return ReferenceUnit(ConstantPhysics(volts, temperature_c), serial_number=7, **more)


def unlocked(**more) -> ReferenceUnit:
    made = unit(**more)
    made.write("unlock_key", bytes.fromhex("5a17"), 0.0)
    return made


def put(made: ReferenceUnit, name: str, value: float, at_s: float = 0.0) -> None:
    made.write(name, struct.pack(">f", value), at_s)


def modbus_crc(data: bytes) -> bytes:
    """The published table-less form of CRC-16/MODBUS, most significant byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "big")


def seal(made: ReferenceUnit, at_s: float = 0.0) -> None:
    made.write("calibration_crc", modbus_crc(b"".join(made.read(n, at_s) for n in COVERED)), at_s)


def status(made: ReferenceUnit, at_s: float) -> Status:
    return Status(int.from_bytes(made.read("status", at_s), "big"))


def test_samples_are_taken_at_the_start_and_then_every_period_whatever_the_calls() -> None:
    whole = unit(lower_time_s=10.0).advance(11.0)
    parted = unit(lower_time_s=10.0)
    parts = [parted.advance(t) for t in (10.0, 10.004, 10.3, 10.3, 11.0)]
    assert len(whole) == 101
    assert whole.counter.tolist() == list(range(101))
    assert np.allclose(whole.unit_time_s, 10 + np.arange(101) / 100)
    assert np.concatenate([p.counter for p in parts]).tolist() == whole.counter.tolist()


def test_the_counter_wraps_at_sixteen_bits() -> None:
    made = unit(rate_hz=1000.0)
    made.advance(65.534)
    assert made.advance(65.537).counter.tolist() == [65535, 0, 1]


def test_the_converter_rounds_to_24_bits_of_ten_volts() -> None:
    run = unit(volts=(1.0, -1.0, 5.0), temperature_c=-12.345).advance(0.0)
    assert run.counts.tolist() == [[838861, -838861, 4194304]]
    assert run.temperature_raw.tolist() == [-1234]
    assert run.status.tolist() == [0]


def test_beyond_full_scale_it_saturates_and_says_so() -> None:
    made = unit(volts=(10.0, -10.5, 0.0))
    run = made.advance(0.0)
    assert run.counts.tolist() == [[8388607, -8388608, 0]]
    assert run.status.tolist() == [4]
    assert status(made, 0.0) == Status.OVER_RANGE


def test_minus_full_scale_itself_is_within_range() -> None:
    run = unit(volts=(-10.0, 0.0, 0.0)).advance(0.0)
    assert run.counts.tolist() == [[-8388608, 0, 0]]
    assert run.status.tolist() == [0]


def test_from_the_factory_it_reads_with_the_nominal_scale_factor_and_a_valid_checksum() -> None:
    made = unit()
    assert b"".join(made.read(n, 0.0) for n in COVERED) == FACTORY
    assert made.read("calibration_crc", 0.0) == modbus_crc(FACTORY)
    assert made.read("write_counter", 0.0) == bytes(4)
    assert made.read("serial_number", 0.0) == bytes.fromhex("00000007")
    assert made.read("vendor_id", 0.0) == b"TRIA"
    assert status(made, 0.0) == 0
    assert made.advance(0.0).corrected.tolist() == [[0, 0, 1000000]]


def test_the_corrected_output_undoes_the_sensor_model() -> None:
    # The forward model, in the unit's convention: s = R a, v = s(1 + kT dT) + n s², u = k(v + b + bT dT).
    a = np.array([0.3, -0.5, 0.8])
    ax, ay, az = 0.002, -0.003, 0.004
    scale = np.array([-2.41, -2.39, 2.4])
    bias = np.array([0.01, -0.02, 0.03])
    second = np.array([1e-3, -2e-3, 5e-4])
    bias_T = np.array([1e-4, -2e-4, 3e-4])
    scale_T = np.array([1e-4, 2e-4, -1e-4])
    dT = 40.0 - 22.0
    s = np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]]) @ a
    u = scale * (s * (1 + scale_T * dT) + second * s**2 + bias + bias_T * dT)
    made = unlocked(volts=tuple(u), temperature_c=40.0)
    columns = {"scale_factor": scale, "misalignment": (ax, ay, az), "bias": bias, "second_order": second,
               "temperature_bias": bias_T, "temperature_scale_factor": scale_T}  # fmt: skip
    for name, values in columns.items():
        for axis, value in zip("xyz", values, strict=True):
            put(made, f"{name}_{axis}", value)
    put(made, "reference_temperature", 22.0)
    corrected = made.advance(0.0).corrected[0] * 1e-6
    assert np.abs(corrected - a).max() < 3e-6  # 1 µg of resolution, 0.5 µg of the converter


def test_a_write_acts_on_the_corrected_output_at_once_and_on_the_readings_never() -> None:
    made = unlocked()
    before = made.advance(0.0)
    put(made, "bias_z", 0.25)
    after = made.advance(0.01)
    assert after.counts.tolist() == before.counts.tolist()
    assert after.corrected.tolist() == [[0, 0, 750000]]


@pytest.mark.parametrize("scale", [0.0, 1e-38])
def test_a_nonsensical_scale_factor_gives_a_limited_output_and_no_error(scale: float) -> None:
    made = unlocked(volts=(1.0, -1.0, 0.0))
    put(made, "scale_factor_x", scale)
    put(made, "scale_factor_y", scale)
    x, y, _ = made.advance(0.0).corrected[0].tolist()
    assert abs(x) == abs(y) == 2**31 - 1


@pytest.mark.parametrize("name", CALIBRATION)
def test_a_locked_unit_refuses_every_calibration_register(name: str) -> None:
    made = unit()
    with pytest.raises(RegisterFault) as caught:
        made.write(name, bytes(TABLE[name].size), 0.0)
    assert (caught.value.kind, caught.value.register) == ("locked", name)


@pytest.mark.parametrize(
    ("name", "raw", "kind"),
    [
        ("bias_x", "7fc00000", "bad_value"),
        ("bias_x", "7f800000", "bad_value"),
        ("bias_x", "0000", "bad_value"),
        ("unlock_key", "5a18", "bad_value"),
        ("store", "73617665", "bad_value"),
        ("reset", "0001", "bad_value"),
        ("serial_number", "00000001", "read_only"),
        ("stored_bias_x", "00000000", "read_only"),
        ("bias_w", "00000000", "unknown"),
    ],
)
def test_wrong_writes_are_refused_for_their_own_reason(name: str, raw: str, kind: str) -> None:
    made = unlocked()
    with pytest.raises(RegisterFault) as caught:
        made.write(name, bytes.fromhex(raw), 0.0)
    assert caught.value.kind == kind
    assert made.read("bias_x", 0.0) == bytes(4)


@pytest.mark.parametrize(("name", "kind"), [("unlock_key", "write_only"), ("bias_w", "unknown")])
def test_wrong_reads_are_refused(name: str, kind: str) -> None:
    with pytest.raises(RegisterFault) as caught:
        unit().read(name, 0.0)
    assert caught.value.kind == kind


def test_locking_again_refuses_writes_again() -> None:
    made = unlocked()
    assert status(made, 0.0) == Status.UNLOCKED
    made.write("unlock_key", bytes(2), 0.0)
    with pytest.raises(RegisterFault, match="locked"):
        put(made, "bias_x", 0.1)


def test_store_takes_50_ms_and_then_counts() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    seal(made)
    assert status(made, 0.0) == Status.UNLOCKED | Status.NOT_STORED
    made.write("store", b"evas", 1.0)
    assert status(made, 1.049) == Status.UNLOCKED | Status.NOT_STORED | Status.BUSY
    assert made.read("stored_bias_x", 1.049) == bytes(4)
    assert status(made, 1.05) == Status.UNLOCKED
    assert made.read("stored_bias_x", 1.05) == bytes.fromhex("3f000000")
    assert made.read("write_counter", 1.05) == bytes.fromhex("00000001")


def test_store_refuses_a_calibration_whose_checksum_does_not_match() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    with pytest.raises(RegisterFault, match="bad_value"):
        made.write("store", b"evas", 0.0)
    assert made.eeprom == unit().eeprom


def test_store_refuses_a_locked_unit_and_a_second_store_while_busy() -> None:
    with pytest.raises(RegisterFault, match="locked"):
        unit().write("store", b"evas", 0.0)
    made = unlocked()
    made.write("store", b"evas", 0.0)
    with pytest.raises(RegisterFault, match="locked"):
        made.write("store", b"evas", 0.01)


def test_a_write_while_busy_is_not_stored() -> None:
    made = unlocked()
    made.write("store", b"evas", 0.0)
    put(made, "bias_x", 0.5, 0.01)
    assert made.read("stored_bias_x", 0.1) == bytes(4)
    assert Status.NOT_STORED in status(made, 0.1)


def test_a_power_cut_while_storing_leaves_the_old_copy_whole() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    seal(made)
    made.write("store", b"evas", 0.0)
    made.power_cycle(0.049)
    assert made.read("bias_x", 1.0) == bytes(4)
    assert made.eeprom == unit().eeprom
    assert status(made, 1.0) == 0


def test_without_supply_it_is_silent_and_a_cut_store_is_lost() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    seal(made)
    made.write("store", b"evas", 0.0)
    made.switch_on(0.01)  # it is on
    assert made.alive(0.01)
    made.switch_off(0.02)
    for t_s in (0.02, 10.0, 20.0):
        assert not made.alive(t_s)
        assert len(made.advance(t_s)) == 0
    with pytest.raises(UnitSilent):
        made.read("status", 20.0)
    made.switch_on(30.0)
    assert not made.alive(30.05)
    assert made.read("bias_x", 30.1) == bytes(4)
    assert made.eeprom == unit().eeprom
    run = made.advance(30.2)
    assert (run.counter[0], run.unit_time_s[0]) == (0, pytest.approx(30.1))


def test_reset_restores_the_stored_copy_locks_and_is_silent_for_100_ms() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    made.advance(0.5)
    made.write("reset", bytes.fromhex("b007"), 0.5)
    assert not made.alive(0.599)
    assert len(made.advance(0.599)) == 0
    with pytest.raises(UnitSilent):
        made.read("status", 0.599)
    assert made.alive(0.6)
    run = made.advance(0.61)
    assert run.counter.tolist() == [0, 1]
    assert np.allclose(run.unit_time_s, [0.6, 0.61])
    assert made.started_s == pytest.approx(0.6)
    assert made.read("bias_x", 0.61) == bytes(4)
    assert status(made, 0.61) == 0


def test_the_eeprom_carries_calibration_and_write_counter_into_the_next_life() -> None:
    made = unlocked()
    put(made, "bias_x", 0.5)
    seal(made)
    made.write("store", b"evas", 0.0)
    assert made.alive(0.05)
    again = unit(stored=made.eeprom)
    assert again.read("bias_x", 0.0) == bytes.fromhex("3f000000")
    assert again.read("write_counter", 0.0) == bytes.fromhex("00000001")
    assert status(again, 0.0) == 0


@pytest.mark.parametrize("at", range(90))
def test_any_damaged_byte_of_the_eeprom_is_noticed_at_start_up(at: int) -> None:
    image = bytearray(unit().eeprom)
    assert len(image) == 90
    image[at] ^= 0x10
    made = unit(stored=bytes(image))
    assert Status.CRC_INVALID in status(made, 0.0)
    run = made.advance(0.0)
    assert run.corrected.tolist() == [[INVALID_CORRECTED] * 3]
    assert run.status.tolist() == [2]
    assert run.counts.tolist() == unit().advance(0.0).counts.tolist()


@pytest.mark.parametrize("image", [b"", b"\x00" * 89, unit().eeprom + b"\x00"])
def test_an_eeprom_of_the_wrong_length_is_damaged(image: bytes) -> None:
    assert Status.CRC_INVALID in status(unit(stored=image), 0.0)


def test_a_damaged_unit_is_mended_by_storing_and_restarting() -> None:
    made = unlocked(stored=b"")
    for name in COVERED:
        made.write(name, unit().read(name, 0.0), 0.0)
    seal(made)
    made.write("store", b"evas", 0.0)
    made.power_cycle(0.1)
    assert status(made, 0.3) == 0
    assert made.advance(0.3).corrected[0].tolist() == [0, 0, 1000000]


def test_a_refused_register_stays_as_it_was() -> None:
    made = unlocked(faults=Faults(refuse_registers=frozenset({"bias_y"})))
    put(made, "bias_x", 0.5)
    with pytest.raises(RegisterFault, match="bias_y"):
        put(made, "bias_y", 0.5)
    assert made.read("bias_y", 0.0) == bytes(4)


def test_a_corrupted_write_acknowledges_and_holds_another_value() -> None:
    made = unlocked(faults=Faults(corrupt_write={"bias_x": 0x01}))
    put(made, "bias_x", 0.5)
    assert made.read("bias_x", 0.0) == bytes.fromhex("3f000001")


def test_a_forgetful_store_acknowledges_and_keeps_the_old_copy() -> None:
    made = unlocked(faults=Faults(forget_store=True))
    put(made, "bias_x", 0.5)
    seal(made)
    made.write("store", b"evas", 0.0)
    assert Status.BUSY in status(made, 0.01)
    assert status(made, 0.1) == Status.UNLOCKED | Status.NOT_STORED
    assert made.eeprom == unit().eeprom


def test_a_unit_that_dies_stays_silent_and_does_not_finish_its_store() -> None:
    made = unlocked(faults=Faults(die_at_s=1.03))
    put(made, "bias_x", 0.5)
    seal(made)
    made.write("store", b"evas", 1.0)
    run = made.advance(2.0)
    assert run.unit_time_s[-1] == pytest.approx(1.02)
    made.power_cycle(2.0)
    assert not made.alive(1e6)
    assert made.eeprom == unit().eeprom


def test_dying_on_a_write_does_not_carry_it_out() -> None:
    made = unlocked(faults=Faults(die_on_write="bias_x"))
    with pytest.raises(UnitSilent):
        put(made, "bias_x", 0.5)
    assert not made.alive(0.0)
