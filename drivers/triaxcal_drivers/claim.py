"""Claims of a process on an open unit, by names that do not depend on the spelling.

A driver's bus model states them by a method ``claim``; `claim_of` calls it. No I/O
except links of the file system.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from ipaddress import IPv6Address, ip_address

from pydantic import BaseModel

LOCALHOST = "localhost"


@dataclass(frozen=True)
class Claim:
    """Claims that are equal are of one device.

    ``device`` names the unit, and begins or completes a message: "node 5 on
    socketcan can0". ``host`` is the network host that it is reached by, where
    it is one; it stands apart because a name and an address may be the same
    host. ``serial_port`` is the port, as `canonical_port` has it, where only
    one process may have it open; what several processes can share, such as a
    CAN bus or a gateway, is no part of a claim.
    """

    device: str
    host: str | None = None
    serial_port: str | None = None

    def __post_init__(self) -> None:
        if self.host is not None:
            object.__setattr__(self, "host", canonical_host(self.host))


def claim_of(bus: BaseModel) -> Claim:
    """All settings together name the device where the driver's model has no
    ``claim``."""
    claim: Callable[[], Claim] | None = getattr(bus, "claim", None)
    if claim is not None:
        return claim()
    settings = sorted(bus.model_dump(mode="json").items())
    return Claim(f"{type(bus).__name__} " + ", ".join(f"{name}={value}" for name, value in settings))


def canonical_host(host: str) -> str:
    """A host's name or address in its one spelling; names are not looked up."""
    try:
        address = ip_address(host.strip("[]"))
    except ValueError:
        return host.lower().rstrip(".")
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return LOCALHOST if str(address) in ("127.0.0.1", "::1") else str(address)


def is_name(host: str) -> bool:
    """Whether a canonical host has to be looked up for its addresses."""
    try:
        ip_address(host)
    except ValueError:
        return host != LOCALHOST
    return False


def canonical_port(port: str) -> str:
    """A serial port behind links such as those in /dev/serial/by-id. What is no
    path, as a URL of pyserial's, stays."""
    if "://" in port or "\0" in port:
        return port
    return os.path.normcase(os.path.realpath(port))
