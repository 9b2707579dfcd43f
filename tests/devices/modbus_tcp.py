"""A Modbus TCP server of sockets and bytes."""

from __future__ import annotations

import contextlib
import selectors
import socket
import struct
from collections.abc import Mapping
from typing import Any

from tests.devices.modbus import ModbusUnit, damaged_pdu
from tests.devices.place import Reply
from tests.devices.serving import Serving

GARBAGE = ("function", "length", "transaction", "unit", "protocol", "truncated", "noise")
NOISE = bytes.fromhex("ff00 55aa 0001 fe")
HOST = "127.0.0.1"


class ModbusTcp(Serving):
    """Serves any number of connections on a free port, one request after the other."""

    def __init__(self, unit: ModbusUnit, *, unit_id: int = 1) -> None:
        super().__init__()
        self.unit = unit
        self.unit_id = unit_id
        self.port = 0
        self._buffers: dict[socket.socket, bytes] = {}
        self._listener: socket.socket | None = None
        self._seen_restarts = self._restarts()

    @property
    def bus(self) -> Mapping[str, Any]:
        """Where a master finds it, as a station file says it."""
        return {"host": HOST, "port": self.port, "unit_id": self.unit_id}

    def _open(self) -> None:
        # Keeps the port while nobody listens on it, so that connections are refused.
        self._reservation = _reusing(0)
        self.port = self._reservation.getsockname()[1]
        self._selector = selectors.DefaultSelector()
        self._alarm, self._woken = socket.socketpair()
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._listen()

    def _close(self) -> None:
        for connection in list(self._buffers):
            self._forget(connection)
        self._deafen()
        for s in (self._reservation, self._alarm, self._woken):
            s.close()
        self._selector.close()

    def _wake(self) -> None:
        self._alarm.send(b"!")

    def _hear(self, patience_s: float) -> bool:
        ready = self._selector.select(patience_s)
        for key, _ in ready:
            if key.fileobj is self._listener:
                self._accept()
            elif key.fileobj in self._buffers:
                self._receive(key.fileobj)
        self._notice_restarts()
        return bool(ready)

    def _listen(self) -> None:
        if self._listener is not None:
            return
        self._listener = _reusing(self.port)
        self._listener.listen()
        self._selector.register(self._listener, selectors.EVENT_READ)

    def _deafen(self) -> None:
        if self._listener is not None:
            self._selector.unregister(self._listener)
            self._listener.close()
            self._listener = None

    def _accept(self) -> None:
        assert self._listener is not None
        connection, _ = self._listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffers[connection] = b""
        self._selector.register(connection, selectors.EVENT_READ)

    def _receive(self, connection: socket.socket) -> None:
        try:
            received = connection.recv(4096)
        except OSError:
            received = b""
        if not received:
            self._forget(connection)
            return
        self._buffers[connection] += received
        while connection in self._buffers and (frame := self._next_frame(connection)):
            self._answer(connection, frame)

    def _next_frame(self, connection: socket.socket) -> bytes | None:
        buffer = self._buffers[connection]
        if len(buffer) < 8:
            return None
        _, protocol, length = struct.unpack(">HHH", buffer[:6])
        if protocol != 0 or not 2 <= length <= 254:
            self._forget(connection)
            return None
        if len(buffer) < 6 + length:
            return None
        self._buffers[connection] = buffer[6 + length :]
        return buffer[: 6 + length]

    def _answer(self, connection: socket.socket, frame: bytes) -> None:
        transaction, unit_id = struct.unpack(">H4xB", frame[:7])
        if unit_id != self.unit_id:
            return
        exchange = self.unit.exchange(frame[7:], self.now())
        for reply in exchange.replies:
            out = self.framed(reply, transaction)
            self.later(reply.after_s, lambda out=out: self._send(connection, out))  # type: ignore[misc]
        if exchange.drop:
            self._reset(connection)

    def framed(self, reply: Reply, transaction: int) -> bytes:
        """The reply with its MBAP header, damaged as it asks."""
        if reply.garbage is not None and reply.garbage not in GARBAGE:
            raise ValueError(f"Modbus TCP has no garbage '{reply.garbage}', only {', '.join(GARBAGE)}")
        pdu = damaged_pdu(reply.data, reply.garbage or "")
        wrong = {name: int(reply.garbage == name) for name in ("transaction", "protocol", "unit")}
        header = struct.pack(
            ">HHHB",
            (transaction + wrong["transaction"]) % 0x10000,
            wrong["protocol"],
            1 + len(pdu),
            self.unit_id + wrong["unit"],
        )
        if reply.garbage == "noise":
            return NOISE
        return (header + pdu)[: 5 if reply.garbage == "truncated" else None]

    def _send(self, connection: socket.socket, out: bytes) -> None:
        if connection in self._buffers:
            with contextlib.suppress(OSError):
                connection.sendall(out)

    def _notice_restarts(self) -> None:
        if self._restarts() == self._seen_restarts:
            return
        self._seen_restarts = self._restarts()
        trouble = self.unit.place.trouble
        if trouble.refuse_connections_s:  # first, so that whoever was dropped is refused
            self._deafen()
            self.later(trouble.refuse_connections_s, self._listen)
        if trouble.restart_drops:
            for connection in list(self._buffers):
                self._reset(connection)

    def _restarts(self) -> tuple[int, int]:
        unit = self.unit.place.unit
        return id(unit), unit.restarts

    def _reset(self, connection: socket.socket) -> None:
        """A close that does not linger sends RST."""
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._forget(connection)

    def _forget(self, connection: socket.socket) -> None:
        if self._buffers.pop(connection, None) is not None:
            self._selector.unregister(connection)
            connection.close()


def _reusing(port: int) -> socket.socket:
    s = socket.socket()
    s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    s.bind((HOST, port))
    return s
