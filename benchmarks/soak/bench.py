"""Which units stand on the bench, where, and the files that say so."""

from __future__ import annotations

import json
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triaxcal_drivers.catalogue import BUILT_IN

GROUP = "239.74.163.2"
BAUDRATE = 460_800
REPLY_S = 0.5
"""Patience with a reply. As much later it may still come, as the driver has it on a serial line."""
SILENCE_S = 2.0
POLL_S = 0.2
RATE_HZ = {"can": 100.0, "modbus": 25.0}
"""A count of 16 bits begins anew within the soak at the first; requests of the built-in profile's rate and pace would
cost a processor core."""


@dataclass(frozen=True)
class Unit:
    """``address`` is a CAN node or a Modbus unit."""

    name: str
    bus: str
    address: int
    serial: int

    @property
    def kind(self) -> str:
        return "can" if self.bus == "can" else "modbus"


def units_of(on_can: int) -> tuple[Unit, ...]:
    can = [Unit(f"can{n}", "can", n, 100 + n) for n in range(1, on_can + 1)]
    rtu = [Unit(f"rtu{n}", "rtu", n, 200 + n) for n in (1, 2)]
    tcp = [Unit(f"tcp{n}", "tcp", n, 300 + n) for n in (1, 2)]
    return (*can, *rtu, *tcp)


@dataclass(frozen=True)
class Bench:
    folder: Path
    units: tuple[Unit, ...]
    can_port: int
    tcp_port: int
    metrics_port: int

    @classmethod
    def made(cls, folder: Path, on_can: int) -> Bench:
        """With station file, profiles and a description that `loaded` reads."""
        tcp_port, metrics_port = _free_port(socket.SOCK_STREAM), _free_port(socket.SOCK_STREAM)
        bench = cls(folder, units_of(on_can), _free_port(socket.SOCK_DGRAM), tcp_port, metrics_port)
        for needed in (bench.recordings, bench.locks):
            needed.mkdir(parents=True)
        for kind in ("can", "modbus"):
            _profile(folder, kind)
        bench.station.write_text(bench._station(), "utf-8")
        said = {"on_can": on_can, "ports": [bench.can_port, bench.tcp_port, bench.metrics_port]}
        (folder / "bench.json").write_text(json.dumps(said), "utf-8")
        return bench

    @classmethod
    def loaded(cls, folder: Path) -> Bench:
        said = json.loads((folder / "bench.json").read_text("utf-8"))
        return cls(folder, units_of(said["on_can"]), *said["ports"])

    @property
    def station(self) -> Path:
        return self.folder / "station.toml"

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    @property
    def locks(self) -> Path:
        """Of this bench alone: another one on the machine has the same nodes."""
        return self.folder / "locks"

    @property
    def line(self) -> Path:
        """The serial port."""
        return self.folder / "rs485"

    def sent_by(self, unit: Unit) -> Path:
        """Where what the unit sends is written down."""
        return self.folder / f"{unit.name}.sent"

    def manifest(self, unit: Unit) -> Path:
        return self.recordings / f"{unit.name}-{unit.serial:04d}.segments.json"

    def settings(self, unit: Unit) -> dict[str, Any]:
        """Of the unit's bus, as a station has them."""
        if unit.bus == "can":
            place = {"interface": "udp_multicast", "channel": GROUP, "node_id": unit.address}
            return {**place, "options": {"port": self.can_port}}
        if unit.bus == "rtu":
            port = {"serial_port": str(self.line), "baudrate": BAUDRATE, "parity": "N"}
            return {**port, "unit_id": unit.address}
        return {"host": "127.0.0.1", "port": self.tcp_port, "unit_id": unit.address}

    def _station(self) -> str:
        text = 'format = "triaxcal.station/1"\nname = "soak"\n'
        for unit in self.units:
            text += f'\n[[units]]\nname = "{unit.name}"\nprofile = "{unit.kind}.toml"\nserial = "{unit.serial}"\n'
            text += f"bus = {_toml(self.settings(unit))}\n"
        return text


def _profile(folder: Path, kind: str) -> None:
    """The built-in one, with other times."""
    name = f"triax-ref-{kind}"
    lines = (BUILT_IN / f"{name}.toml").read_text("utf-8").splitlines()
    lines = [line for line in lines if not line.startswith(("silence_timeout_s", "reply_timeout_s"))]
    at = lines.index("[sampling]") + 1
    lines[at:at] = [f"silence_timeout_s = {SILENCE_S}", f"reply_timeout_s = {REPLY_S}"]
    lines = [f"rate_hz = {RATE_HZ[kind]}" if line.startswith("rate_hz") else line for line in lines]
    lines = [f"poll_period_s = {POLL_S}" if line.startswith("poll_period_s") else line for line in lines]
    (folder / f"{kind}.toml").write_text("\n".join(lines) + "\n", "utf-8")
    for beside in BUILT_IN.glob(f"{name}.*"):
        if beside.suffix != ".toml":
            shutil.copy(beside, folder)


def _toml(table: dict[str, Any]) -> str:
    inner = (f"{k} = {_toml(v) if isinstance(v, dict) else json.dumps(v)}" for k, v in table.items())
    return f"{{ {', '.join(inner)} }}"


def _free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])
