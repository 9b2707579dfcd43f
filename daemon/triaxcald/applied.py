"""Readings as a calibration makes them, block by block."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import CALIBRATION, bundle_of, require_same_outputs
from triaxcald.provision.correction import from_attachments, samples_before
from triaxcald.recording.reader import is_recording, open_recording
from triaxcald.recording.schema import Phase
from triaxcald.stores import path_of
from triaxcald.tables.native_csv import Rows
from triaxcald.tables.samples import Reading, read_table

BLOCK = 65536
"""Samples at a time, of a text: its effects take some hundred bytes for each."""
FAR = 3.0
"""Beyond so many times the reference, or as small a part of it, the median is
no matter of how the unit was moved."""


@dataclass
class Applied:
    """``blocks`` have the columns of the input, and behind them the calibrated
    readings; ``start_ns`` is where their seconds begin, None for the first
    sample. ``cautions`` has, once they are through, what the calibration needs
    and the recording lacks, and whether the readings can be of its unit;
    ``remarks`` say how a table was read."""

    blocks: Iterator[Rows]
    start_ns: int | None
    cautions: list[str] = field(default_factory=list)
    remarks: tuple[str, ...] = ()


def applied(
    calibration: tc.Calibration,
    name: str,
    *,
    uncertainty: bool = False,
    own_recording: bool = False,
    phase: Phase = CALIBRATION,
    reading: Reading | None = None,
    output_unit: str = "",
) -> Applied:
    """Of the recording ``name``; ``reading`` says how a table is read, and
    ``output_unit`` what its outputs are in. Rates and lags of channels that the
    effects need are those of the recording, unless it logs them.

    Raises InputError, RecordingError; where its blocks are read, also Refused.
    """
    found = Applied(iter(()), None)
    beside: Mapping[str, Any] = {}
    if is_recording(name):
        blocks = _of_recording(path_of(name), phase)
        whole = _of_recording(path_of(name), phase)
        pieces: Iterator[tuple[Any, Mapping[str, Any]]] = ((b.time_ns * 1e-9, b.channels) for b in whole if len(b))
    else:
        table = read_table(name, reading, beside=True)
        require_same_outputs(calibration, name, output_unit or table.output_unit)
        samples, beside = table.samples, table.beside
        if own_recording and len(samples.time_ns):
            calibration.require_whole((samples.time_ns - samples.time_ns[0]) * 1e-9)
        found.start_ns, found.remarks = 0, table.remarks
        if samples.duplicates:
            found.remarks += (
                f"{tc.number_format.number_of(samples.duplicates, 'row')} left out, the same as the one before",
            )
        pieces = iter([(samples.time_ns * 1e-9, samples.channels)])
        blocks = (
            td.SampleBlock(
                samples.time_ns[at : at + BLOCK],
                np.arange(at, min(at + BLOCK, len(samples.time_ns))),
                samples.readings[at : at + BLOCK],
                {n: v[at : at + BLOCK] for n, v in samples.channels.items()},
            )
            for at in range(0, len(samples.time_ns), BLOCK)
        )
    followed = tc.poses.InStream.of(pieces, calibration.needs_recording(), calibration.duration_s)
    if derived := ", ".join(followed.covariates):
        found.remarks += (f"{derived}: of the recording's own channels and times, where it logs none",)
    columns = tc.documents.OUT + tc.documents.UNCERTAINTY * uncertainty

    def calibrated() -> Iterator[Rows]:
        begin_ns: int | None = None
        at, lengths = 0, list[float]()
        for block in blocks:
            if begin_ns is None and len(block):
                begin_ns = int(block.time_ns[0])
            t_s = (block.time_ns - (begin_ns or 0)) * 1e-9
            with warnings.catch_warnings(record=True) as told:
                warnings.simplefilter("always", tc.MissingChannel)
                a = calibration.apply(
                    block.readings,
                    t=t_s if own_recording else None,
                    channels=followed.at(block.time_ns * 1e-9) | dict(block.channels),
                    own_recording=own_recording,
                    uncertainty=uncertainty,
                )
            found.cautions += [m for w in told if (m := str(w.message)) not in found.cautions]
            values = np.concatenate(a, axis=1) if uncertainty else a
            if len(block):
                lengths.append(float(np.median(np.linalg.norm(values[:, :3], axis=1))))
            cells = {n: v[at : at + len(block)] for n, v in beside.items()}
            at += len(block)
            held = _renamed({**Rows.of(block).columns, **cells}, columns)
            yield Rows(block.time_ns, held | dict(zip(columns, values.T, strict=True)))
        found.cautions += _of_another_unit(calibration, name, lengths)

    found.blocks = calibrated()
    return found


def _renamed(held: Mapping[str, Any], taken: tuple[str, ...]) -> dict[str, Any]:
    """Columns of the input, those that are called as one of ours under a name
    that is free: the input may be what an earlier `apply` wrote."""
    found: dict[str, Any] = {}
    for name, values in held.items():
        free = name
        while free in taken or free in found or (free != name and free in held):
            free += " (input)"
        found[free] = values
    return found


def _of_another_unit(calibration: tc.Calibration, name: str, lengths: list[float]) -> list[str]:
    """A line where the magnitude, in the median of each block, is nowhere near
    the reference."""
    reference, unit = calibration.fitted.reference, calibration.reference_unit
    if not lengths or reference / FAR < (typical := float(np.median(lengths))) < reference * FAR:
        return []
    return [
        f"{name}: readings come out at {typical:.3g} {unit} in the median, and the reference is {reference:g} {unit}: "
        "are the outputs in another unit than those that were calibrated?"
    ]


def _of_recording(path: td.files.AnyPath, phase: Phase) -> Iterator[td.SampleBlock]:
    with open_recording(path) as recording:
        bundle = bundle_of(recording)
        stream = DecodedStream(bundle, td.READINGS)
        at_start = from_attachments(recording.attachments, recording.name)
        for batch in recording.raw(phase):
            # A calibration is of the readings before the device's own correction.
            yield samples_before(bundle.profile, stream.rising(batch), at_start)
