"""Hours of 1 kHz through the commands: processor time and peak memory.

    python -m benchmarks.long_recordings [--hours 1 24] [--poses 40] [--quick]

A unit on CAN, two frames a sample and 200 a batch, is held still for a minute in one direction after the other; after
the last of ``--poses`` it stands still to the end. An hour takes some 70 MB of disk.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.table import Table
from triaxcal.arrays import Floats, Ints
from triaxcal_drivers.catalogue import BUILT_IN
from triaxcal_drivers.interface import RawBatch
from triaxcald.inputs import PROFILE
from triaxcald.recording.writer import RecordingWriter

RATE_HZ = 1000
HOLD_S, MOVE_S = 60.0, 2.0
SCALE_V, BIAS_G, NOISE_V = np.array([-2.4, -2.41, -2.39]), np.array([0.02, -0.01, 0.03]), 3e-4
STEP_V = 10 / 2**23
"""Of the reference unit's 24 bits."""
IDENTIFIERS = 0x185, 0x285
"""Of its readings, at node 5."""
BATCH = 200
AT_ONCE = 10_000
"""Samples that are made at once."""
COMMANDS = {"poses": [], "fit": ["-o", "fit.json"], "diagnose": ["-o", "diagnosis.json"]}


def accelerations(t_s: Floats, directions: Floats) -> Floats:
    """(n,3) in g, at rest but for the moves, which are smooth."""
    pose, into_s = np.divmod(t_s, HOLD_S + MOVE_S)
    here = np.minimum(pose.astype(int), len(directions) - 1)
    share = np.clip((into_s - HOLD_S) / MOVE_S, 0, 1)[:, None]
    share = 10 * share**3 - 15 * share**4 + 6 * share**5
    a = directions[here] * (1 - share) + directions[np.minimum(here + 1, len(directions) - 1)] * share
    return np.asarray(a / np.linalg.norm(a, axis=1, keepdims=True))


def payloads(number: Ints, readings_v: Floats, temperature_c: Floats) -> bytes:
    """Of both frames of each sample, as the reference unit packs them."""
    codes = np.rint(readings_v / STEP_V).astype(np.int64)
    data = np.zeros((len(number), 2, 8), dtype=np.uint8)
    for frame, first, values, octets in (
        (0, 0, codes[:, 0], 3), (0, 3, codes[:, 1], 3), (0, 6, number, 2),
        (1, 0, codes[:, 2], 3), (1, 3, np.rint(100 * temperature_c).astype(np.int64), 2), (1, 5, number, 2),
    ):  # fmt: skip
        for octet in range(octets):
            data[:, frame, first + octet] = values >> 8 * octet & 0xFF
    return data.tobytes()


def batches(hours: float, poses: int) -> Iterator[RawBatch]:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(poses, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for first in range(0, round(hours * 3600 * RATE_HZ), AT_ONCE):
        number = np.arange(first, min(first + AT_ONCE, round(hours * 3600 * RATE_HZ)))
        t_s = number / RATE_HZ
        readings = (accelerations(t_s, directions) + BIAS_G) * SCALE_V + rng.normal(size=(len(t_s), 3)) * NOISE_V
        data = payloads(number, readings, 25 + 0.5 * np.sin(t_s / 3000))
        late_ns = rng.integers(0, 20_000, size=len(number))  # as frames of a bus are
        time_ns = ((number + 1) * 1_000_000 + late_ns)[:, None] + np.array([0, 60_000])
        for at in range(0, 2 * len(number), BATCH):
            rows = slice(at, at + BATCH)
            count = len(time_ns.ravel()[rows])
            yield RawBatch(
                time_ns.ravel()[rows],
                np.tile(np.array(IDENTIFIERS, dtype=np.uint32), count // 2),
                np.zeros(count, dtype=np.uint8),
                np.full(count, 8, dtype=np.uint16),
                data[8 * at : 8 * (at + count)],
            )


def recorded(path: Path, hours: float, poses: int) -> None:
    profile = (BUILT_IN / "triax-ref-can.toml").read_text()
    metadata = {"station": {"name": "long"}, "unit": {"name": "unit", "serial": "1", "signs": "-1,-1,-1"}}
    with RecordingWriter(path, metadata=metadata, preview_channels=None, waits=True) as writer:
        fast = profile.replace("rate_hz = 100.0", f"rate_hz = {RATE_HZ:.1f}")
        assert fast != profile
        writer.attach(PROFILE, "application/toml", fast.encode())
        writer.attach("profile/triax-ref-can.dbc", "text/plain", (BUILT_IN / "triax-ref-can.dbc").read_bytes())
        for batch in batches(hours, poses):
            writer.raw("calibration", batch)


def spent(command: str, recording: Path) -> tuple[int, float, float, float]:
    """Exit code, seconds, processor seconds, MiB at most."""
    begun_s = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "triaxcald.cli", command, recording.name, *COMMANDS[command]],
        cwd=recording.parent, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, time.monotonic() - begun_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def table(hours: Sequence[float], poses: int) -> Table:
    rows = []
    for each in hours:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "long.mcap"
            recorded(path, each, poses)
            for command in COMMANDS:
                code, seconds, processor_s, mebibytes = spent(command, path)
                rows.append(
                    [f"{each:g}", command, f"{code}", f"{seconds:.1f}", f"{processor_s:.1f}", f"{mebibytes:.0f}"]
                )
    head = ["hours", "command", "exit code", "s", "s of a processor", "MiB at most"]
    return Table(f"Recordings of {RATE_HZ} samples a second, {poses} poses", head, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0])
    parser.add_argument("--poses", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="a quarter of an hour")
    options = parser.parse_args(arguments)
    print(table([0.25] if options.quick else options.hours, options.poses))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
