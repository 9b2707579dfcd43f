"""Writes samples as CSV text, for `triaxcal log export` and `triaxcal apply`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TextIO

from triaxcal.arrays import Floats
from triaxcal_drivers.interface import SampleBlock
from triaxcald.errors import RecordingError


def write_csv(out: TextIO, blocks: Iterable[SampleBlock], start_ns: int | None = None) -> int:
    """Header ``t_s,ux,uy,uz`` and the channels', one line a sample; the number of samples.

    Times count from ``start_ns``, the first sample where that is None, to the nanosecond; values are the shortest text
    that reads back as the same number. Raises RecordingError where a block has other channels than the first.
    """
    samples = 0
    names: Sequence[str] | None = None
    for block in blocks:
        if names is None:
            out.write(",".join(["t_s", "ux", "uy", "uz", *block.channels]) + "\n")
        names = require_alike(block, names, samples)
        if not len(block):
            continue
        start_ns = int(block.time_ns[0]) if start_ns is None else start_ns
        out.writelines(_lines(block, start_ns))
        samples += len(block)
    if names is None:
        out.write("t_s,ux,uy,uz\n")
    return samples


def require_alike(block: SampleBlock, names: Sequence[str] | None, samples: int) -> Sequence[str]:
    """The names of its channels, which are those of the blocks before. Raises RecordingError."""
    if names is not None and list(block.channels) != names:
        raise RecordingError(f"channels {list(block.channels)} after sample {samples}, expected {names}")
    return list(block.channels)


def columns_of(block: SampleBlock) -> dict[str, Floats]:
    """Readings and channels by name, (n,) each."""
    return dict(zip(("ux", "uy", "uz"), block.readings.T, strict=True)) | dict(block.channels)


def _lines(block: SampleBlock, start_ns: int) -> Iterable[str]:
    columns = [values.tolist() for values in columns_of(block).values()]
    for time_ns, *values in zip((block.time_ns - start_ns).tolist(), *columns, strict=True):
        sign = "-" if time_ns < 0 else ""
        seconds, ns = divmod(abs(time_ns), 1_000_000_000)
        yield f"{sign}{seconds}.{ns:09d},{','.join(map(repr, values))}\n"
