"""Processor seconds of an audit, by part.

    python -m benchmarks.audit_cost [FOLDER] [--units 4] [--poses 30] [--signed]

Audits the recordings of a folder one after the other in one process; without a folder, runs of simulated units with
hidden effects on a virtual clock, on CAN and Modbus in turn. The first audit loads what the others use and is not
counted. A part counts without the parts inside it. ``--signed``: by a key that is trusted, so that the audit does not
draw the pictures.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import triaxcal as tc
from benchmarks.table import Table
from tests.virtual_line import described, virtual_line
from triaxcald.audit import audit, conduct, previews, results
from triaxcald.cli.commands import main as triaxcal
from triaxcald.decoded import DecodedStream
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.report import charts, over_time

PARTS: Sequence[tuple[str, Any, str]] = (
    ("opening, checking the file", Recording, "open"),
    ("inventory", conduct, "survey"),
    ("digests", conduct, "digests"),
    ("decoding, windows", DecodedStream, "feed"),
    ("previews", results.Previews, "feed"),
    ("previews", previews, "check"),
    ("poses and their noise", Pipeline, "finish"),
    ("diagnosis", tc.diagnosis, "diagnose"),
    ("signature", conduct, "check_signature"),
    ("certificate", results, "certify"),
    ("pictures", charts, "draw"),
    ("pictures", over_time, "draw"),
    ("report", conduct, "report_of"),
)
EFFECTS = {
    "second_order_nonlinearity": "{ x = 4e-4, y = -3e-4, z = 2e-4 }",
    "temperature_bias": "{ x = 4e-5, y = -3e-5, z = 5e-5 }",
    "temperature_scale_factor": "{ x = 4e-5, y = -3e-5, z = 5e-5 }",
    "": "",
}
BUSES = {
    "triax-ref-can": '{ interface = "virtual", channel = "cost", node_id = 5 }',
    "triax-ref-modbus": '{ host = "127.0.0.1", port = 15020, unit_id = 1 }',
}
DEVICE = """\
format = "triaxcal.device/1"
profile = "{profile}"
serial = {serial}
seed = {serial}
bus = {bus}
[surroundings]
swing_c = 6.0
swing_period_s = 47.0
[fixture]
poses = {poses}
hold_s = 4.5
move_s = 0.8
{effect}
"""
STATION = """\
format = "triaxcal.station/1"
name = "cost"
[plan]
poses = {poses}
hold_s = 3.0
check_poses = 6
[limits]
rms_g = 6e-4
verification_rms_g = 6e-4
[[units]]
name = "unit{serial}"
profile = "{profile}"
serial = "{serial}"
bus = {bus}
"""


def simulated(folder: Path, units: int, poses: int, *, signed: bool) -> None:
    """Runs of ``units`` with ``poses`` each, one folder a unit."""
    for unit in range(units):
        effect, values = list(EFFECTS.items())[unit % len(EFFECTS)]
        profile = list(BUSES)[unit % 2]
        at = folder / f"unit{unit}"
        at.mkdir()
        filled = {"profile": profile, "bus": BUSES[profile], "serial": 5000 + unit, "poses": poses}
        named = f"[sensor.effects]\n{effect} = {values}" if effect else ""
        (at / "device.toml").write_text(DEVICE.format(**filled, effect=named))
        (at / "station.toml").write_text(STATION.format(**filled))
        told = io.StringIO()
        if signed:
            keyed(at)
        with (
            virtual_line(described(at / "device.toml")),
            contextlib.redirect_stdout(told),
            contextlib.redirect_stderr(told),
        ):
            if triaxcal(["run", str(at / "station.toml")]):
                sys.exit(f"unit {unit}: the run failed\n{told.getvalue()}")


def keyed(folder: Path) -> None:
    """A key without a passphrase, and a trust file that has it."""
    from triaxcald.signing.keys import new_key, to_text
    from triaxcald.signing.trust import FORMAT, NAME, TrustedKey, TrustFile, save

    (folder / "keys").mkdir()
    key, since = new_key(folder / "keys", "cost", None), "2020-01-01T00:00:00+00:00"
    trusted = TrustedKey(name=key.name, public=to_text(key.public), since=since)
    save(folder / NAME, TrustFile(format=FORMAT, since=since, keys=(trusted,)))


@contextlib.contextmanager
def timed(spent: dict[str, float]) -> Iterator[None]:
    """Adds up the processor seconds of each of `PARTS`, without the parts inside."""
    inside = [0.0]
    kept = [(owner, name, owner.__dict__[name]) for _, owner, name in PARTS]

    def timing(part: str, work: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **more: Any) -> Any:
            inside.append(0.0)
            begun_s = time.process_time()
            try:
                return work(*arguments, **more)
            finally:
                took_s = time.process_time() - begun_s
                spent[part] += took_s - inside.pop()
                inside[-1] += took_s

        return run

    for part, owner, name in PARTS:
        work = timing(part, getattr(owner, name))
        setattr(owner, name, staticmethod(work) if name == "open" else work)
    try:
        yield
    finally:
        for owner, name, was in kept:
            setattr(owner, name, was)


def process_s(recording: Path) -> float:
    """Processor seconds of a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-m", "triaxcald.cli", "audit", str(recording)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        sys.exit(f"{recording}: exit code {process.returncode}")
    return used.ru_utime + used.ru_stime


def cost(recordings: Sequence[Path]) -> Table:
    spent: dict[str, float] = defaultdict(float)
    audit(recordings[0])
    begun_s = time.process_time()
    with timed(spent):
        for recording in recordings:
            found = audit(recording)
            if found.differences:
                sys.exit(f"{recording}: {found.differences[0]}")
    whole_s = time.process_time() - begun_s
    spent["all else"] = whole_s - sum(spent.values())
    rows = [[part, f"{s / len(recordings):.3f}", f"{s / whole_s:.0%}"] for part, s in spent.items()]
    rows.append(["an audit, of many", f"{whole_s / len(recordings):.3f}", "100%"])
    alone_s = sum(map(process_s, recordings[:2])) / len(recordings[:2])
    rows.append(
        ["an audit, with the start of its process", f"{alone_s:.3f}", f"{alone_s * len(recordings) / whole_s:.0%}"]
    )
    return Table(f"Audit of {len(recordings)} recordings", ["part", "s of a processor each", "share"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--units", type=int, default=4)
    parser.add_argument("--poses", type=int, default=30)
    parser.add_argument("--signed", action="store_true")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as made:
        if options.folder is None:
            simulated(Path(made), options.units, options.poses, signed=options.signed)
        print(cost(sorted((options.folder or Path(made)).rglob("*.mcap"))))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
