"""A device served on a transport, with the files that a command needs to provision it.

with Bench(tmp_path, triaxcal, "rtu", habits=Habits(cut_at_byte=7, power_back_s=0.2)) as bench:
    done = bench.provision()
    assert bench.holds_old()
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Literal, Self, TypeVar

from tests.devices.canopen import CanopenNode
from tests.devices.habits import Habits
from tests.devices.memory import SERIAL_NUMBER, Electronics
from tests.devices.modbus import ModbusUnit
from tests.devices.modbus_rtu import ModbusRtu
from tests.devices.modbus_tcp import ModbusTcp
from tests.devices.motion import Motion
from tests.devices.place import Place, Trouble
from tests.devices.profiles import DBC_FILE, Timing, Wording, calibration_text, dbc_text, profile_text, station_text
from tests.devices.sdo import SdoServer
from tests.devices.table import NEW, OLD, Coefficients

DoneT = TypeVar("DoneT")
Transport = Literal["tcp", "rtu", "canopen"]
Server = ModbusTcp | ModbusRtu | CanopenNode
TRANSPORTS: tuple[Transport, ...] = ("tcp", "rtu", "canopen")
DAY_S = 86_400


@dataclass
class Bench(Generic[DoneT]):
    """``triaxcal`` runs a command in this process and gives what it left, as the fixture of that name does.

    ``serial_number`` is the unit's, ``serial`` the one that the station file demands, None for none. ``swapped`` is a
    unit that takes this one's place from a request on. ``node`` are further settings of `CanopenNode`: interface,
    channel, heartbeat_s… ``segmented``: the node sends also short objects in segments.
    """

    folder: Path
    triaxcal: Callable[..., DoneT]
    transport: Transport = "tcp"
    habits: Habits = field(default_factory=Habits)
    trouble: Trouble = field(default_factory=Trouble)
    timing: Timing = field(default_factory=Timing)
    wording: Wording = field(default_factory=Wording)
    motion: Motion = field(default_factory=Motion)
    before: Coefficients = OLD
    wanted: Coefficients = NEW
    serial_number: int | str = SERIAL_NUMBER
    serial: str | None = str(SERIAL_NUMBER)
    swapped: tuple[int, Electronics] | None = None
    node: Mapping[str, Any] = field(default_factory=dict)
    segmented: bool = False

    def __post_init__(self) -> None:
        self.unit = Electronics(self.habits, self.before.image(self.habits), self.serial_number)
        self.old = self.unit.eeprom
        """The calibration registers as they were at first, raw, most significant byte first."""
        self.place = Place(self.unit, self.trouble)
        if self.swapped:
            self.place.swap_at(*self.swapped)
        self.server = self._server()
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(self.server)
        driver: Literal["modbus", "can"] = "can" if self.transport == "canopen" else "modbus"
        self.profile = self._write("profile.toml", profile_text(driver, self.habits, self.timing, self.wording))
        if driver == "can":
            self._write(DBC_FILE, dbc_text())
        self.station = self._write("station.toml", station_text("profile.toml", self.server.bus, serial=self.serial))
        self.calibration = self._write("cal.json", calibration_text(self.wanted))
        return self

    def __exit__(self, *failure: Any) -> None:
        self._stack.__exit__(*failure)

    @property
    def new(self) -> dict[str, bytes]:
        """The calibration registers as they are to be after provisioning today."""
        return self.wanted.image(self.habits, date_days=int(time.time() // DAY_S))

    @property
    def journal(self) -> Path:
        """Where the journal of this unit lies while a provisioning of it is not settled."""
        return self.folder / "journal" / f"misbehaving_unit-{SERIAL_NUMBER}.json"

    # Commands.

    def provision(self, *arguments: Any) -> DoneT:
        return self.triaxcal("provision", self.calibration, self.station, *arguments)

    def registers(self, *arguments: Any) -> DoneT:
        return self.triaxcal("registers", self.station, *arguments)

    # What the unit would start with after a power cycle, once a store under way has come to its end.

    def starts_with(self) -> dict[str, bytes]:
        with self.place.lock:
            self.unit.advance(time.monotonic())
            return self.unit.starts_with()

    def holds_old(self) -> bool:
        return self.starts_with() == self.old

    def holds_new(self) -> bool:
        return self.starts_with() == self.new

    def holds_mixture(self) -> bool:
        """Neither the old calibration nor the new one."""
        return not (self.holds_old() or self.holds_new())

    # What a hand does.

    def power_cycle(self) -> None:
        with self.place.lock:
            self.unit.power_cycle(time.monotonic())

    def power_on(self) -> None:
        with self.place.lock:
            self.unit.power_on(time.monotonic())

    def _server(self) -> Server:
        if self.transport == "tcp":
            return ModbusTcp(ModbusUnit(self.place, self.motion))
        if self.transport == "rtu":
            return ModbusRtu(ModbusUnit(self.place, self.motion))
        return CanopenNode(SdoServer(self.place, segmented=self.segmented), motion=self.motion, **self.node)

    def _write(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text, "utf-8")
        return path
