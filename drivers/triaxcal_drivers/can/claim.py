"""Which settings of python-can's interfaces say which bus it is; the others
only say how it is driven."""

from __future__ import annotations

import os
from collections.abc import Mapping
from ipaddress import ip_address
from types import MappingProxyType

from triaxcal_drivers.claim import Claim, canonical_port

_SERIAL = ("slcan", "serial", "robotell", "seeedstudio")
"""Interfaces whose channel is a serial port."""

_NOTHING: Mapping[str, object] = MappingProxyType({})
_CHOOSING: Mapping[str, Mapping[str, object]] = {
    "socketcan": _NOTHING,
    "virtual": _NOTHING,
    "kvaser": _NOTHING,
    "udp_multicast": {"port": 43113},
    "socketcand": {"port": None},
    "vector": {"app_name": "CANalyzer", "serial": None},
    "ixxat": {"unique_hardware_id": None},
    "pcan": {"device_id": None},
    "gs_usb": {"index": None, "bus": None, "address": None},
    "usb2can": {"serial": None},
    "neovi": {"serial": None},
    "systec": {"device_number": None},
    "canalystii": {"device": 0},
    "neousys": {"device": 0},
    **dict.fromkeys(_SERIAL, _NOTHING),
}
"""Options that choose the adapter or the network, with python-can's default. Of
an interface that is not here every option counts."""


def bus_name(interface: str, channel: str | int, options: Mapping[str, object]) -> str:
    """The physical bus, the same however it is spelt."""
    name = str(channel)
    if interface in _SERIAL:
        name = _serial_port(name)
    elif interface == "virtual":
        name = f"{name} of process {os.getpid()}"
    elif interface == "udp_multicast":
        name = _address(name)
    defaults = _CHOOSING.get(interface)
    chosen = options if defaults is None else {key: options.get(key, default) for key, default in defaults.items()}
    words = [f"{key} {value}" for key, value in sorted(chosen.items()) if value is not None]
    return ", ".join([f"{interface} {name}", *words])


def claim_on_can(interface: str, channel: str | int, node_id: int, options: Mapping[str, object]) -> Claim:
    """A node is one process's, its bus is not, unless the adapter is behind a
    serial port."""
    port = _serial_port(str(channel)) if interface in _SERIAL else None
    host = str(options["host"]) if interface == "socketcand" and "host" in options else None
    return Claim(f"node {node_id} on {bus_name(interface, channel, options)}", host=host, serial_port=port)


def claim_to_listen(interface: str, channel: str | int, options: Mapping[str, object]) -> Claim | None:
    """A serial port is one process's; on any other bus as many may listen as
    like to."""
    if interface not in _SERIAL:
        return None
    return Claim(f"listening on {bus_name(interface, channel, options)}", serial_port=_serial_port(str(channel)))


def _serial_port(channel: str) -> str:
    return canonical_port(channel.partition("@")[0])


def _address(text: str) -> str:
    try:
        return str(ip_address(text))
    except ValueError:
        return text
