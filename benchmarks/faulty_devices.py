"""Devices with random faults, on a virtual clock: does what is said of them hold?

``python -m benchmarks.faulty_devices --count 10000 --seed 1`` draws devices (how they store, restart, answer and fail)
and lines (what gets lost, late, damaged, busy), provisions each, and compares what is said of the device with what it
would start with. A false sentence is printed with the seed that makes it again.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from benchmarks.table import Table
from tests.devices.habits import Habits
from tests.devices.in_memory import Errors, InMemoryDevice, VirtualClock
from tests.devices.memory import Electronics
from tests.devices.place import Place, Trouble
from tests.devices.profiles import Timing, profile_text
from tests.devices.table import NEW, OLD
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceBusy, DeviceSilent, DriverError, RegisterRefused
from triaxcal_drivers.profile import parse_bundle
from triaxcald.errors import DaemonError
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.image import image_of
from triaxcald.provision.pace import Pace
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import DeviceState

ERRORS = Errors(DeviceSilent, DeviceAbsent, BusError, DeviceSilent, RegisterRefused, DeviceBusy)
PLAIN = ("untouched", "old", "new_verified")
"""States that leave no doubt: the device must start with exactly that."""


@dataclass(frozen=True)
class Result:
    """``starts_with`` is the truth: "old", "new" or "mixture"; ``said`` the state, ``took_s`` on the virtual clock."""

    seed: int
    said: DeviceState
    starts_with: str
    failed: bool
    took_s: float
    habits: Habits
    trouble: Trouble

    @property
    def false(self) -> bool:
        wanted = {"untouched": "old", "old": "old", "new_verified": "new"}.get(self.said.value)
        return wanted is not None and wanted != self.starts_with

    @property
    def unsaid_mixture(self) -> bool:
        return self.starts_with == "mixture" and not self.failed and self.said is not DeviceState.NEW_UNVERIFIED


def habits_of(draw: random.Random) -> Habits:
    def rarely(value: object, otherwise: object) -> object:
        return value if draw.random() < 0.15 else otherwise

    stores = draw.random() < 0.7
    return Habits(
        store_command=stores,
        reset_command=draw.random() < 0.7,
        unlock=draw.random() < 0.7,
        counter=draw.random() < 0.3,
        status=draw.random() < 0.7,
        store_seconds=draw.choice([0.0, 0.0, 0.02, 0.5, 2.0]) if stores else draw.choice([0.0, 0.0, 0.01]),
        while_storing=draw.choice(["answers", "busy", "silent"]),
        store_reply=draw.choice(["ok", "ok", "ok", "none, done", "none, not done", "busy, done", "busy, not done",
                                 "refused"]),
        second_store_spoils=draw.random() < 0.3,
        forget_store=bool(rarely(True, False)),
        read_back=draw.choice(["memory", "memory", "cached"]),
        refuses=frozenset({"bias_x"} if draw.random() < 0.1 else ()),
        stuck=frozenset({"bias_y"} if draw.random() < 0.1 else ()),
        flips={"misalignment_x": 3} if draw.random() < 0.05 else {},
        cut_at_byte=draw.randrange(80) if draw.random() < 0.2 else None,
        power_back_s=draw.choice([0.2, 2.0]),
        restart_s=draw.choice([0.0, 0.05, 0.3]),
        reset_reply=draw.random() < 0.7,
    )  # fmt: skip


def trouble_of(draw: random.Random) -> Trouble:
    def some(most: float) -> float:
        return draw.uniform(0.0, most) if draw.random() < 0.3 else 0.0

    return Trouble(
        seed=draw.randrange(2**31),
        lose_request=some(0.1),
        lose_reply=some(0.1),
        late=some(0.1),
        late_s=0.3,
        garble=some(0.1),
        busy=some(0.2),
        drop=some(0.05),
        drop_done=draw.random() < 0.5,
        brown_out=some(0.02),
        dead_after=draw.randrange(1, 90) if draw.random() < 0.15 else None,
        dead_for_s=draw.choice([0.5, 3.0, float("inf")]),
    )


async def result_of(seed: int, folder: Path) -> Result:
    """One provisioning of one device."""
    draw = random.Random(seed)
    habits, trouble = habits_of(draw), trouble_of(draw)
    unit, clock = Electronics(habits, OLD.image(habits)), VirtualClock()
    place = Place(unit, trouble)
    device = InMemoryDevice(place, ERRORS, clock)
    bundle = parse_bundle(profile_text("modbus", habits, Timing()).encode(), {}, where="a drawn profile")
    old, new = unit.eeprom, NEW.image(habits)
    link = RegisterLink(device, bundle.profile, pace=Pace(clock.sleep, clock.now))
    p = Provisioning(
        link, bundle, image_of(bundle.profile, new), unit="unit", folder=folder, expected_serial=None, where="here"
    )
    failed = True
    try:
        await device.open()
        await p.examine()
        try:
            await p.write()
            failed = False
        finally:
            p.finish()
    except (DriverError, DaemonError):
        pass
    took_s = clock.now()
    with suppress(Exception):
        unit.power_on(clock.now() + 60.0)
    unit.advance(clock.now() + 120.0)
    starts = unit.starts_with()
    truth = "old" if starts == old else "new" if starts == new else "mixture"
    return Result(seed, p.held.state, truth, failed, took_s, habits, trouble)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    seen: Counter[tuple[str, str]] = Counter()
    false: list[Result] = []
    longest_s = 0.0
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        with tempfile.TemporaryDirectory() as folder:
            result = asyncio.run(result_of(seed, Path(folder)))
        seen[result.said.value, result.starts_with] += 1
        longest_s = max(longest_s, result.took_s)
        if result.false or result.unsaid_mixture:
            false.append(result)
            said = f"said {result.said.value}, starts with {result.starts_with}"
            print(f"seed {seed}: {said}: {result.habits} {result.trouble}")
    rows = [[said, starts, str(n)] for (said, starts), n in sorted(seen.items())]
    print(Table("What is said, and what the device starts with", ["said", "starts with", "devices"], rows))
    print(f"{chosen.count} devices from seed {chosen.seed}: {len(false)} false sentences")
    print(f"the longest took {longest_s:.1f} s")
    return 1 if false else 0


if __name__ == "__main__":
    raise SystemExit(main())
