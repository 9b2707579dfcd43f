"""Modbus: profiles, links and the driver of devices on RTU and TCP."""

from __future__ import annotations

from typing import TYPE_CHECKING

from triaxcal_drivers.lazy import lazily

if TYPE_CHECKING:
    from triaxcal_drivers.modbus.line import serve_serial, serve_tcp
    from triaxcal_drivers.modbus.model import ModbusBus
    from triaxcal_drivers.modbus.protocol import (
        DEVICE_FAILURE,
        ILLEGAL_ADDRESS,
        ILLEGAL_VALUE,
        READ_INPUT,
        ModbusRefusal,
        SerialLine,
        TcpAddress,
        Unanswered,
    )

_NAMES = {
    "model": ("ModbusBus",),
    "protocol": (
        "DEVICE_FAILURE",
        "ILLEGAL_ADDRESS",
        "ILLEGAL_VALUE",
        "ModbusRefusal",
        "READ_INPUT",
        "SerialLine",
        "TcpAddress",
        "Unanswered",
    ),
    "line": (
        "serve_serial",
        "serve_tcp",
    ),
}

__all__ = [
    "DEVICE_FAILURE",
    "ILLEGAL_ADDRESS",
    "ILLEGAL_VALUE",
    "READ_INPUT",
    "ModbusBus",
    "ModbusRefusal",
    "SerialLine",
    "TcpAddress",
    "Unanswered",
    "serve_serial",
    "serve_tcp",
]

if not TYPE_CHECKING:  # a checker would take any name for one that is here
    __getattr__ = lazily(__name__, _NAMES)
