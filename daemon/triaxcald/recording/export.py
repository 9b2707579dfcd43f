"""Writes samples as CSV text, for `triaxcal log export` and `triaxcal apply`."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TextIO

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import RecordingError


@dataclass(frozen=True)
class Rows:
    """Some lines of a table: their times (n,), and what else is in them by
    name, (n,) each: arrays of floats, or cells as they stood in the table that
    was read."""

    time_ns: tc.Ints
    columns: Mapping[str, Any]

    @classmethod
    def of(cls, block: td.SampleBlock) -> Rows:
        outputs = dict(zip(("ux", "uy", "uz"), block.readings.T, strict=True))
        return cls(block.time_ns, outputs | dict(block.channels))

    def __len__(self) -> int:
        return len(self.time_ns)


def write_csv(out: TextIO, blocks: Iterable[Rows], start_ns: int | None = None) -> int:
    """Header ``t_s,ux,uy,uz`` and the other columns', one line a sample; the
    number of samples.

    Times count from ``start_ns``, the first sample where that is None, to the
    nanosecond; values are the shortest text that reads back as the same number.
    Raises RecordingError where a block has other columns than the first.
    """
    samples = 0
    names: Sequence[str] | None = None
    for block in blocks:
        if names is None:
            out.write(_line(["t_s", *block.columns]))
        names = require_alike(block, names, samples)
        if not len(block):
            continue
        start_ns = int(block.time_ns[0]) if start_ns is None else start_ns
        out.writelines(_lines(block, start_ns))
        samples += len(block)
    if names is None:
        out.write("t_s,ux,uy,uz\n")
    return samples


def require_alike(block: Rows, names: Sequence[str] | None, samples: int) -> Sequence[str]:
    """The names of its columns, which are those of the blocks before. Raises
    RecordingError."""
    if names is not None and list(block.columns) != names:
        raise RecordingError(f"channels {list(block.columns)[3:]} after sample {samples}, expected {list(names)[3:]}")
    return list(block.columns)


def _lines(block: Rows, start_ns: int) -> Iterable[str]:
    columns = [_texts(values) for values in block.columns.values()]
    for time_ns, *values in zip((block.time_ns - start_ns).tolist(), *columns, strict=True):
        sign = "-" if time_ns < 0 else ""
        seconds, ns = divmod(abs(time_ns), 1_000_000_000)
        yield f"{sign}{seconds}.{ns:09d},{','.join(values)}\n"


def _texts(values: Any) -> Iterable[str]:
    if isinstance(values, np.ndarray):
        return map(repr, values.tolist())
    return ("" if cell is None else _quoted(str(cell)) for cell in values.to_pylist())


def _quoted(cell: str) -> str:
    return _line([cell])[:-1] if set(cell) & set(',"\r\n') else cell


def _line(cells: Sequence[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
