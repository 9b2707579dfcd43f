"""How long a pass of retention takes to see what documents keep: `python -m benchmarks.retention`.

One folder has the segments of many units, a manifest and an outcome for each. A pass asks which segments of one unit
stay: the first reads every document, the next ones those that are new.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.table import Table
from triaxcald.recording.manifest import Manifest, Segment
from triaxcald.recording.segments import EvidenceIndex

UNITS, SEGMENTS = 1000, 168  # a week of hours
OUTCOME_BYTES = 40_000  # of a run's document with its poses


def _outcome(unit: int) -> str:
    named = {"recording": f"unit-{unit:04d}-000001.mcap", "recording_sha256": _sha(unit, 1)}
    filler = [i / 7 for i in range(OUTCOME_BYTES // 20)]
    return json.dumps({"format": "triaxcal.outcome/1", **named, "figures": filler})


def _sha(unit: int, number: int) -> str:
    return hashlib.sha256(f"{unit} {number}".encode()).hexdigest()


def _fill(folder: Path, units: int, segments: int) -> list[Manifest]:
    manifests = []
    for unit in range(units):
        names = [f"unit-{unit:04d}-{n:06d}.mcap" for n in range(1, segments + 1)]
        for name in names:
            (folder / name).touch()
        (folder / f"unit-{unit:04d}-20260101T000000Z.outcome.json").write_text(_outcome(unit))
        path = folder / f"unit-{unit:04d}.segments.json"
        path.touch()
        of = [Segment(name, n, 0, "closed", sha256=_sha(unit, n)) for n, name in enumerate(names, start=1)]
        manifests.append(Manifest(path, tuple(of)))
    return manifests


def _timed(index: EvidenceIndex, manifest: Manifest) -> list[str]:
    """Seconds, and those of a processor; documents read, segments kept."""
    reads, begun_s, spent_s = index.reads, time.perf_counter(), time.process_time()
    kept = index.of(manifest).kept
    took = time.perf_counter() - begun_s, time.process_time() - spent_s
    return [*(f"{s:.3f}" for s in took), str(index.reads - reads), str(len(kept))]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="a tenth of the units")
    units = UNITS // 10 if parser.parse_args(arguments).quick else UNITS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        manifests = _fill(folder, units, SEGMENTS)
        time.sleep(2.5)  # what was written just now is read again, as it may still change
        index = EvidenceIndex(folder)
        found = {"the first pass": _timed(index, manifests[0])}
        found["the next"] = _timed(index, manifests[0])
        found["of another unit"] = _timed(index, manifests[1])
        (folder / "late.outcome.json").write_text(_outcome(2) + manifests[0].segments[5].sha256)
        found["with a new document"] = _timed(index, manifests[0])
    rows = [[what, *told] for what, told in found.items()]
    title = f"Retention: {units} units with {SEGMENTS} segments each in one folder"
    print(Table(title, ["pass", "s", "s of a processor", "documents read", "segments kept"], rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
