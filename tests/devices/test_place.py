"""What becomes of requests on the way, on a clock that the test holds."""

from __future__ import annotations

import pytest

from tests.devices.habits import Habits
from tests.devices.memory import Electronics, Refused
from tests.devices.place import Exchange, Place, Reply, Trouble

SERIAL = (4711).to_bytes(4, "big")
DONE, NOTHING = Exchange((Reply(SERIAL, 0.0),)), Exchange()
SECOND = frozenset({2})


def ask(place: Place, now: float = 0.0) -> Exchange:
    return place.exchange(now, lambda unit: (unit.read("serial_number", now), 0.0), lambda refused: b"refused")


def make(trouble: Trouble | None = None, habits: Habits | None = None) -> Place:
    return Place(Electronics(habits or Habits()), trouble)


@pytest.mark.parametrize(
    ("trouble", "expected", "reached"),
    [
        (Trouble(lose_request=SECOND), NOTHING, 2),
        (Trouble(lose_reply=SECOND), NOTHING, 3),
        (Trouble(late=SECOND, late_s=0.5), Exchange((Reply(SERIAL, 0.5),)), 3),
        (Trouble(duplicate=SECOND), Exchange((Reply(SERIAL, 0.0),) * 2), 3),
        (Trouble(garble=SECOND, garbage=("noise",)), Exchange((Reply(SERIAL, 0.0, "noise"),)), 3),
        (Trouble(busy=SECOND), Exchange((Reply(b"refused", 0.0),)), 2),
        (Trouble(drop=SECOND), Exchange(drop=True), 3),
        (Trouble(drop=SECOND, drop_done=False), Exchange(drop=True), 2),
    ],
)
def test_something_happens_to_the_request_of_a_number(trouble: Trouble, expected: Exchange, reached: int) -> None:
    place = make(trouble)
    assert [ask(place) for _ in range(3)] == [DONE, expected, DONE]
    assert len(place.unit.log) == reached


def test_chance_is_as_frequent_as_said_and_the_same_for_a_seed() -> None:
    def lost(seed: int) -> list[bool]:
        place = make(Trouble(seed=seed, lose_reply=0.2))
        return [ask(place) == NOTHING for _ in range(2000)]

    assert sum(lost(1)) == pytest.approx(400, abs=4 * 18)  # four standard deviations
    assert lost(1) == lost(1)
    assert lost(1) != lost(2)


def test_one_trouble_does_not_move_the_chance_of_another() -> None:
    def lost(trouble: Trouble) -> list[bool]:
        place = make(trouble)
        return [not ask(place).replies for _ in range(200)]

    assert lost(Trouble(lose_request=0.2)) == lost(Trouble(lose_request=0.2, duplicate=0.5, garble=0.5))


def test_a_busy_code_is_handed_on() -> None:
    codes: list[int | None] = []

    def refuse(refused: Refused) -> bytes:
        codes.append(refused.code)
        return b""

    place = make(Trouble(busy=1.0, busy_code=5))
    place.exchange(0.0, lambda unit: (b"", 0.0), refuse)
    assert codes == [5]


def test_a_device_is_busy_for_a_while_from_the_first_request_on() -> None:
    place = make(Trouble(busy_for_s=2.0))
    answers = [ask(place, now).replies[0].data for now in (10.0, 11.9, 12.0)]
    assert answers == [b"refused", b"refused", SERIAL]


def test_a_line_dies_and_comes_back() -> None:
    place = make(Trouble(dead_after=2, dead_for_s=5.0))
    assert [ask(place, now) for now in (0.0, 1.0, 5.9, 6.0)] == [DONE, DONE, NOTHING, DONE]
    place = make(Trouble(dead_after=0))
    assert [ask(place, now) for now in (0.0, 1e9)] == [NOTHING, NOTHING]


def test_a_brown_out_loses_the_ram_and_locks() -> None:
    place = make(Trouble(brown_out=SECOND))
    place.unit.write("unlock_key", b"\xc0\xde", 0.0)
    place.unit.write("bias_x", bytes(4), 0.0)
    ask(place)
    assert place.unit.in_use["bias_x"] == bytes(4)
    ask(place)
    assert place.unit.in_use["bias_x"] != bytes(4)
    assert place.unit.read("status", 0.0) == bytes(2)


def test_another_unit_takes_the_place_with_a_memory_of_its_own() -> None:
    place, other = make(), Electronics(serial_number=4712)
    first = place.unit
    place.swap_at(2, other)
    answers = [ask(place).replies[0].data for _ in range(3)]
    assert answers == [SERIAL, (4712).to_bytes(4, "big"), (4712).to_bytes(4, "big")]
    assert (len(first.log), len(other.log)) == (1, 2)


def test_a_gateway_answers_for_a_unit_that_does_not() -> None:
    place = make(Trouble(gateway=0x0B))
    assert ask(place).replies[0].data == SERIAL
    place.unit.power_off(0.0)
    assert [r.data for r in ask(place).replies] == [b"refused"]


def test_a_unit_that_is_dark_is_not_even_busy() -> None:
    place = make(Trouble(busy=1.0))
    place.unit.power_off(0.0)
    assert ask(place) == NOTHING
