"""What the index of a folder with many outcomes costs: `python -m benchmarks.results_index`.

Every run of a station asks it for the unit's latest outcome, and `triaxcal results` for all runs. Each step is a
process of its own, so that its memory is its own.
"""

from __future__ import annotations

import argparse
import hashlib
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from benchmarks.table import Table
from triaxcald.documents import to_text

OUTCOMES = 20_000
UNITS = 8_000  # some are measured several times
CODES = (
    ("within_limits", "pass", 0),
    ("fit_outside", "fail", 1),
    ("absent", "aborted", 4),
    ("killed", "aborted", None),
)
STARTED = datetime(2026, 1, 1, tzinfo=UTC)
FIGURES = ("rms_g", "max_abs_g", "cross_validated_rms_g", "noise_floor_g", "lack_of_fit_p")


def outcome(number: int, random: random.Random) -> dict[str, Any]:
    """A document of a run, about as long as a real one (9 kB)."""
    code, verdict, exit_code = random.choices(CODES, (90, 5, 4, 1))[0]
    serial = f"{random.randrange(UNITS):06d}"
    begun = STARTED + timedelta(seconds=300 * number)
    ended = begun + timedelta(milliseconds=random.randrange(1_000, 400_000))
    measured = verdict in ("pass", "fail")

    def three(scale: float) -> list[float]:
        return [random.gauss(0.0, scale) for _ in range(3)]

    return {
        "format": "triaxcal.outcome/1",
        "unit": f"slot-{number % 4}",
        "serial": serial if code != "absent" else None,
        "station": "line 1",
        "run": f"0197{number:08x}-0000-7000-8000-{random.getrandbits(48):012x}",
        "started": begun.isoformat(timespec="milliseconds"),
        "ended": ended.isoformat(timespec="milliseconds"),
        "work": {
            "serial": serial, "operator": f"op {number % 7}", "order": f"WO-{number // 100}", "batch": None,
            "part_number": "TX-3", "fixture": "F1", "slot": f"slot-{number % 4}", "attempt": 1, "reason": None,
        },
        "recording": None if code == "absent" else f"slot-{number % 4}-{serial}-{number:06d}.mcap",
        "settles": None,
        "verdict": verdict,
        "code": code,
        "reason": "within the limits; the device's own output in 6 check poses is 16.1 µg ± 8.63 µg off, limit 60.0 µg",
        "exit_code": exit_code,
        "device_state": "new_verified" if verdict == "pass" else "untouched",
        "evidence": "read_after_restart",
        "observed": ["acknowledged", "counter_advanced", "read_back"],
        "registers": {"steps": [f"writing register_{i}" for i in range(60)], "stored": True},
        "forced": None,
        "journal": None,
        "limits": {"rms_g": 6e-05, "cross_validated_rms_g": None, "verification_rms_g": 6e-05},
        "outside": [],
        "measured": {
            "raw_sha256": hashlib.sha256(serial.encode()).hexdigest(),
            "poses": 26,
            "before": {name: random.uniform(1e-4, 2e-4) for name in FIGURES},
            "after": {name: random.uniform(1e-5, 2e-5) for name in FIGURES},
            "terms": ["linear", "second_order_nonlinearity"],
            "left_to_host": [],
            "calibration": {
                "scale_factor": three(2.4), "misalignment": three(5e-3), "bias": three(5e-3),
                "standard_error": {"scale_factor": three(1e-5), "misalignment": three(1e-5), "bias": three(1e-5)},
            },
        } if measured else None,
        "verification": {
            "before_rms_g": random.uniform(1e-3, 1e-2),
            "after_rms_g": random.uniform(1e-5, 2e-5),
            "poses": [{name: random.random() for name in ("start_s", "end_s", *FIGURES)} for _ in range(6)],
        } if measured else None,
        "wanted_poses": [],
        "supersedes": None,
        "sha256": {"certificate.json": None, "report.html": None},
        "software": {"triaxcal": "0.3.0"},
        "contents": {
            "topics": [{"name": f"/{i}", "sha256": hashlib.sha256(bytes([i])).hexdigest()} for i in range(14)]
        },
    }  # fmt: skip


def fill(folder: Path, outcomes: int, seed: int = 1) -> list[dict[str, Any]]:
    """Write so many outcomes; the documents without what the index does not hold."""
    made, choice = [], random.Random(seed)
    for number in range(outcomes):
        document = outcome(number, choice)
        stem = f"{document['unit']}-{document['work']['serial']}-{number:06d}"
        (folder / f"{stem}.outcome.json").write_text(to_text(document), encoding="utf-8")
        made.append(document | {"registers": None, "contents": None})
    return made


def spent(command: Sequence[str]) -> tuple[float, float, float]:
    """Seconds, those of a processor, and MiB of a process."""
    code = (
        "import resource, subprocess, sys, time\n"
        "begun = time.perf_counter()\n"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)\n"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN)\n"
        "print(time.perf_counter() - begun, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)\n"
    )
    told = subprocess.run([sys.executable, "-c", code, *command], check=True, capture_output=True, text=True).stdout
    wall_s, processor_s, mib = map(float, told.split())
    return wall_s, processor_s, mib


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a tenth of the outcomes")
    outcomes = OUTCOMES // 10 if parser.parse_args(arguments).quick else OUTCOMES
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        made = fill(folder, outcomes)
        time.sleep(2.5)  # what was written just now is read again, as it may still change
        results = [sys.executable, "-m", "triaxcald.cli", "results", name]
        asked = (
            f"from triaxcald.store import *; History.of(__import__('pathlib').Path({name!r}), '{made[0]['serial']}')"
        )
        rows = []
        for what, command in (
            ("results, nothing indexed", results),
            ("results again", results),
            ("results --json", [*results, "--json"]),
            ("results -o runs.csv", [*results, "-o", f"{name}/runs.csv"]),
            ("results -o runs.parquet", [*results, "-o", f"{name}/runs.parquet"]),
            ("latest outcome of a unit", [sys.executable, "-c", asked]),
        ):
            wall_s, processor_s, mib = spent(command)
            rows.append([what, f"{wall_s:.2f}", f"{processor_s:.2f}", f"{mib:.0f}"])
        size = (folder / "triaxcal.sqlite").stat().st_size / 2**20
    print(Table(f"Index of {outcomes} outcomes ({size:.1f} MiB)", ["step", "s", "s of a processor", "MiB"], rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
