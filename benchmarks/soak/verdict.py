"""What a soak has come to: its tables, and every reason why it failed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.soak.account import STREAMS, WAYS, Account, Replayed, account, manifest_faults, replayed
from benchmarks.soak.bench import Bench, Unit
from benchmarks.soak.faults import Fault
from benchmarks.soak.recorder import Look, Recorder
from benchmarks.soak.units import SENT
from benchmarks.table import Table
from triaxcald.errors import RecordingError

WARM_UP_S = 240.0
"""A process grows by some 5 MiB in its first four minutes, until every thread's buffers have been as large as they get,
and then hardly any more."""
JUDGED_S = 180.0
"""A slope is told of no less: within three minutes half a MiB that comes and goes is ten MiB an hour."""
SLOPE_MOST = 15.0
"""MiB an hour. What keeps a number of eight bytes of each record grows by more, at the bench's rate (1600 frames a
second: 44 MiB an hour)."""
FILES_MORE = 4
"""Open files and threads more than at the beginning of the same process: a request for the numbers has two."""
_MIB = 2**20


@dataclass
class Verdict:
    tables: list[Table] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def verdict(bench: Bench, recorder: Recorder, schedule: Sequence[Fault], stopped_ns: int, seconds: float) -> Verdict:
    found = Verdict()
    rows, beside = [], []
    for unit in bench.units:
        try:
            recording = replayed(bench.manifest(unit), unit.address if unit.bus == "can" else None)
            found.faults += [f"{unit.name}: {fault}" for fault in manifest_faults(bench.manifest(unit))]
        except RecordingError as e:
            found.faults.append(f"{unit.name}: {e}")
            continue
        sent = np.fromfile(bench.sent_by(unit), SENT)
        accounts = {name: account(sent, name, recording, recorder.killed_ns, stopped_ns) for name in STREAMS}
        rows += [_account_row(unit, name, made) for name, made in accounts.items()]
        beside.append(_beside(bench, unit, recording))
        found.faults += _account_faults(unit, accounts, recording) + _info_faults(bench, unit)
    head = ["unit, stream", "sent", "before, after", "recorded", *(f"lost: {way}" for way in WAYS), "silent loss"]
    found.tables.append(Table("Samples: what was sent is recorded, or told of as lost", head, rows))
    head = ["unit", "segments", "cut short", "gaps", "in gaps s", "longest s", "missing", "incomplete", "duplicates"]
    found.tables.append(Table("Recordings", [*head, "failed requests", "not to the disk"], beside))
    found.tables += [_of_recorder(recorder, seconds, found.faults), _of_faults(schedule)]
    return found


def _account_row(unit: Unit, stream: str, made: Account) -> list[str]:
    ways = [str(made.lost[way]) for way in WAYS]
    return [
        f"{unit.name} {stream}", str(made.sent), f"{made.before}, {made.after}", str(made.recorded), *ways,
        str(made.silent),
    ]  # fmt: skip


def _account_faults(unit: Unit, accounts: dict[str, Account], recording: Replayed) -> list[str]:
    faults = []
    for name, made in accounts.items():
        if made.sent != made.before + made.after + made.recorded + sum(made.lost.values()) + made.silent:
            faults.append(f"{unit.name} {name}: the account does not add up")
        if made.silent:
            faults.append(f"{unit.name}: {made.silent} samples lost in silence: {'; '.join(made.remarks)}")
        if made.foreign:
            faults.append(f"{unit.name} {name}: {made.foreign} samples that the unit has never sent")
        if made.astray:
            faults.append(f"{unit.name} {name}: {made.astray} samples decoded that are not among the bytes recorded")
        if made.miscounted:
            faults.append(f"{unit.name} {name}: the count of missing samples is off by {made.miscounted}")
        if backwards := recording.streams[name].counts["out_of_order"]:
            faults.append(f"{unit.name} {name}: {backwards} samples go back in time")
    if recording.twice:
        faults.append(f"{unit.name}: {recording.twice} samples came out of the decoder twice")
    return faults


def _beside(bench: Bench, unit: Unit, recording: Replayed) -> list[str]:
    segments = json.loads(bench.manifest(unit).read_text("utf-8"))["segments"]
    gaps_s = [(d["to_ns"] - d["from_ns"]) / 1e9 for kind, d in recording.events if kind == "gap"]
    counts = recording.streams[STREAMS[0]].counts
    cut = sum(s["state"] == "cut_short" for s in segments)
    told = [len(segments), cut, recording.gaps, f"{sum(gaps_s):.1f}", f"{max(gaps_s, default=0.0):.1f}"]
    told += [counts[name] for name in ("missing", "incomplete", "duplicates", "errors")]
    return [unit.name, *map(str, told), str(recording.unsaved)]


def _info_faults(bench: Bench, unit: Unit) -> list[str]:
    """What `triaxcal log info` says of the recording."""
    arguments = ["log", "info", str(bench.manifest(unit)), "--json"]
    done = subprocess.run([sys.executable, "-m", "triaxcald.cli", *arguments], capture_output=True, text=True)
    if done.returncode:
        return [f"{unit.name}: log info ends with {done.returncode}: {done.stderr.strip()}"]
    ended = (json.loads(done.stdout)["ended"] or {}).get("reason")
    return [] if ended == "signal" else [f"{unit.name}: the recording ended because: {ended}, expected signal"]


def _of_recorder(recorder: Recorder, seconds: float, faults: list[str]) -> Table:
    last = [look for look in recorder.looks if look.start == recorder.starts]
    warm = [look for look in last if look.time_s - last[0].time_s >= WARM_UP_S]
    peak = max((look.memory for look in recorder.looks), default=0) / _MIB
    slope, over_s = _slope(warm)
    told = "not told: too short" if slope is None else f"{slope:.1f} over {over_s:.0f} s"
    if slope is not None and slope > SLOPE_MOST:
        faults.append(f"the recorder's memory grows by {slope:.1f} MiB an hour, more than {SLOPE_MOST:g}")
    first, end = (warm[0], warm[-1]) if warm else (None, None)
    if first and end:
        for what, before, now in (("open files", first.files, end.files), ("threads", first.threads, end.threads)):
            if now > before + FILES_MORE:
                faults.append(f"the recorder has {now} {what}, {before} when it was warm")
    cpu_s = recorder.cpu_of_killed_s + (last[-1].cpu_s if last else 0.0)
    rows = [
        ["starts, of which after a kill", f"{recorder.starts}, {len(recorder.killed_ns)}"],
        ["processor, of one core", f"{cpu_s / seconds:.1%}"],
        ["memory at most, MiB", f"{peak:.1f}"],
        [
            f"memory when warm (after {WARM_UP_S:g} s), and at the end, MiB",
            _from_to([look.memory / _MIB for look in warm]),
        ],
        ["growth of the last process when warm, MiB an hour", told],
        ["open files when warm, and at the end", _from_to([look.files for look in warm])],
        ["threads when warm, and at the end", _from_to([look.threads for look in warm])],
    ]
    return Table("The recorder", ["what", "figure"], rows)


def _slope(looks: Sequence[Look]) -> tuple[float | None, float]:
    """MiB an hour, and of how many seconds."""
    over_s = looks[-1].time_s - looks[0].time_s if looks else 0.0
    if over_s < JUDGED_S:
        return None, over_s
    hours = np.array([look.time_s for look in looks]) / 3600
    return float(np.polyfit(hours - hours[0], [look.memory / _MIB for look in looks], 1)[0]), over_s


def _from_to(values: Sequence[float]) -> str:
    return f"{values[0]:.4g}, {values[-1]:.4g}" if values else "-"


def _of_faults(schedule: Sequence[Fault]) -> Table:
    rows = []
    for what in sorted({fault.what for fault in schedule}):
        these = [fault for fault in schedule if fault.what == what]
        rows.append([what, str(len(these)), f"{sum(fault.seconds for fault in these):.1f}"])
    return Table("Faults", ["what", "times", "seconds in all"], rows)
