"""What recording and reading cost beside python-can's loggers, in one run: `python -m benchmarks.recorder`.

The frames are those of a golden recording's unit, again and again, at their own times; all programs have the same
ones. Processor time is that of the process with all its threads, the least of several runs.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

import can
import cantools
import numpy as np
from mcap.writer import Writer as McapWriter

from benchmarks.table import Table, chosen
from triaxcal_drivers.catalogue import BUILT_IN, driver_named
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald.inputs import bundle_of
from triaxcald.recording.bus import batches_of, messages_of, row_of
from triaxcald.recording.python_can import BATCH, RecordingMessageReader, RecordingMessageWriter
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter

GOLDEN = Path(__file__).parents[1] / "recordings" / "can-second-order.mcap"
GROUP = "239.74.163.2"
LAST = 0x7FE  # the identifier that ends a reception
RATE_HZ = 1000  # what a Python sender keeps up with beside four receivers on two processors


class Writer(Protocol):
    """What python-can's loggers and ours have in common."""

    def __call__(self, message: can.Message, /) -> None: ...

    def stop(self) -> None: ...


class McapMessageWriter:
    """One MCAP message a frame, as loggers of other fields write them: identifier, flags and data."""

    def __init__(self, path: Path) -> None:
        self._file = open(path, "wb")  # noqa: SIM115 -- closed by stop
        self._mcap = McapWriter(self._file)
        self._mcap.start()
        self._channel = self._mcap.register_channel("/can", "", 0)

    def __call__(self, message: can.Message) -> None:
        time_ns = round(message.timestamp * 1e9)
        data = message.arbitration_id.to_bytes(4, "little") + bytes([message.is_extended_id]) + message.data
        self._mcap.add_message(self._channel, time_ns, data, time_ns)

    def stop(self) -> None:
        self._mcap.finish()
        self._file.close()


WRITERS: dict[str, tuple[str, Callable[[Path], Writer]]] = {
    "triaxcal, as a plugin of python-can": ("mcap", RecordingMessageWriter),
    "python-can BLF": ("blf", can.BLFWriter),
    "python-can ASC": ("asc", can.ASCWriter),
    "mcap, a message a frame": ("mcap", McapMessageWriter),
}


def frames(count: int) -> list[can.Message]:
    """The unit's frames, repeated, each time later and with a counter that goes on as it did."""
    with Recording.open(GOLDEN) as recording:
        once = [m for m in messages_of(recording) if not m.is_remote_frame]
    span_s = once[-1].timestamp - once[0].timestamp + 1e-3
    return [_later(once[i % len(once)], span_s * (i // len(once))) for i in range(count)]


def _later(m: can.Message, by_s: float) -> can.Message:
    return can.Message(m.timestamp + by_s, m.arbitration_id, m.is_extended_id, data=m.data, channel=0)


def spent_s(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def written(make: Callable[[Path], Writer], path: Path, messages: Sequence[can.Message]) -> float:
    """Processor seconds."""
    path.unlink(missing_ok=True)

    def work() -> None:
        writer = make(path)
        for message in messages:
            writer(message)
        writer.stop()

    return spent_s(work)


def recorded(path: Path, batches: Sequence[tuple[str, RawBatch]]) -> float:
    """As `record` does it: whole batches, which come from the bus as they are."""
    path.unlink(missing_ok=True)

    def work() -> None:
        with RecordingWriter(path, metadata={"bus": {}}, preview_channels=None, waits=True) as writer:
            for phase, batch in batches:
                writer.raw(phase, batch)

    return spent_s(work)


def writing(count: int, runs: int, folder: Path) -> Table:
    messages = frames(count)
    step = BATCH // 4
    rows = [[value for m in messages[i : i + step] for value in row_of(m)] for i in range(0, count, step)]
    batches = [piece for values in rows for piece in batches_of(values)]
    least: dict[str, float] = {}
    size: dict[str, int] = {}
    for _ in range(runs):
        name, path = "triaxcal, batches of 256 frames", folder / "batches.mcap"
        least[name] = min(least.get(name, np.inf), recorded(path, batches))
        size[name] = path.stat().st_size
        for name, (suffix, make) in WRITERS.items():
            path = folder / f"{make.__name__}.{suffix}"
            least[name] = min(least.get(name, np.inf), written(make, path, messages))
            size[name] = path.stat().st_size
    told = [[n, f"{1e6 * s / count:.2f}", f"{size[n] / count:.1f}"] for n, s in least.items()]
    return Table(f"Writing {count} frames", ["program", "s a million frames", "bytes a frame"], told)


def reading(count: int, runs: int, folder: Path) -> Table:
    messages = frames(count)
    ours, blf = folder / "read.mcap", folder / "read.blf"
    written(RecordingMessageWriter, ours, messages)
    written(can.BLFWriter, blf, messages)
    with Recording.open(GOLDEN) as recording:
        bundle = bundle_of(recording)
    database = cantools.database.load_file(BUILT_IN / "triax-ref-can.dbc")
    known = {message.frame_id: message for message in database.messages}
    decoded = {"triaxcal": 0, "python-can": 0}

    def by_us() -> None:
        decoders = [driver_named("can").decoder(bundle, stream) for stream in (READINGS, CORRECTED)]
        decoded["triaxcal"] = 0
        with Recording.open(ours) as recording:
            for _, batch in recording.raw_batches():
                decoded["triaxcal"] += sum(len(decoder.feed(batch)) for decoder in decoders)

    def by_cantools() -> None:
        decoded["python-can"] = 0
        for message in can.BLFReader(blf):
            if (kind := known.get(message.arbitration_id)) is not None:
                kind.decode(message.data, decode_choices=False)
                decoded["python-can"] += 1

    works: dict[str, Callable[[], object]] = {
        "triaxcal: Recording, CanDecoder": by_us,
        "python-can: BLFReader, cantools": by_cantools,
        "triaxcal: can.LogReader": lambda: sum(1 for _ in RecordingMessageReader(ours)),
        "python-can: can.LogReader of a BLF": lambda: sum(1 for _ in can.BLFReader(blf)),
    }
    least = {name: min(spent_s(work) for _ in range(runs)) for name, work in works.items()}
    told = [f"{decoded['triaxcal']} samples of two messages", f"{decoded['python-can']} messages", "", ""]
    rows = [[n, f"{1e6 * s / count:.2f}", what] for (n, s), what in zip(least.items(), told, strict=True)]
    return Table(f"Reading {count} frames", ["program", "s a million frames", "decoded"], rows)


def receiving(seconds: float, rounds: int, folder: Path) -> Table | None:
    """All programs at once on one multicast group, each in a process of its own: the round in which each spent least.
    None where there is no multicast."""
    least: dict[str, tuple[float, int, float]] = {}
    for number in range(rounds):
        (folder / str(number)).mkdir()
        found = _round(round(seconds * RATE_HZ), folder / str(number))
        if found is None:
            return None
        least = {name: min(least.get(name, one), one) for name, one in found.items()}
    rows = [[n, f"{lost}", f"{1e6 * cpu_s:.1f}", f"{size:.1f}"] for n, (cpu_s, lost, size) in least.items()]
    head = ["program", "frames lost", "s a million frames", "bytes a frame"]
    title = f"Receiving {RATE_HZ} frames a second for {seconds:g} s over udp_multicast by python-can"
    return Table(title, head, rows)


def _round(count: int, folder: Path) -> dict[str, tuple[float, int, float]] | None:
    """Of each program: processor seconds a frame, frames lost, bytes a frame."""
    port = _free_port()
    started = {
        name: subprocess.Popen(
            [sys.executable, "-m", "benchmarks.recorder", "--receive", name, str(folder), str(port)],
            stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1],
        )
        for name in WRITERS
    }  # fmt: skip
    found = {}
    try:
        for process in started.values():
            assert process.stdout is not None
            if process.stdout.readline() != "ready\n":
                return None
        _send(count, port)
        for name, process in started.items():
            got, cpu_s, size = map(float, process.communicate(timeout=60)[0].split())
            found[name] = cpu_s / got, count - round(got), size / got
    finally:
        for process in started.values():
            process.kill()
            process.wait()
    return found


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("", 0))
        return int(s.getsockname()[1])


def _send(count: int, port: int) -> None:
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as bus:
        begin = time.monotonic()
        for i, message in enumerate(frames(count)):
            if (ahead_s := begin + i / RATE_HZ - time.monotonic()) > 0.01:
                time.sleep(ahead_s)
            bus.send(message)
        for _ in range(5):  # one may be lost
            time.sleep(0.1)
            bus.send(can.Message(arbitration_id=LAST, is_extended_id=False))


def receive(name: str, folder: Path, port: int) -> None:
    """What `can_logger` does, and what it cost from the first frame to the end of the file."""
    suffix, make = WRITERS[name]
    path = folder / f"received-{make.__name__}.{suffix}"
    with can.Bus(interface="udp_multicast", channel=GROUP, port=port) as bus:
        writer = make(path)
        print("ready", flush=True)
        messages = _until_last(bus)
        before = time.process_time()
        got = 0
        for message in messages:
            writer(message)
            got += 1
        writer.stop()
        print(got, time.process_time() - before, path.stat().st_size)


def _until_last(bus: can.BusABC) -> Iterator[can.Message]:
    timeout_s = 60.0  # until the others are ready too
    while (message := bus.recv(timeout_s)) is not None and message.arbitration_id != LAST:
        yield message
        timeout_s = 5.0


def main(arguments: list[str] | None = None) -> int:
    told = sys.argv[1:] if arguments is None else arguments
    if told[:1] == ["--receive"]:
        receive(told[1], Path(told[2]), int(told[3]))
        return 0
    quick = chosen(__doc__, told)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print(writing(50_000 if quick else 300_000, 2 if quick else 5, folder))
        print(reading(20_000 if quick else 100_000, 2 if quick else 3, folder))
        print(
            receiving(2.0 if quick else 5.0, 1 if quick else 4, folder)
            or "\n### Receiving: there is no udp_multicast here"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
