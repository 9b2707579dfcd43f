"""Readings as a calibration makes them, block by block."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from triaxcal.documents import OUT, UNCERTAINTY, Calibration
from triaxcal.errors import MissingChannel
from triaxcal_drivers.interface import SampleBlock
from triaxcal_drivers.profile import READINGS
from triaxcald.errors import InputError
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.pipeline import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import Phase
from triaxcald.tables.samples import Reading, read_table

BLOCK = 65536
"""Samples at a time, of a text: its effects take some hundred bytes for each."""


@dataclass
class Applied:
    """``blocks`` have the calibrated readings among their channels, behind those of the input; ``start_ns`` is where
    their seconds begin, None for the first sample. ``missing`` has, once they are through, what the calibration needs
    and the recording lacks; ``remarks`` say how a table was read."""

    blocks: Iterator[SampleBlock]
    start_ns: int | None
    missing: list[str] = field(default_factory=list)
    remarks: tuple[str, ...] = ()


def applied(
    calibration: Calibration,
    name: str,
    *,
    uncertainty: bool = False,
    own_recording: bool = False,
    phase: Phase = CALIBRATION,
    reading: Reading | None = None,
) -> Applied:
    """Of the recording ``name``; ``reading`` says how a table is read.

    Raises InputError, RecordingError; where its blocks are read, also Refused.
    """
    found = Applied(iter(()), None)
    if name.endswith(".mcap"):
        blocks = _of_recording(Path(name), phase)
    else:
        table = read_table(name, reading)
        samples = table.samples
        found.start_ns, found.remarks = 0, table.remarks
        blocks = (
            SampleBlock(
                samples.time_ns[at : at + BLOCK],
                np.arange(at, min(at + BLOCK, len(samples.time_ns))),
                samples.readings[at : at + BLOCK],
                {n: v[at : at + BLOCK] for n, v in samples.channels.items()},
            )
            for at in range(0, len(samples.time_ns), BLOCK)
        )
    columns = OUT + UNCERTAINTY * uncertainty

    def calibrated() -> Iterator[SampleBlock]:
        begin_ns: int | None = None
        for block in blocks:
            if taken := [n for n in columns if n in block.channels]:
                raise InputError(f"{name}: it has a column {taken[0]} already")
            if begin_ns is None and len(block):
                begin_ns = int(block.time_ns[0])
            t_s = (block.time_ns - (begin_ns or 0)) * 1e-9
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always", MissingChannel)
                a = calibration.apply(
                    block.readings,
                    t=t_s if own_recording else None,
                    channels=block.channels,
                    own_recording=own_recording,
                    uncertainty=uncertainty,
                )
            found.missing += [m for w in told if (m := str(w.message)) not in found.missing]
            values = np.concatenate(a, axis=1) if uncertainty else a
            yield replace(block, channels={**block.channels, **dict(zip(columns, values.T, strict=True))})

    found.blocks = calibrated()
    return found


def _of_recording(path: Path, phase: Phase) -> Iterator[SampleBlock]:
    with Recording.open(path) as recording:
        pipeline = Pipeline(bundle_of(recording), READINGS)
        for batch in recording.raw(phase):
            yield pipeline.feed(batch)
