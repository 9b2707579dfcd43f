"""Devices with random faults, on a virtual clock: does what is said of them hold?

``python -m benchmarks.faulty_devices --count 10000 --seed 1`` draws devices (how they store, restart, answer and fail)
and lines (what gets lost, late, damaged, busy), provisions each, and compares what is said of the device with what it
would start with. What a provisioning leaves unfinished, a second process finishes. A false sentence is printed with
the seed that makes it again.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import json
import random
import tempfile
import time
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.table import Table
from tests.daemon.provision.host import Host
from tests.devices.bench import TRANSPORTS, Bench
from tests.devices.habits import Habits
from tests.devices.memory import SERIAL_NUMBER, Electronics
from tests.devices.place import Trouble
from tests.devices.profiles import Timing
from tests.devices.table import FACTORY
from triaxcald.cli.commands import main as command
from triaxcald.provision.state import DeviceState, Evidence, Held

CLAIMS = {"untouched": ("old",), "old": ("old",), "new_verified": ("new",), "mixed": ("mixture",)}
"""States that leave no doubt, and what the device then has to start with. Where they rest on a mere reading back, they
are said to be unproven: what is in use may not be what is stored."""
PROCESSES = ("provision", "resume", "restore")


@dataclass(frozen=True)
class Result:
    """``starts_with`` is the truth: "old", "new" or "mixture"; ``said`` the state, ``took_s`` on the virtual clock."""

    seed: int
    process: str
    said: DeviceState
    evidence: Evidence
    starts_with: str
    failed: bool
    took_s: float
    habits: Habits
    trouble: Trouble
    second_overwritten: bool = False
    """Whether a second unit at the same address no longer holds its own calibration."""

    @property
    def false(self) -> bool:
        """Whether a sentence is, or a mixture or a second unit goes without a word."""
        if self.second_overwritten and not self.failed:
            return True
        if self.evidence is Evidence.READ_BACK or (self.said is DeviceState.MIXED and self.habits.flips):
            return False  # said to be unproven; what is read is not what is stored
        said_nothing = not self.failed and self.said is not DeviceState.NEW_UNVERIFIED
        return self.starts_with not in CLAIMS.get(self.said.value, (self.starts_with,)) or (
            said_nothing and self.starts_with == "mixture"
        )


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
        reset_ignored=bool(rarely(True, False)),
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


def second_of(draw: random.Random, habits: Habits) -> tuple[int, Electronics, float] | None:
    """A second unit at the same address, if there is one: from which request on, and how much later it answers."""
    if draw.random() >= 0.15:
        return None
    habits = replace(habits, cut_at_byte=None)
    number = draw.choice([SERIAL_NUMBER + 1, 888])
    other = Electronics(habits, FACTORY.image(habits), serial_number=number)
    return draw.choice([1, 1, draw.randrange(1, 90)]), other, draw.choice([0.002, 0.04, 0.15])


async def results_of(seed: int, folder: Path) -> list[Result]:
    """One device: it is provisioned, and where that leaves a journal, a further process finishes it or takes it back,
    over a line that is sound by then."""
    draw = random.Random(seed)
    habits, trouble = habits_of(draw), trouble_of(draw)
    host = Host(folder, habits, trouble)
    if (second := second_of(draw, habits)) is not None:
        host.place.second_at(*second)
    made = [await _one(host, "provision", seed, habits, trouble)]
    if host.journals:
        host.place.trouble = Trouble()
        host.place.second = None
        host.power_on()
        made.append(await _one(host, draw.choice(PROCESSES[1:]), seed, habits, trouble))
    return made


def result_over_a_bus(seed: int, folder: Path) -> Result:
    """The command itself, over a socket, a serial line or a virtual CAN bus, with scaled time-outs."""
    draw = random.Random(seed)
    habits, trouble = habits_of(draw), trouble_of(draw)
    timing = Timing(reply_s=0.15, silence_s=0.5, reconnect_s=1.5)
    with Bench(folder, _command, draw.choice(TRANSPORTS), habits, trouble, timing) as bench:
        if (second := second_of(draw, habits)) is not None:
            bench.place.second_at(*second)
        began_s = time.monotonic()
        code, printed = bench.provision("--json")
        took_s = time.monotonic() - began_s
        outcome = json.loads(printed)["outcome"]
        starts = "old" if bench.holds_old() else "new" if bench.holds_new() else "mixture"
        overwritten = second is not None and second[1].eeprom != FACTORY.image(habits)
    said, evidence = DeviceState(outcome["device_state"]), Evidence(outcome["evidence"])
    return Result(seed, "over a bus", said, evidence, starts, code != 0, took_s, habits, trouble, overwritten)


def _command(*arguments: object) -> tuple[int, str]:
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(io.StringIO()):
        code = command([str(a) for a in arguments])
    return code, out.getvalue()


async def _one(host: Host, process: str, seed: int, habits: Habits, trouble: Trouble) -> Result:
    began_s = host.clock.now()
    host.provisioning = None
    second = host.place.second
    failed = not await getattr(host, process)()
    p = host.provisioning
    # As the command says it: a journal that nobody could look into leaves the state unknown.
    known = p is not None and (p.identified or not host.journals)
    held = p.held if p is not None and known else Held(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
    took_s = host.clock.now() - began_s
    second = second or host.place.second
    overwritten = second is not None and second.eeprom != FACTORY.image(second.habits)
    return Result(
        seed, process, held.state, held.evidence, host.starts_with(), failed, took_s, habits, trouble, overwritten
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--over-a-bus", action="store_true", help="the command itself, some seconds a device")
    chosen = parser.parse_args()
    seen: Counter[tuple[str, str, str]] = Counter()
    false = 0
    longest_s = 0.0
    for seed in range(chosen.seed, chosen.seed + chosen.count):
        with tempfile.TemporaryDirectory() as folder:
            if chosen.over_a_bus:
                results = [result_over_a_bus(seed, Path(folder))]
            else:
                results = asyncio.run(results_of(seed, Path(folder)))
        for r in results:
            seen[r.process, r.said.value, r.starts_with] += 1
            longest_s = max(longest_s, r.took_s)
            if r.false:
                false += 1
                print(f"seed {seed}: {r.process} says {r.said.value}, it starts with {r.starts_with}: {r}")
    rows = [[*key, str(n)] for key, n in sorted(seen.items())]
    columns = ["command", "said", "starts with", "devices"]
    print(Table("What is said, and what the device starts with", columns, rows))
    print(f"{chosen.count} devices from seed {chosen.seed}: {false} false sentences")
    print(f"the longest took {longest_s:.1f} s")
    return 1 if false else 0


if __name__ == "__main__":
    raise SystemExit(main())
