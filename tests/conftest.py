"""A workshop for tests of the whole program: station and device files, simulated units, commands and their outcome."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from tests.virtual_line import described, virtual_line
from triaxcald.cli.commands import main
from triaxcald.simulation.bench import load_device, physics_of, simulate
from triaxcald.simulation.unit import Faults, ReferenceUnit
from triaxcald.station.lock import FOLDER_VARIABLE

hypothesis.settings.register_profile("patient", deadline=None)  # a busy machine is no fault of the code
hypothesis.settings.load_profile("patient")

SLOW_FIXTURES = {"finished_run"}
"""Each worker that runs a test with one of these makes it once, which takes half a minute."""


def pytest_itemcollected(item: pytest.Item) -> None:
    if SLOW_FIXTURES.intersection(getattr(item, "fixturenames", ())):
        item.add_marker(pytest.mark.slow)


FIXTURE = {"poses": 14, "hold_s": 2.0, "move_s": 0.8}
PLAN = {"poses": 14, "hold_s": 1.0, "check_poses": 3}
SERIAL = 4711


def toml(value: Any) -> str:
    """A TOML value, tables inline."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def _lines(values: Mapping[str, Any]) -> str:
    return "".join(f"{k} = {toml(v)}\n" for k, v in values.items())


PROGRESS = re.compile(r"^.*(?:, \d+%)? \(\d+ s\)\n", re.MULTILINE)
"""Lines of progress, which a slow machine writes and a fast one does not; `test_progress_line` checks them."""


@dataclass(frozen=True)
class Done:
    """What a command left: its exit code and its two streams."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one document on standard output."""
        return json.loads(self.out)

    def failed(self, code: int, *words: str) -> None:
        """One line on standard error that holds ``words``, nothing on standard output."""
        assert self.code == code, self
        assert self.out == ""
        assert self.err.endswith("\n")
        last = self.err.splitlines()[-1]
        assert last.startswith("triaxcal")
        assert "Traceback" not in self.err
        for word in words:
            assert word in last, f"'{word}' is not in: {last}"


@dataclass
class Served:
    """A simulated unit at work on a thread of its own. ``bus`` reaches it."""

    unit: ReferenceUnit
    bus: dict[str, Any]


class Workshop:
    """Files and units in one folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def device(self, name: str = "device.toml", **settings: Any) -> Path:
        values = {
            "format": "triaxcal.device/1",
            "profile": "triax-ref-modbus",
            "serial": SERIAL,
            "speed": 20.0,
            "seed": 3,
            "bus": {"host": "127.0.0.1", "port": 0},
            "fixture": FIXTURE,
            **settings,
        }
        return self.write(name, _lines(values))

    def station(self, *units: Mapping[str, Any], name: str = "station.toml", **settings: Any) -> Path:
        values = {"format": "triaxcal.station/1", "name": "bench", "plan": PLAN, **settings}
        text = _lines(values)
        for i, unit in enumerate(units):
            text += "\n[[units]]\n" + _lines({"name": f"unit{i}", "profile": "triax-ref-modbus", **unit})
        return self.write(name, text)

    def write(self, name: str, content: str | bytes) -> Path:
        path = self.folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    def impatient_profile(self, name: str = "triax-ref-modbus") -> str:
        """A copy of a built-in profile, beside the station file, that waits for a reply no longer than it must."""
        from triaxcal_drivers.catalogue import BUILT_IN

        text = (BUILT_IN / f"{name}.toml").read_text()
        lines = [line for line in text.splitlines() if not line.startswith(("silence_timeout_s", "reply_timeout_s"))]
        at = lines.index("[sampling]") + 1
        lines[at:at] = ["silence_timeout_s = 0.5", "reply_timeout_s = 0.3"]
        lines = [line.replace("{ reconnect = true }", "{ reconnect = true, timeout_s = 1.0 }") for line in lines]
        for beside in BUILT_IN.glob(f"{name}.*"):
            shutil.copy(beside, self.folder)
        return self.write(f"{name}-impatient.toml", "\n".join(lines) + "\n").name

    @contextlib.contextmanager
    def serve(self, device: Path, faults: Faults | None = None, stored: bytes | None = None) -> Iterator[Served]:
        """The unit of a device file on its bus, on a thread with an event loop of its own."""
        ready: threading.Event = threading.Event()
        box: dict[str, Any] = {}

        async def work() -> None:
            simulated = simulate(load_device(device), where=str(device), stored=stored)
            if faults is not None:
                simulated.unit = ReferenceUnit(
                    physics_of(simulated.device),
                    serial_number=simulated.device.serial,
                    stored=stored,
                    faults=faults,
                )
            stop = asyncio.Event()
            async with simulated.serve() as server:
                bus = dict(simulated.device.bus)
                if "port" in bus:
                    bus["port"] = server.bus.port
                box.update(served=Served(simulated.unit, bus), loop=asyncio.get_running_loop(), stop=stop)
                ready.set()
                await stop.wait()

        def run() -> None:
            try:
                asyncio.run(work())
            except BaseException as e:  # noqa: BLE001 - it goes on in the test's own thread
                box["failure"] = e
                ready.set()

        thread = threading.Thread(target=run)
        thread.start()
        ready.wait()
        try:
            if "failure" in box:
                raise box["failure"]
            yield box["served"]
        finally:
            if "loop" in box:
                with contextlib.suppress(RuntimeError):  # it has come to its end by itself
                    box["loop"].call_soon_threadsafe(box["stop"].set)
            thread.join()


@pytest.fixture(scope="session", autouse=True)
def _locks_of_this_test_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Apart from those of other test runs on this machine, whose stations have the same places."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(FOLDER_VARIABLE, str(tmp_path_factory.mktemp("locks")))
        yield


@pytest.fixture
def workshop(tmp_path: Path) -> Workshop:
    return Workshop(tmp_path)


@pytest.fixture
def triaxcal(capsys: pytest.CaptureFixture[str]) -> Callable[..., Done]:
    """Runs one command in this process."""

    def run(*arguments: Any) -> Done:
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Done(code, captured.out, PROGRESS.sub("", captured.err))

    return run


@dataclass(frozen=True)
class FinishedRun:
    """A station's run that went well, on disk: not to be changed."""

    folder: Path
    document: Mapping[str, Any]

    def unit(self, name: str) -> Mapping[str, Any]:
        return next(u for u in self.document["units"] if u["unit"] == name)

    def recording(self, name: str) -> Path:
        return Path(self.unit(name)["recording"])

    @property
    def can(self) -> Path:
        return self.recording("can")

    @property
    def modbus(self) -> Path:
        return self.recording("modbus")


HIDDEN = {"second_order_nonlinearity": {"x": 5e-4, "y": -4e-4, "z": 3e-4}}


def _run_station(folder: Path) -> None:
    """On a virtual clock: of the same samples each time."""
    workshop = Workshop(folder)
    can_bus = {"interface": "virtual", "channel": "finished-run", "node_id": 5}
    modbus_bus = {"host": "127.0.0.1", "port": 502}
    sensor = {"effects": HIDDEN}
    fixture = {**FIXTURE, "poses": 26}
    can = workshop.device("can.toml", profile="triax-ref-can", bus=can_bus, sensor=sensor, fixture=fixture)
    modbus = workshop.device("modbus.toml", bus=modbus_bus, serial=4712, seed=4, fixture=fixture)
    station = workshop.station(
        {"name": "can", "profile": "triax-ref-can", "serial": "4711", "bus": can_bus},
        {"name": "modbus", "serial": "4712", "bus": modbus_bus},
        plan={**PLAN, "poses": 26},
        limits={"rms_g": 1e-4, "verification_rms_g": 1e-4},
    )
    out, err = io.StringIO(), io.StringIO()
    units = described(can), described(modbus)
    with virtual_line(*units), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(["run", str(station), "--json"])
    assert code == 0, (out.getvalue(), err.getvalue())
    (folder / "run.json").write_text(out.getvalue())


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Makes a folder's contents once for all workers of this test run."""

    def folder_of(name: str, make: Callable[[Path], None]) -> Path:
        base = tmp_path_factory.getbasetemp()
        shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        folder = shared / name
        with open(shared / f"{name}.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / "made").exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                (folder / "made").touch()
        return folder

    return folder_of


@pytest.fixture
def asked(triaxcal: Callable[..., Done], once: Callable[..., Path]) -> Callable[..., Done]:
    """Runs a command that writes nothing, on files that stay as they are: once for all tests that ask the same."""

    def ask(*arguments: Any) -> Done:
        words = [str(a) for a in arguments]

        def make(folder: Path) -> None:
            (folder / "done.json").write_text(json.dumps(asdict(triaxcal(*words))), "utf-8")

        folder = once(f"asked-{hashlib.sha256(json.dumps(words).encode()).hexdigest()[:24]}", make)
        return Done(**json.loads((folder / "done.json").read_text("utf-8")))

    return ask


@pytest.fixture(scope="session")
def finished_run(once: Callable[..., Path]) -> FinishedRun:
    folder = once("finished-run", _run_station)
    return FinishedRun(folder, json.loads((folder / "run.json").read_text()))


def _same_message(topic: str, data: bytes) -> bytes:
    return data


def _same_attachment(name: str, data: bytes) -> bytes:
    return data


def _same_metadata(name: str, record: dict[str, str]) -> dict[str, str]:
    return record


def _rewrite(
    source: Path,
    out: Path,
    *,
    message: Callable[[str, bytes], bytes] = _same_message,
    attachment: Callable[[str, bytes], bytes | None] = _same_attachment,
    metadata: Callable[[str, dict[str, str]], dict[str, str]] = _same_metadata,
) -> Path:
    """The recording written anew by mcap's own writer, every checksum of the file right."""
    with open(source, "rb") as file:
        header = make_reader(file).get_header()
    with open(source, "rb") as file, open(out, "wb") as sink:
        writer = Writer(sink, enable_data_crcs=True)
        writer.start(profile=header.profile)
        for record in StreamReader(file).records:
            if isinstance(record, Attachment) and (data := attachment(record.name, record.data)) is not None:
                writer.add_attachment(record.create_time, record.log_time, record.name, record.media_type, data)
            elif isinstance(record, Metadata):
                writer.add_metadata(record.name, metadata(record.name, dict(record.metadata)))
        with open(source, "rb") as again:
            channels: dict[int, int] = {}
            for kind, channel, held in make_reader(again).iter_messages(log_time_order=False):
                if channel.id not in channels:
                    assert kind is not None
                    schema_id = writer.register_schema(kind.name, kind.encoding, kind.data)
                    channels[channel.id] = writer.register_channel(
                        channel.topic, channel.message_encoding, schema_id, channel.metadata
                    )
                data = message(channel.topic, held.data)
                writer.add_message(channels[channel.id], held.log_time, data, held.publish_time, held.sequence)
        writer.finish()
    return out


@pytest.fixture
def rewrite(tmp_path: Path) -> Callable[..., Path]:
    return lambda source, **changes: _rewrite(source, tmp_path / f"rewritten-{source.name}", **changes)
