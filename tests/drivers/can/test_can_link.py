"""What the kernel says of an interface, by literal bytes: attributes of the answer that Linux 6.1 gave for its slcan
driver at 500 kbit/s."""

from __future__ import annotations

import errno
import sys

import pytest

from triaxcal_drivers.can.receive import ControllerState
from triaxcal_drivers.can.socketcan import Link, link_of, read_link

pytestmark = pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are of a little-endian machine")

INTERFACE = "0000 1801 02000000 C1000100 00000000"  # of type CAN, number 2, up
ETHERNET = "0000 0100 02000000 41000000 00000000"
NAME = "0900 0300 63616E3000 000000"  # can0
MTU, MTU_FD = "0800 0400 10000000", "0800 0400 48000000"
KIND = "0800 0100 63616E00"
BIT_TIMING = "2400 0100 20A10700" + "00" * 28
STATE = "0800 0400 {:02X}000000"
CONTROL_MODE = "0C00 0500 00000000 {:02X}000000"
RESTART = "0800 0600 {:02X}000000"


def message(*attributes: str, kind: str = "1000", interface: str = INTERFACE) -> bytes:
    body = bytes.fromhex(interface + "".join(attributes))
    return (16 + len(body)).to_bytes(4, "little") + bytes.fromhex(f"{kind} 0000 01000000 B8020000") + body


def nested(number: int, *attributes: str, mark: int = 0) -> str:
    inner = bytes.fromhex("".join(attributes))
    return ((4 + len(inner)).to_bytes(2, "little") + (number | mark).to_bytes(2, "little") + inner).hex()


def controller(state: int = 0, mode: int = 0, restart: int = 0, mark: int = 0) -> str:
    data = [BIT_TIMING, STATE.format(state), CONTROL_MODE.format(mode), RESTART.format(restart)]
    return nested(18, KIND, nested(2, *data, mark=mark), mark=mark)


def test_an_interface_with_a_controller() -> None:
    assert link_of(message(NAME, MTU, controller())) == Link(
        "can0", can=True, up=True, fd=False, state=ControllerState.ACTIVE, bitrate=500_000
    )


def test_listen_only_restart_and_can_fd() -> None:
    link = link_of(message(NAME, MTU_FD, controller(mode=0x22, restart=100)))
    assert (link.fd, link.listen_only, link.restart_ms) == (True, True, 100)
    assert link_of(message(NAME, MTU_FD, controller(mode=0x20))).listen_only is False


@pytest.mark.parametrize(("number", "state"), [*enumerate(ControllerState), (6, None)])
def test_states(number: int, state: ControllerState | None) -> None:
    assert link_of(message(NAME, MTU, controller(state=number))).state == state


def test_attributes_that_are_marked_as_nested_are_read_likewise() -> None:
    assert link_of(message(NAME, MTU, controller(state=3, mark=0x8000))).state == ControllerState.BUS_OFF


def test_a_virtual_interface_has_no_controller() -> None:
    kind = "0900 0100 7663616E00 000000"
    assert link_of(message("0A00 0300 7663616E3000 0000", MTU_FD, nested(18, kind))) == Link(
        "vcan0", can=True, up=True, fd=True
    )


def test_an_interface_that_is_down_or_of_another_kind() -> None:
    assert not link_of(message(NAME, MTU, interface="0000 1801 02000000 80000000 00000000")).up
    ethernet = link_of(message("0900 0300 6574683000 000000", controller(), interface=ETHERNET))
    assert (ethernet.name, ethernet.can, ethernet.bitrate) == ("eth0", False, None)


def test_an_error_of_the_kernel_is_raised_and_broken_attributes_end_it() -> None:
    with pytest.raises(OSError) as e:
        link_of(message(kind="0200", interface="EDFFFFFF" + "00" * 16))
    assert e.value.errno == errno.ENODEV
    assert link_of(message(NAME, "0000 0400 10000000")).name == "can0"


@pytest.mark.skipif(sys.platform != "linux", reason="rtnetlink is Linux's")
def test_the_kernel_of_this_machine_tells_of_its_loopback() -> None:
    link = read_link("lo")
    assert (link.name, link.can) == ("lo", False)
    with pytest.raises(OSError) as e:
        read_link("no-such-link")
    assert e.value.errno == errno.ENODEV
