"""Error frames by literal bytes, from linux/can/error.h."""

from __future__ import annotations

import pytest

from triaxcal_drivers.can.adapter import ControllerState, ErrorClass, ErrorFrame, error_frame


@pytest.mark.parametrize(
    ("identifier", "data", "classes"),
    [
        (0x001, "0000000000000000", {ErrorClass.TRANSMIT_TIMEOUT}),
        (0x002, "0700000000000000", {ErrorClass.ARBITRATION_LOST}),
        (0x004, "0001000000000000", {ErrorClass.RECEIVE_OVERFLOW}),
        (0x004, "0002000000000000", {ErrorClass.TRANSMIT_OVERFLOW}),
        (0x004, "0008000000000000", {ErrorClass.STATE}),
        (0x008, "00000A0A00000000", {ErrorClass.PROTOCOL}),
        (0x010, "0000000004000000", {ErrorClass.TRANSCEIVER}),
        (0x020, "0000000000000000", {ErrorClass.NO_ACKNOWLEDGEMENT}),
        (0x040, "0000000000000000", {ErrorClass.BUS_OFF}),
        (0x080, "0000000000000000", {ErrorClass.BUS_ERROR}),
        (0x100, "0000000000000000", {ErrorClass.RESTARTED}),
        (0x200, "0000000000000000", set()),
        (0x0A8, "0000001900000000", {ErrorClass.PROTOCOL, ErrorClass.NO_ACKNOWLEDGEMENT, ErrorClass.BUS_ERROR}),
        (0x004, "0009000000000000", {ErrorClass.RECEIVE_OVERFLOW, ErrorClass.STATE}),
    ],
)
def test_each_class_is_told(identifier: int, data: str, classes: set[ErrorClass]) -> None:
    assert error_frame(identifier, bytes.fromhex(data)).classes == classes


@pytest.mark.parametrize(
    ("identifier", "controller", "state"),
    [
        (0x004, "00", None),
        (0x004, "01", None),
        (0x004, "04", ControllerState.WARNING),
        (0x004, "08", ControllerState.WARNING),
        (0x004, "10", ControllerState.PASSIVE),
        (0x004, "20", ControllerState.PASSIVE),
        (0x004, "14", ControllerState.PASSIVE),
        (0x004, "40", ControllerState.ACTIVE),
        (0x040, "00", ControllerState.BUS_OFF),
        (0x044, "20", ControllerState.BUS_OFF),
        (0x100, "00", ControllerState.ACTIVE),
        (0x008, "20", None),  # the byte says nothing without the controller's class
    ],
)
def test_the_controllers_state_is_the_worst_that_is_said(
    identifier: int, controller: str, state: ControllerState | None
) -> None:
    assert error_frame(identifier, bytes.fromhex(f"00{controller}000000000000")).state == state


def test_a_protocol_violation_has_its_kind_and_place() -> None:
    told = error_frame(0x088, bytes.fromhex("0000940E00000000"))
    assert told.violations == ("bit stuffing error", "could not send a recessive bit")
    assert told.violation_place == "identifier bits 4 to 0"
    assert told.transmitting
    unknown = error_frame(0x008, bytes.fromhex("0000020000000000"))
    assert (unknown.violations, unknown.violation_place, unknown.transmitting) == (("frame format error",), None, False)


def test_wires_arbitration_and_counters_are_told() -> None:
    assert error_frame(0x010, bytes.fromhex("0000000057000000")).transceiver == (
        "CANH shorted to ground",
        "CANL shorted to the battery",
    )
    assert error_frame(0x002, bytes.fromhex("0B00000000000000")).arbitration_bit == 11
    counted = error_frame(0x204, bytes.fromhex("0010000000008260"))
    assert (counted.transmit_errors, counted.receive_errors) == (130, 96)
    not_counted = error_frame(0x004, bytes.fromhex("0010000000008260"))
    assert (not_counted.transmit_errors, not_counted.receive_errors) == (None, None)


def test_it_says_so_in_words() -> None:
    assert str(error_frame(0x040, bytes(8))) == "bus-off"
    assert str(error_frame(0x204, bytes.fromhex("0010000000008260"))) == (
        "error passive, error counters 130 transmitting, 96 receiving"
    )
    assert str(error_frame(0x0A8, bytes.fromhex("0000001900000000"))) == (
        "protocol violation, no acknowledgement, bus error, in the acknowledge slot"
    )
    assert str(error_frame(0x002, bytes.fromhex("0B00000000000000"))) == "arbitration lost, at bit 11"


def test_bytes_that_are_missing_count_as_zero() -> None:
    assert error_frame(0x3FF, b"") == error_frame(0x3FF, bytes(8))
    assert str(error_frame(0, b"")) == str(ErrorFrame(frozenset())) == "error frame that says nothing"
