"""CANopen nodes that the library canopen serves: SDO by its LocalNode, by the EDS of a manual. What a unit with an
accelerometer adds is here: its TPDO, by the mapping that it holds at the moment, and a power switch."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import canopen
import canopen.objectdictionary as od

BY_TIMER, BY_SYNC = 254, 1
SYNC = 0x080


class MappedNode:
    """A unit with one ``tpdo`` on a python-can bus of this process. ``value_of(index, subindex, s)`` is what an object
    holds, ``delivered`` what those of the mapping hold at first. What is written lasts until `restart`."""

    def __init__(
        self,
        channel: str,
        node_id: int,
        eds: Path,
        value_of: Callable[[int, int, float], int],
        delivered: Mapping[tuple[int, int], int],
        tpdo: int = 1,
    ) -> None:
        self._network = canopen.Network()
        self._network.connect(interface="virtual", channel=channel)
        self.node = canopen.LocalNode(node_id, str(eds))
        self.node.object_dictionary.add_object(_identity())
        self._network.add_node(self.node)
        self._network.subscribe(SYNC, self._on_sync)
        self._value_of, self._delivered, self._tpdo = value_of, delivered, tpdo
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self.sent = 0

    def __enter__(self) -> Self:
        self._begun_s = time.monotonic()
        self._network.send_message(0x700 + self.node.id, b"\0")
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._stop.set()
        self._thread.join()
        self._network.disconnect()

    def restart(self) -> None:
        """As its supply does."""
        self.node.data_store.clear()
        self._network.send_message(0x700 + self.node.id, b"\0")

    def _held(self, index: int, subindex: int) -> int:
        variable: Any = self.node.object_dictionary.get_variable(index, subindex)
        data = self.node.data_store.get(index, {}).get(subindex)
        if data is None:
            return self._delivered.get((index, subindex), int(variable.default or 0))
        return int.from_bytes(data, "little")

    def _run(self) -> None:
        while not self._stop.is_set():
            period_s = self._held(0x17FF + self._tpdo, 5) / 1000
            if self._held(0x17FF + self._tpdo, 2) == BY_TIMER and period_s:
                self._send()
            self._stop.wait(period_s or 0.01)

    def _on_sync(self, *_: object) -> None:
        if self._held(0x17FF + self._tpdo, 2) == BY_SYNC:
            self._send()

    def _send(self) -> None:
        if self.node.nmt.state not in ("OPERATIONAL", "INITIALISING"):  # it starts by itself
            return
        data, now_s = b"", time.monotonic() - self._begun_s
        for entry in range(1, self._held(0x19FF + self._tpdo, 0) + 1):
            word = self._held(0x19FF + self._tpdo, entry)
            octets = (word & 0xFF) // 8
            value = self._value_of(word >> 16, word >> 8 & 0xFF, now_s)
            data += value.to_bytes(octets, "little", signed=True)
        self.sent += 1
        self._network.send_message(0x80 + 0x100 * self._tpdo + self.node.id, data)


def _identity() -> od.ODRecord:
    """The identity object, which every node has (CiA 301)."""
    record = od.ODRecord("Identity", 0x1018)
    for subindex, value in enumerate((4, 86, 1, 1, 4711)):
        variable = od.ODVariable(f"identity {subindex}", 0x1018, subindex)
        variable.data_type, variable.default = od.UNSIGNED32, value
        variable.access_type = "ro"
        record.add_member(variable)
    return record
