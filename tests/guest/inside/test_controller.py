"""A bus with a controller: its bit rate, its errors, bus-off and its end, by the kernel's own driver (slcan)."""

from __future__ import annotations

from typing import Any

import pytest

from tests.guest.inside.controller import Controller
from tests.guest.inside.witness import received, wait_until
from triaxcal_drivers.can.adapter import ControllerState, ErrorClass, ErrorFrame, error_frame
from triaxcal_drivers.can.socketcan import read_link
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag


def report(adapter: Any) -> ErrorFrame:
    (frame,) = received(adapter, 1)
    assert frame.flags == RawFlag.ERROR
    return error_frame(frame.source, frame.data)


def test_another_bit_rate_than_the_interfaces_is_refused(controller: Controller, opened: Any) -> None:
    link = read_link(controller.name)
    assert (link.can, link.up, link.fd, link.bitrate) == (True, True, False, 500_000)
    assert (link.state, link.listen_only, link.restart_ms) == (ControllerState.ACTIVE, False, 0)
    with pytest.raises(BusError, match=r"runs at 500000 bit/s, expected 250000: .* type can bitrate 250000`"):
        opened(controller.name, 250_000)
    opened(controller.name, 500_000)
    opened(controller.name)


def test_states_of_the_controller_are_told(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name)
    adapter.only(())  # and yet errors
    for said, state in [
        ("sw100020", ControllerState.WARNING),
        ("sp020130", ControllerState.PASSIVE),
        ("sa000000", ControllerState.ACTIVE),
    ]:
        controller.says(said)
        told = report(adapter)
        assert (told.state, told.classes) == (state, {ErrorClass.STATE})
        assert read_link(controller.name).state == state


def test_errors_on_the_bus_are_told_by_class_and_place(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name)
    controller.says("e1a000")  # some kernels read no line of four characters or less
    told = report(adapter)
    assert told.classes == {ErrorClass.NO_ACKNOWLEDGEMENT, ErrorClass.PROTOCOL, ErrorClass.BUS_ERROR}
    assert told.violation_place == "acknowledge slot"
    controller.says("e3scO0")
    told = report(adapter)
    assert told.classes == {ErrorClass.PROTOCOL, ErrorClass.BUS_ERROR, ErrorClass.TRANSMIT_OVERFLOW}
    assert told.violations == ("single bit error", "bit stuffing error")
    assert told.violation_place == "CRC sequence"
    controller.says("e1o000")
    assert ErrorClass.RECEIVE_OVERFLOW in report(adapter).classes


def test_bus_off_is_told_and_ends_it_until_the_bus_is_on_again(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name)
    controller.says("t1230")
    controller.says("sb256256")
    *_, last = received(adapter, 2)
    assert error_frame(last.source, last.data).state == ControllerState.BUS_OFF
    off = rf"socketcan {controller.name}: it is bus-off, .*`ip link set {controller.name} type can restart`"
    with pytest.raises(BusError, match=off):
        adapter.receive(5.0)
    with pytest.raises(BusError, match=f"cannot open {off}"):
        opened(controller.name)
    controller.says("sa000000")
    wait_until(lambda: read_link(controller.name).state != ControllerState.BUS_OFF)
    again = opened(controller.name)
    controller.says("t1230")
    assert [frame.source for frame in received(again, 1)] == [0x123]


def test_bus_off_is_told_also_where_the_error_frame_was_lost(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name, receive_buffer=5000)  # six frames
    for _ in range(20):
        controller.says("t1230")
    controller.says("sb256256")
    wait_until(lambda: read_link(controller.name).state == ControllerState.BUS_OFF)
    assert {frame.flags & RawFlag.ERROR for frame in adapter.receive(5.0)} == {0}
    with pytest.raises(BusError, match="it is bus-off"):
        adapter.receive(5.0)


def test_an_adapter_that_is_unplugged_is_told(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name)
    controller.says("t1230")
    assert len(received(adapter, 1)) == 1
    controller.unplug()
    with pytest.raises(BusError, match=rf"{controller.name}: (there is no such interface|the link is down)"):
        adapter.receive(5.0)
    with pytest.raises(BusError, match="there is no such interface"):
        opened(controller.name)


def test_a_listen_only_interface_is_not_sent_on(controller: Controller, opened: Any) -> None:
    controller.ip("down")
    controller.ip("type", "can", "listen-only", "on")
    controller.ip("up")
    assert read_link(controller.name).listen_only
    adapter = opened(controller.name)
    with pytest.raises(BusError, match="listen-only: nothing is sent"):
        adapter.send(0x123, b"")
    controller.says("t1230")
    assert len(received(adapter, 1)) == 1


def test_a_queue_that_nobody_empties_is_told(controller: Controller, opened: Any) -> None:
    """The pseudo-terminal takes some kilobytes, and then nothing."""
    adapter = opened(controller.name)
    controller.jam()

    def send_much() -> None:
        for _ in range(10_000):
            adapter.send(0x123, bytes(8))

    with pytest.raises(BusError, match="its queue is full: no other node acknowledges"):
        send_much()
