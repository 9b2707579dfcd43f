"""The electronics, on a clock that the test holds."""

from __future__ import annotations

from itertools import pairwise

import pytest

from tests.devices.habits import Habits, StoreReply
from tests.devices.memory import Electronics, Refused, Request, Silent
from tests.devices.table import FACTORY, NEW, OLD, RESET_COMMAND, STORE_COMMAND, UNLOCK_KEY, calibration_names

SIZE = 9 * 4 + 2
DIRECT = Habits(store_command=False)


def old(habits: Habits | None = None) -> dict[str, bytes]:
    return OLD.image(habits or Habits())


def new(habits: Habits | None = None) -> dict[str, bytes]:
    return NEW.image(habits or Habits())


def joined(image: dict[str, bytes]) -> bytes:
    return b"".join(image.values())


def torn(after: int) -> bytes:
    """The EEPROM after so many bytes of the new image."""
    return joined(new())[:after] + joined(old())[after:]


def unlock(unit: Electronics, now: float = 0.0) -> None:
    unit.write("unlock_key", UNLOCK_KEY.to_bytes(2, "big"), now)


def store(unit: Electronics, now: float = 0.0) -> float:
    return unit.write("store", STORE_COMMAND.to_bytes(4, "big"), now)


def reset(unit: Electronics, now: float = 0.0) -> float:
    return unit.write("reset", RESET_COMMAND.to_bytes(2, "big"), now)


def write_new(unit: Electronics, now: float = 0.0) -> None:
    for name, raw in new(unit.habits).items():
        unit.write(name, raw, now)


def with_new_in_ram(habits: Habits) -> Electronics:
    unit = Electronics(habits)
    if habits.unlock:
        unlock(unit)
    write_new(unit)
    return unit


def read_all(unit: Electronics, now: float = 0.0) -> dict[str, bytes]:
    return {name: unit.read(name, now) for name in unit.names}


# A device that behaves.


def test_registers_wait_in_ram_for_the_store_command() -> None:
    unit = with_new_in_ram(Habits())
    assert (unit.in_use, unit.eeprom) == (new(), old())
    assert unit.holds(old())
    store(unit)
    assert unit.eeprom == new()
    assert unit.holds(new())


def test_a_restart_brings_the_stored_calibration_back_and_locks() -> None:
    unit = with_new_in_ram(Habits())
    reset(unit, now=1.0)
    assert read_all(unit, now=1.0) == old()
    with pytest.raises(Refused, match="locked"):
        unit.write("bias_x", bytes(4), 1.0)


def test_without_a_store_command_a_write_is_stored_at_once() -> None:
    unit = with_new_in_ram(DIRECT)
    assert unit.eeprom == new()
    assert "store" not in unit.table


@pytest.mark.parametrize(
    ("register", "raw", "why"),
    [
        ("bias_x", b"\0\0", "length"),
        ("store", bytes(4), "value"),
        ("reset", bytes(2), "value"),
        ("serial_number", bytes(4), "read-only"),
        ("no_such", bytes(4), "unknown"),
    ],
)
def test_a_wrong_write_is_refused(register: str, raw: bytes, why: str) -> None:
    unit = Electronics()
    unlock(unit)
    with pytest.raises(Refused, match=why):
        unit.write(register, raw, 0.0)


def test_a_locked_device_refuses_or_ignores() -> None:
    with pytest.raises(Refused, match="locked"):
        store(Electronics())
    unit = Electronics(Habits(when_locked="ignores"))
    write_new(unit)
    assert unit.in_use == old()


def test_a_command_cannot_be_read() -> None:
    with pytest.raises(Refused, match="write-only"):
        Electronics().read("store", 0.0)


def test_the_status_tells_what_is_going_on() -> None:
    unit = Electronics(Habits(store_seconds=1.0))
    assert unit.read("status", 0.0) == b"\x00\x00"
    unlock(unit)
    assert unit.read("status", 0.0) == b"\x00\x01"
    write_new(unit)
    assert unit.read("status", 0.0) == b"\x00\x09"
    store(unit)
    assert unit.read("status", 0.5) == b"\x00\x1b"  # half a calibration has no right checksum
    assert unit.read("status", 1.0) == b"\x00\x01"


@pytest.mark.parametrize(
    ("habits", "counted"), [(Habits(counter=True), 1), (Habits(counter=True, store_command=False), 10)]
)
def test_a_counter_counts_what_is_stored(habits: Habits, counted: int) -> None:
    unit = with_new_in_ram(habits)
    if habits.store_command:
        store(unit)
    assert unit.read("write_counter", 0.0) == counted.to_bytes(4, "big")


def test_the_mirror_shows_the_stored_copy() -> None:
    unit = with_new_in_ram(Habits(mirror=True))
    assert unit.read("stored_bias_z", 0.0) == old()["bias_z"]
    store(unit)
    assert unit.read("stored_bias_z", 0.0) == new()["bias_z"]


def test_what_reached_the_electronics_is_logged() -> None:
    unit = Electronics()
    unlock(unit, 1.0)
    unit.write("bias_x", bytes(4), 2.0)
    unit.read("bias_x", 3.0)
    with pytest.raises(Refused):
        unit.read("store", 4.0)
    assert unit.log == [
        Request("write", "unlock_key", b"\xc0\xde", 1.0, "ok"),
        Request("write", "bias_x", bytes(4), 2.0, "ok"),
        Request("read", "bias_x", bytes(4), 3.0, "ok"),
        Request("read", "store", b"", 4.0, "write-only"),
    ]
    assert unit.written == ["bias_x"]


# Power.


@pytest.mark.parametrize("after", range(SIZE + 1))
def test_a_store_is_torn_at_any_byte(after: int) -> None:
    unit = with_new_in_ram(Habits())
    unit.arm(after)
    with pytest.raises(Silent):
        store(unit)
    assert joined(unit.eeprom) == torn(after)
    assert not unit.up(1e9)
    unit.power_on(1.0)
    assert joined(read_all(unit, 1.0)) == torn(after)


@pytest.mark.parametrize("after", range(SIZE + 1))
def test_direct_writes_are_torn_at_any_byte_of_them_all(after: int) -> None:
    unit = Electronics(Habits(store_command=False, unlock=False, cut_at_byte=after))
    with pytest.raises(Silent):
        write_new(unit)
    assert joined(unit.starts_with()) == torn(after)


@pytest.mark.parametrize("after", range(SIZE + 1))
def test_an_atomic_store_is_there_as_a_whole_or_not_at_all(after: int) -> None:
    unit = with_new_in_ram(Habits(atomic_store=True, cut_at_byte=after))
    with pytest.raises(Silent):
        store(unit)
    assert unit.starts_with() == (new() if after == SIZE else old())


def test_the_power_fails_once_and_comes_back_by_itself() -> None:
    unit = with_new_in_ram(Habits(cut_at_byte=5, power_back_s=2.0))
    with pytest.raises(Silent):
        store(unit, 1.0)
    with pytest.raises(Silent):
        unit.read("bias_x", 2.9)
    assert joined(read_all(unit, 3.0)) == torn(5)
    unlock(unit, 3.0)
    write_new(unit, 3.0)
    store(unit, 3.0)
    assert unit.holds(new())


def test_a_power_cycle_loses_what_is_not_stored() -> None:
    unit = with_new_in_ram(Habits())
    unit.power_cycle(1.0)
    assert read_all(unit, 1.0) == old()
    assert unit.restarts == 1


# Storing.


def test_a_slow_store_goes_on_byte_by_byte() -> None:
    unit = with_new_in_ram(Habits(store_seconds=3.8))
    store(unit, 1.0)
    for tenths in range(39):
        unit.advance(1.0 + 0.1 * tenths)
        assert joined(unit.eeprom) == torn(tenths)


def test_a_power_cycle_in_the_middle_of_a_store_leaves_a_mixture_but_waiting_does_not() -> None:
    unit = with_new_in_ram(Habits(store_seconds=3.8))
    store(unit, 1.0)
    unit.advance(2.0)
    assert unit.starts_with() == new()
    unit.power_cycle(2.0)
    assert joined(unit.starts_with()) == torn(10)


@pytest.mark.parametrize(("while_storing", "expected"), [("silent", Silent), ("busy", Refused), ("answers", None)])
def test_a_device_that_is_storing_answers_in_its_way(while_storing, expected: type[Exception] | None) -> None:
    unit = with_new_in_ram(Habits(store_seconds=1.0, while_storing=while_storing))
    store(unit)
    if expected is None:
        assert unit.read("bias_x", 0.9) == new()["bias_x"]
    else:
        with pytest.raises(expected):
            unit.read("bias_x", 0.9)
    assert unit.read("bias_x", 1.0) == new()["bias_x"]


def test_what_is_written_during_a_store_may_be_stored_with_it() -> None:
    unit = with_new_in_ram(Habits(store_seconds=3.8))
    store(unit)
    unit.write("bias_z", bytes(4), 1.9)
    unit.advance(3.8)
    assert unit.eeprom == {**new(), "bias_z": bytes(4)}


def test_a_store_that_blocks_is_answered_when_it_is_done() -> None:
    assert store(with_new_in_ram(Habits(store_seconds=8.0))) == 0.0
    assert store(with_new_in_ram(Habits(store_seconds=8.0, store_blocks=True))) == 8.0


@pytest.mark.parametrize(
    ("reply", "raised", "done"),
    [
        ("none, done", Silent, True),
        ("none, not done", Silent, False),
        ("busy, done", Refused, True),
        ("busy, not done", Refused, False),
        ("refused", Refused, False),
    ],
)
def test_a_store_is_answered_otherwise_than_it_is_done(reply: StoreReply, raised: type[Exception], done: bool) -> None:
    unit = with_new_in_ram(Habits(store_reply=reply))
    with pytest.raises(raised):
        store(unit)
    assert unit.eeprom == (new() if done else old())


def test_each_store_command_can_be_answered_in_its_own_way() -> None:
    unit = with_new_in_ram(Habits(store_reply=("none, not done", "ok")))
    with pytest.raises(Silent):
        store(unit)
    store(unit)
    store(unit)
    assert unit.eeprom == new()


@pytest.mark.parametrize("while_storing", ["silent", "busy", "answers"])
def test_a_second_store_spoils_the_first(while_storing) -> None:
    unit = with_new_in_ram(Habits(store_seconds=1.0, second_store_spoils=True, while_storing=while_storing))
    store(unit)
    if while_storing == "answers":
        store(unit, 0.01)
    else:
        with pytest.raises((Silent, Refused)):
            store(unit, 0.01)
    held = unit.starts_with()
    taken = [held[name] == new()[name] for name in unit.names]
    assert taken == [True, False] * 5


def test_a_store_of_a_wrong_checksum_can_be_refused() -> None:
    unit = with_new_in_ram(Habits(checksum_checked=True))
    unit.write("calibration_crc", bytes(2), 0.0)
    with pytest.raises(Refused, match="value"):
        store(unit)
    unit.write("calibration_crc", new()["calibration_crc"], 0.0)
    store(unit)
    assert unit.holds(new())


def test_a_store_is_forgotten_as_a_whole_or_in_part() -> None:
    unit = with_new_in_ram(Habits(forget_store=True))
    store(unit)
    assert (unit.in_use, unit.eeprom) == (new(), old())
    unit = with_new_in_ram(Habits(forget_store=frozenset({"bias_y"})))
    store(unit)
    assert unit.starts_with() == {**new(), "bias_y": old()["bias_y"]}


def test_a_cached_mirror_shows_what_the_eeprom_lacks_until_a_restart() -> None:
    unit = with_new_in_ram(Habits(forget_store=True, mirror=True, read_back="cached"))
    store(unit)
    assert unit.read("stored_bias_x", 0.0) == new()["bias_x"]
    unit.restart(1.0)
    assert unit.read("stored_bias_x", 1.0) == old()["bias_x"]


@pytest.mark.parametrize("read_back", ["memory", "cached"])
def test_a_direct_write_that_is_not_taken_shows_only_where_the_eeprom_is_read(read_back) -> None:
    unit = with_new_in_ram(Habits(store_command=False, forget_store=True, read_back=read_back))
    assert read_all(unit) == (old() if read_back == "memory" else new())
    assert unit.holds(old())


def test_direct_writes_take_their_time_one_after_the_other() -> None:
    unit = Electronics(Habits(store_command=False, unlock=False, store_seconds=1.0))
    unit.write("scale_factor_x", new()["scale_factor_x"], 0.0)
    unit.write("scale_factor_y", new()["scale_factor_y"], 0.0)
    unit.advance(1.0)
    assert joined(unit.eeprom) == torn(4)
    unit.advance(2.0)
    assert joined(unit.eeprom) == torn(8)


# Wear.


def test_every_byte_that_is_written_wears() -> None:
    unit = with_new_in_ram(Habits())
    store(unit)
    store(unit)
    assert unit.memory.wear == [2] * SIZE
    assert (unit.stores, unit.needless_stores) == (2, 1)


def test_a_store_may_leave_equal_bytes_alone() -> None:
    unit = with_new_in_ram(Habits(store_skips_equal=True))
    store(unit)
    store(unit)
    changed = [a != b for a, b in zip(joined(new()), joined(old()), strict=True)]
    assert unit.memory.wear == changed
    assert not all(changed)


def test_a_direct_write_of_what_is_there_is_told() -> None:
    unit = with_new_in_ram(DIRECT)
    assert unit.equal_writes == []
    unit.write("bias_x", new()["bias_x"], 0.0)
    assert unit.equal_writes == ["bias_x"]
    assert (unit.wear_of("bias_x"), unit.wear_of("bias_y")) == (2, 1)


# Registers that err.


def test_a_register_is_stuck_or_refuses() -> None:
    unit = Electronics(Habits(unlock=False, stuck=frozenset({"bias_x"}), refuses=frozenset({"bias_y"})))
    unit.write("bias_x", bytes(4), 0.0)
    assert unit.read("bias_x", 0.0) == old()["bias_x"]
    with pytest.raises(Refused, match="failed"):
        unit.write("bias_y", bytes(4), 0.0)


def test_a_register_reads_back_with_a_bit_flipped_though_it_is_right() -> None:
    unit = with_new_in_ram(Habits(flips={"bias_x": 31}))
    sign_flipped = bytes([new()["bias_x"][0] ^ 0x80]) + new()["bias_x"][1:]
    assert unit.read("bias_x", 0.0) == sign_flipped
    assert unit.in_use == new()


def test_a_register_reads_otherwise_each_time() -> None:
    unit = Electronics(Habits(alternates=frozenset({"bias_x"})))
    reads = [unit.read("bias_x", 0.0) for _ in range(4)]
    assert all(a != b for a, b in pairwise(reads))
    assert old()["bias_x"] in reads


# Starting.


@pytest.mark.parametrize("blank", [0xFF, 0x00])
def test_a_device_fresh_from_the_factory_is_blank(blank: int) -> None:
    unit = Electronics(Habits(blank=blank))
    assert joined(read_all(unit)) == bytes([blank]) * SIZE


def test_a_wrong_stored_checksum_shows_or_brings_factory_values() -> None:
    unit = Electronics(Habits(stored_checksum_wrong=True))
    assert unit.read("status", 0.0) == b"\x00\x02"
    assert unit.read("bias_x", 0.0) == old()["bias_x"]
    assert unit.read("calibration_crc", 0.0) != old()["calibration_crc"]
    unit = Electronics(Habits(stored_checksum_wrong=True, on_wrong_checksum="factory"))
    assert read_all(unit) == FACTORY.image(Habits())


def test_a_restart_may_bring_factory_values() -> None:
    unit = with_new_in_ram(Habits(resets_to="factory"))
    store(unit)
    assert unit.eeprom == new()
    assert unit.starts_with() == FACTORY.image(Habits())


def test_a_restart_takes_its_time_and_need_not_be_acknowledged() -> None:
    unit = Electronics(Habits(restart_s=2.0, reset_reply=False))
    with pytest.raises(Silent):
        reset(unit, 1.0)
    with pytest.raises(Silent):
        unit.read("bias_x", 2.9)
    assert unit.read("bias_x", 3.0) == old()["bias_x"]


def test_to_ask_what_it_starts_with_changes_nothing() -> None:
    unit = with_new_in_ram(Habits(store_seconds=3.8, counter=True))
    store(unit)
    unit.advance(1.0)
    for _ in range(2):
        assert unit.starts_with() == new()
        assert joined(unit.eeprom) == torn(10)
        assert unit.in_use == new()
    assert unit.restarts == 0
    assert unit.read("write_counter", 1.0) == bytes(4)


def test_habits_that_need_a_checksum_say_so() -> None:
    with pytest.raises(ValueError, match="need a checksum"):
        Habits(checksum=False, checksum_checked=True)


def test_the_images_differ_in_every_register() -> None:
    images = [c.image(Habits()) for c in (OLD, NEW, FACTORY)]
    for name in calibration_names(Habits()):
        assert len({image[name] for image in images}) == 3
