"""Writes samples as CSV text, for `triaxcal log export`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TextIO

from triaxcal_drivers.interface import SampleBlock
from triaxcald.errors import RecordingError


def write_csv(out: TextIO, blocks: Iterable[SampleBlock]) -> int:
    """Header ``t_s,ux,uy,uz`` and the channels', one line a sample; the number of samples.

    Times count from the first sample, to the nanosecond; values are the shortest text that reads back as the
    same number. Raises RecordingError where a block has other channels than the first.
    """
    samples = 0
    names: list[str] | None = None
    start_ns = 0
    for block in blocks:
        if names is None:
            names = list(block.channels)
            out.write(",".join(["t_s", "ux", "uy", "uz", *names]) + "\n")
        if not len(block):
            continue
        if list(block.channels) != names:
            raise RecordingError(f"channels {list(block.channels)} after sample {samples}, expected {names}")
        if samples == 0:
            start_ns = int(block.time_ns[0])
        out.writelines(_lines(block, start_ns))
        samples += len(block)
    if names is None:
        out.write("t_s,ux,uy,uz\n")
    return samples


def _lines(block: SampleBlock, start_ns: int) -> Iterable[str]:
    columns = [block.readings[:, axis].tolist() for axis in range(3)]
    columns += [channel.tolist() for channel in block.channels.values()]
    for time_ns, *values in zip((block.time_ns - start_ns).tolist(), *columns, strict=True):
        sign = "-" if time_ns < 0 else ""
        seconds, ns = divmod(abs(time_ns), 1_000_000_000)
        yield f"{sign}{seconds}.{ns:09d},{','.join(map(repr, values))}\n"
