"""How many frames on a simulated bus are still waiting for those that read it.

A real CAN bus holds a sender back: no frame goes over it faster than its bit
rate, and no controller is slower than that. The buses of software have no such
rate, and where a process that reads them gets no processor, frames pile up or
are lost. python-can's `virtual` bus has its queues in this process; of sockets
on this machine Linux tells what they hold. Of readers on other machines, and on
systems that tell nothing, nothing is known, and nobody is behind.
"""

from __future__ import annotations

import queue
from pathlib import Path
from typing import Any

import can

from triaxcal_drivers.can.model import CanBus

BEHIND_FRAMES = 256
"""In a queue: a batch of our own driver."""
BEHIND_BYTES = 1 << 15
"""In a socket, of the 200 KiB that it holds: some forty frames with what the
kernel keeps beside each."""
_SOCKETS = tuple(map(Path, ("/proc/net/udp", "/proc/net/udp6")))
_MULTICAST_PORT = 43113  # python-can's, where the options name none


def reader_is_behind(settings: CanBus, bus: can.BusABC) -> bool:
    """Whether somebody on the bus has much left to fetch; our own end counts
    too."""
    if settings.interface == "virtual":
        queues: list[queue.Queue[Any]] = getattr(bus, "channel", [])
        return any(q.qsize() > BEHIND_FRAMES for q in list(queues))
    if settings.interface == "udp_multicast":
        return waiting_bytes(int(dict(settings.options).get("port", _MULTICAST_PORT))) > BEHIND_BYTES
    return False


def waiting_bytes(port: int) -> int:
    """The most that any UDP socket on this port of this machine holds unread; 0
    where the system does not say."""
    most, here = 0, f":{port:04X}"
    for table in _SOCKETS:
        try:
            lines = table.read_text("ascii").splitlines()[1:]
        except OSError:
            continue
        for fields in map(str.split, lines):
            if fields[1].endswith(here):
                most = max(most, int(fields[4].partition(":")[2], 16))
    return most
