"""Commercial devices, written from what their vendors publish: what they send, and what they take. Their axes turn from
one rest to the next by the clock."""

from __future__ import annotations

import math
import random
import socketserver
import struct
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import can

HELD_S, TURN_S, POSES, NOISE_G = 1.1, 0.35, 14, 1e-3
G = 9.80665
SCALE = (1.012, 0.991, 1.021)
MISALIGNMENT = (0.004, -0.006, 0.005)
BIAS_G = (0.021, -0.034, 0.015)
"""u = K (R a + b), R = [[1, z, y], [0, 1, x], [0, 0, 1]] of the misalignments x, y, z."""


def direction(number: int) -> tuple[float, float, float]:
    """Evenly over the sphere, one after the other."""
    z = 1 - (2 * (number % POSES) + 1) / POSES
    angle, r = number % POSES * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
    return r * math.cos(angle), r * math.sin(angle), z


def acceleration(seconds: float) -> list[float]:
    number, since_s = divmod(seconds, HELD_S + TURN_S)
    part = max(since_s - HELD_S, 0.0) / TURN_S
    return [(1 - part) * a + part * b for a, b in zip(direction(int(number)), direction(int(number) + 1), strict=True)]


def _since(begun_s: float) -> float:
    return time.monotonic() - begun_s


@dataclass
class Sensor:
    """Three axes with errors, in g. ``age_s`` is the time by which it turns, by default the real one."""

    age_s: Callable[[], float] = field(default_factory=lambda: partial(_since, time.monotonic()))
    noise: random.Random = field(default_factory=lambda: random.Random(1))

    def output_g(self, offset: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[float]:
        """What it shows now, ``offset`` subtracted as by its registers."""
        x, y, z = acceleration(self.age_s())
        mx, my, mz = MISALIGNMENT
        sensed = (x + mz * y + my * z, y + mx * z, z)
        return [
            k * (a + b + self.noise.gauss(0, NOISE_G)) - o
            for k, a, b, o in zip(SCALE, sensed, BIAS_G, offset, strict=True)
        ]


Frames = list[tuple[int, bool, bytes]]
"""Identifier, whether it has 29 bits, data."""


class Sender(can.Listener):
    """A device on a virtual CAN bus of this process that sends ``cycle(number)`` a hundred times a second, or less
    often on a busy machine: it turns by its samples, so that each pose has as many. ``commands`` are the frames that it
    hears."""

    PERIOD_S = 0.01

    def __init__(self, channel: str) -> None:
        self.commands: list[bytes] = []
        self.sent = 0
        self.sensor = Sensor(lambda: self.sent * self.PERIOD_S)
        self._bus = can.Bus(channel, interface="virtual")
        self._notifier = can.Notifier(self._bus, [self])
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def cycle(self, number: int) -> Frames:
        raise NotImplementedError

    def takes(self, msg: can.Message) -> bool:
        return False

    def on_message_received(self, msg: can.Message) -> None:
        if self.takes(msg):
            self.commands.append(bytes(msg.data))

    def _run(self) -> None:
        next_s, number = time.monotonic(), 0
        while not self._stop.wait(max(next_s - time.monotonic(), 0)):
            for identifier, extended, data in self.cycle(number):
                self._bus.send(can.Message(arbitration_id=identifier, is_extended_id=extended, data=data))
            number, next_s = number + 1, max(next_s + self.PERIOD_S, time.monotonic())
            self.sent = number

    def __enter__(self) -> Sender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._notifier.stop()
        self._bus.shutdown()


class WitMotionCan(Sender):
    """HWT901B-CAN: 10 Hz as delivered, and 100 Hz after FF AA 03 09 00 when it is unlocked."""

    def takes(self, msg: can.Message) -> bool:
        return msg.arbitration_id == 0x50 and bytes(msg.data[:2]) == b"\xff\xaa"

    def cycle(self, number: int) -> Frames:
        unlocked = bytes.fromhex("FFAA6988B5") in self.commands
        fast = unlocked and bytes.fromhex("FFAA030900") in self.commands
        if not fast and number % 10:
            return []
        raw = [round(a / 16 * 32768) for a in self.sensor.output_g()]
        return [
            (0x50, False, struct.pack("<BB3h", 0x55, 0x51, *raw)),
            (0x50, False, struct.pack("<BB3h", 0x55, 0x52, 1, 2, 3)),
            (0x50, False, struct.pack("<BB3h", 0x55, 0x53, 4, 5, 6)),
        ]


class BoschMm710(Sender):
    """Three messages without a counter."""

    def cycle(self, number: int) -> Frames:
        ax, ay, az = (round((a + 4.1767731) / 0.000127465) for a in self.sensor.output_g())
        return [(i, False, struct.pack("<HHHH", 32768, 0, a, 0)) for i, a in ((0x174, ay), (0x178, ax), (0x17C, az))]


class XsensMti600(Sender):
    """Big-endian messages: the time, the group counter, the accelerations; the temperature once a second."""

    def cycle(self, number: int) -> Frames:
        raw = [round(G * a * 256) for a in self.sensor.output_g()]
        frames = [
            (0x005, False, struct.pack(">I", (2**32 - 3_000_000 + 10_000 * number) % 2**32)),
            (0x006, False, struct.pack(">H", (65_000 + number) % 2**16)),
            (0x034, False, struct.pack(">3h", *raw)),
        ]
        return frames if number % 100 else [(0x051, False, struct.pack(">h", round(24.5 * 256))), *frames]


class SbgEllipse(Sender):
    """Time and temperature, then the accelerations of 0.01 m/s²."""

    def cycle(self, number: int) -> Frames:
        raw = [round(G * a / 0.01) for a in self.sensor.output_g()]
        info = struct.pack("<IHh", 10_000 * number, 0, 2450)
        return [(0x120, False, info), (0x121, False, struct.pack("<3h", *raw))]


class HoneywellTars(Sender):
    """J1939, group 61485 of source 0xE2; another source sends the same group. A sample in fifty is invalid."""

    def cycle(self, number: int) -> Frames:
        lon, lat, ver = (round((G * a + 320) / 0.01) for a in self.sensor.output_g())
        state = 0b00_01_00 if number % 50 == 7 else 0
        own = struct.pack("<HHHBB", lat, lon, ver, state, 0xFF)
        stranger = struct.pack("<HHHBB", 1, 2, 3, 0, 0xFF)
        return [(2 << 26 | 61485 << 8 | 0x17, True, stranger), (2 << 26 | 61485 << 8 | 0xE2, True, own)]


Registers = dict[int, int]


class ModbusWords:
    """A Modbus TCP server of holding and input registers. ``words(function, address)`` is a word, None where there is
    none; ``write`` takes a single one; another function than 3, 4 and 6 is exception 1."""

    def __init__(
        self, words: Callable[[int, int], int | None], write: Callable[[int, int], bool] = lambda *_: False
    ) -> None:
        self._words, self._write = words, write

    def __enter__(self) -> ModbusWords:
        outer = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                held = b""
                while got := self.request.recv(4096):
                    held += got
                    while len(held) >= 6 and len(held) >= 6 + (size := struct.unpack(">H", held[4:6])[0]):
                        head, pdu, held = held[:7], held[7 : 6 + size], held[6 + size :]
                        reply = outer.answer(pdu)
                        self.request.sendall(head[:4] + struct.pack(">H", len(reply) + 1) + head[6:7] + reply)

        self._server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    @property
    def bus(self) -> Mapping[str, Any]:
        return {"host": "127.0.0.1", "port": self._server.server_address[1]}

    def answer(self, pdu: bytes) -> bytes:
        function, address, number = struct.unpack(">BHH", pdu[:5])
        if function == 6:
            return pdu if self._write(address, number) else bytes([0x86, 2])
        if function not in (3, 4):
            return bytes([0x80 | function, 1])
        words = [self._words(function, address + i) for i in range(number)]
        if None in words:
            return bytes([0x80 | function, 2])
        return bytes([function, 2 * number]) + b"".join(struct.pack(">H", w) for w in words if w is not None)


class WitMotion485(ModbusWords):
    """WT901C485: function 6 only; the accelerations are corrected by the offsets 0x05 to 0x07. A key opens the
    configuration for ten seconds; 0 at 0x00 stores it, 0xFF restarts."""

    SERIAL = b"WT5300001234"

    def __init__(self) -> None:
        super().__init__(self._word, self._take)
        self.sensor = Sensor()
        self.stored: Registers = {5: 0, 6: 0, 7: 0}
        self.in_use, self._open_until_s = dict(self.stored), 0.0

    def restart(self) -> None:
        self.in_use, self._open_until_s = dict(self.stored), 0.0

    def _word(self, function: int, address: int) -> int | None:
        if function != 3:
            return None
        if address in self.in_use:
            return self.in_use[address] & 0xFFFF
        if 0x34 <= address <= 0x36:
            x, y, z = (struct.unpack("h", struct.pack("H", self.in_use[a] & 0xFFFF))[0] * 1e-4 for a in (5, 6, 7))
            return round(self.sensor.output_g((x, y, z))[address - 0x34] / 16 * 32768) & 0xFFFF
        if 0x7F <= address <= 0x84:
            low, high = self.SERIAL[2 * (address - 0x7F) :][:2]
            return high << 8 | low
        return 2450 if address == 0x40 else 0 if address < 0x90 else None

    def _take(self, address: int, value: int) -> bool:
        if address == 0x69:
            self._open_until_s = time.monotonic() + 10 if value == 0xB588 else 0.0
            return True
        if time.monotonic() > self._open_until_s or address not in (0, 5, 6, 7):
            return False
        if address:
            self.in_use[address] = value
        elif value == 0:
            self.stored = dict(self.in_use)
        elif value == 0xFF:
            self.restart()
        return True


class MoxaE1240(ModbusWords):
    """Scaled values of its inputs as floats from input register 8, high word first; at them an analog sensor of 1 V/g
    that shows 2.5 V at 0 g."""

    def __init__(self) -> None:
        super().__init__(self._word)
        self.sensor = Sensor()
        self._held = b""

    def _word(self, function: int, address: int) -> int | None:
        if function != 4 or not 8 <= address < 16:
            return None
        if address == 8:
            self._held = struct.pack(">4f", *(2.5 + a for a in self.sensor.output_g()), 0.0)
        return int(struct.unpack(">H", self._held[2 * (address - 8) :][:2])[0])
