"""Tables in columns (Parquet), behind the one file that knows the library for them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from triaxcal_drivers.interface import SampleBlock
from triaxcald.recording.export import columns_of, require_alike


def write_parquet(path: Path, blocks: Iterable[SampleBlock], start_ns: int | None = None) -> int:
    """As `triaxcald.recording.export.write_csv`, times in seconds as floats; the number of samples. ``path`` is
    overwritten. Raises RecordingError, OSError."""
    import pyarrow as pa  # 50 MB that nothing else needs
    import pyarrow.parquet as pq

    samples, names, writer = 0, None, None
    try:
        for block in blocks:
            names = require_alike(block, names, samples)
            if not len(block):
                continue
            start_ns = int(block.time_ns[0]) if start_ns is None else start_ns
            columns = {"t_s": (block.time_ns - start_ns) * 1e-9, **columns_of(block)}
            table = pa.table({name: pa.array(np.ascontiguousarray(v)) for name, v in columns.items()})
            writer = writer or pq.ParquetWriter(path, table.schema)
            writer.write_table(table)
            samples += len(block)
        if writer is None:
            empty = {name: pa.array([], pa.float64()) for name in ("t_s", "ux", "uy", "uz", *(names or ()))}
            writer = pq.ParquetWriter(path, pa.table(empty).schema)
    finally:
        if writer is not None:
            writer.close()
    return samples
