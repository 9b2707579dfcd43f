"""SDO frames by hand, from CiA 301."""

from __future__ import annotations

import pytest

from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.place import Place, Reply, Trouble
from tests.devices.sdo import GARBAGE, SdoServer, framed

NOTHING = "00 00 00 00"
UNLOCK = "2B 10 2F 01 DE C0 00 00"
READ_SERIAL, SERIAL = f"40 18 10 04 {NOTHING}", "43 18 10 04 67 12 00 00"


def sdo(habits: Habits | None = None, trouble: Trouble | None = None, *, segmented: bool = False) -> SdoServer:
    return SdoServer(Place(Electronics(habits or Habits()), trouble), segmented=segmented)


def ask(server: SdoServer, frame: str) -> str:
    (reply,) = server.exchange(bytes.fromhex(frame), 0.0).replies
    return reply.data.hex(" ").upper()


@pytest.mark.parametrize(
    ("request_frame", "reply"),
    [
        (READ_SERIAL, SERIAL),
        (f"40 18 10 02 {NOTHING}", "43 18 10 02 7C 3A 00 00"),
        (f"40 01 2F 00 {NOTHING}", "4B 01 2F 00 00 00 00 00"),  # status, two bytes
        (f"40 01 10 00 {NOTHING}", "4F 01 10 00 00 00 00 00"),  # error register, one
        (f"40 00 24 01 {NOTHING}", "43 00 24 01 9A 99 19 C0"),  # -2.4
        (UNLOCK, f"60 10 2F 01 {NOTHING}"),
        (f"40 00 50 00 {NOTHING}", "80 00 50 00 00 00 02 06"),  # no such object
        (f"40 18 10 09 {NOTHING}", "80 18 10 09 11 00 09 06"),  # no such sub-index
        ("23 18 10 04 01 00 00 00", "80 18 10 04 02 00 01 06"),  # read only
        ("2F 01 10 00 01 00 00 00", "80 01 10 00 02 00 01 06"),
        (f"40 10 2F 01 {NOTHING}", "80 10 2F 01 01 00 01 06"),  # write only
        ("2B 00 24 01 00 00 00 00", "80 00 24 01 10 00 07 06"),  # a length that does not match
        ("23 10 10 01 01 00 00 00", "80 10 10 01 21 00 00 08"),  # locked
        (f"A0 00 24 01 {NOTHING}", "80 00 24 01 01 00 04 05"),  # block transfer
        (f"60 {NOTHING} 00 00 00", "80 00 00 00 01 00 04 05"),  # a segment of nothing
    ],
)
def test_a_request_has_its_reply(request_frame: str, reply: str) -> None:
    assert ask(sdo(), request_frame) == reply


def test_save_stores_what_was_written() -> None:
    server = sdo()
    ask(server, UNLOCK)
    assert ask(server, "23 00 24 01 AD 69 1A C0") == f"60 00 24 01 {NOTHING}"
    assert ask(server, "23 10 10 01 73 61 76 65") == f"60 10 10 01 {NOTHING}"
    assert server.place.unit.eeprom["scale_factor_x"].hex() == "c01a69ad"


def test_a_download_need_not_tell_its_size() -> None:
    server = sdo()
    ask(server, UNLOCK)
    ask(server, "22 00 24 01 AD 69 1A C0")
    assert server.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


def test_a_long_object_goes_up_in_segments() -> None:
    server = sdo()
    assert ask(server, f"40 08 10 00 {NOTHING}") == "41 08 10 00 18 00 00 00"
    assert ask(server, f"60 {NOTHING} 00 00 00") == "00 " + b"three a".hex(" ").upper()
    assert ask(server, f"70 {NOTHING} 00 00 00") == "10 " + b"xes, go".hex(" ").upper()
    assert ask(server, f"60 {NOTHING} 00 00 00") == "00 " + b"od and ".hex(" ").upper()
    assert ask(server, f"70 {NOTHING} 00 00 00") == "19 62 61 64 00 00 00 00"


def test_short_objects_may_go_in_segments_too() -> None:
    server = sdo(segmented=True)
    ask(server, UNLOCK)
    assert ask(server, READ_SERIAL) == "41 18 10 04 04 00 00 00"
    assert ask(server, f"60 {NOTHING} 00 00 00") == "07 67 12 00 00 00 00 00"
    assert ask(server, "21 00 24 01 04 00 00 00") == f"60 00 24 01 {NOTHING}"
    assert ask(server, "07 AD 69 1A C0 00 00 00") == f"20 {NOTHING} 00 00 00"
    assert server.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


def test_a_toggle_bit_that_does_not_alternate_ends_the_transfer() -> None:
    server = sdo()
    ask(server, f"40 08 10 00 {NOTHING}")
    assert ask(server, f"70 {NOTHING} 00 00 00") == "80 08 10 00 00 00 03 05"
    assert ask(server, f"60 {NOTHING} 00 00 00") == "80 00 00 00 01 00 04 05"


def test_an_abort_of_the_client_ends_the_transfer_without_reply() -> None:
    server = sdo()
    ask(server, f"40 08 10 00 {NOTHING}")
    assert server.exchange(bytes.fromhex("80 08 10 00 00 00 04 05"), 0.0).replies == ()
    assert ask(server, f"60 {NOTHING} 00 00 00") == "80 00 00 00 01 00 04 05"


@pytest.mark.parametrize(
    ("trouble", "code"),
    [(Trouble(busy=1.0), "22 00 00 08"), (Trouble(busy=1.0, busy_code=0x08000020), "20 00 00 08")],
)
def test_a_busy_device_aborts(trouble: Trouble, code: str) -> None:
    assert ask(sdo(trouble=trouble), READ_SERIAL) == f"80 18 10 04 {code}"


def test_a_store_that_fails_says_hardware() -> None:
    server = sdo(Habits(unlock=False, store_reply="refused"))
    assert ask(server, "23 10 10 01 73 61 76 65") == "80 10 10 01 00 00 06 06"


@pytest.mark.parametrize(
    ("garbage", "cob_id", "data"),
    [
        (None, 0x585, SERIAL),
        ("node", 0x586, SERIAL),
        ("index", 0x585, "43 19 10 04 67 12 00 00"),
        ("function", 0x585, "63 18 10 04 67 12 00 00"),
        ("length", 0x585, "43 18 10 04 67 12 00"),
        ("truncated", 0x585, "43 18 10"),
        ("noise", 0x585, "FF 00 55 AA 00 01 FE 00"),
    ],
)
def test_a_reply_is_damaged(garbage: str | None, cob_id: int, data: str) -> None:
    assert framed(Reply(bytes.fromhex(SERIAL), 0.0, garbage), 5) == (cob_id, bytes.fromhex(data))
    assert garbage in (None, *GARBAGE)
