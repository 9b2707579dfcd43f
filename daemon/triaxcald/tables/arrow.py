"""Tables by pyarrow, behind the one file that knows it: text and Parquet in,
Parquet out."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.tables.layout import DATED, DAY_TIME, MISSING, MOMENT
from triaxcald.tables.native_csv import Rows, require_alike

if TYPE_CHECKING:
    import pyarrow as pa

_NUMBER = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
CELLS_MOST = 2**25
"""A number that never changes takes no room in a Parquet file, and 8 bytes
here."""
MOSTLY = 0.5
"""A column of which at least this share of the cells are numbers is one of
numbers, and a cell without one a fault; else it is one of texts."""
DAY_NS = 86_400 * 10**9
ROWS_AT_ONCE = 5000
"""Rows of a table that are in memory while it is written."""
BYTES_MOST = 2**30
"""Of a Parquet file's values as they are stored, before compression; in memory
they take a few times as much."""
_NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}


@dataclass(frozen=True)
class Column:
    """One column of a table of n rows.

    ``numbers`` (n,), NaN where a cell holds none; ``moments_ns`` (n,) where the
    cells are moments, from 1970 or from midnight. ``gaps`` (n,) are cells that
    hold nothing, and ``strange`` (n,) those with something else than a number
    or a moment. ``whole`` are all numbers without a fraction, exactly, as far
    as they fit 64 bits. ``cells`` are what stood there.
    """

    numbers: NDArray[np.float64]
    gaps: NDArray[np.bool_]
    strange: NDArray[np.bool_]
    moments_ns: NDArray[np.int64] | None = None
    whole: NDArray[np.int64] | None = None
    texts: Any = None
    cells: Any = None

    @property
    def usable(self) -> NDArray[np.bool_]:
        return ~(self.gaps | self.strange)

    @property
    def share(self) -> float:
        """Of its cells those that hold a number."""
        return float(self.usable.mean()) if len(self.numbers) and self.moments_ns is None else 0.0

    def equals(self, value: str) -> NDArray[np.bool_]:
        """(n,) whether a cell has this text, or in a file of typed columns this
        number."""
        import pyarrow as pa
        import pyarrow.compute as pc

        if self.texts is not None:
            return np.asarray(pc.equal(self.texts, value))
        if self.cells is not None and not (
            pa.types.is_floating(self.cells.type) or pa.types.is_nested(self.cells.type)
        ):
            return np.asarray(pc.fill_null(pc.equal(pc.cast(self.cells, pa.string()), value), False))
        try:
            return np.asarray(self.numbers == float(value))
        except ValueError:
            return np.zeros(len(self.numbers), bool)

    def over_several_lines(self) -> list[str]:
        """The cells of a text that hold a line end."""
        import pyarrow.compute as pc

        if self.texts is None:
            return []
        found = self.texts.filter(pc.match_substring(self.texts, "\n"))
        return [str(cell) for cell in found[:100].to_pylist()]

    def text(self, row: int) -> str:
        """On one line, though a stray quote may have drawn several into the
        cell."""
        return "" if self.texts is None else " ".join(str(self.texts[row]).split())


@dataclass(frozen=True)
class Ragged:
    """A line that has another number of fields than the others: its index among
    the lines read."""

    row: int
    fields: int


def read_text(text: str, separator: str, decimal: str, fields: int) -> tuple[list[Column], list[Ragged]]:
    """The columns of lines of ``fields`` fields each, and the lines that have
    another number, which are left out.

    Raises ValueError for what is no table at all.
    """
    import pyarrow as pa
    import pyarrow.csv as pc

    ragged: list[Ragged] = []

    def note(row: Any) -> str:
        ragged.append(Ragged(row.number - 1, row.actual_columns))
        return "skip"

    names = [str(i) for i in range(fields)]
    try:
        table = pc.read_csv(
            io.BytesIO(text.encode()),
            pc.ReadOptions(column_names=names, use_threads=False, block_size=max(2**20, min(len(text) + 1, 2**30))),
            pc.ParseOptions(delimiter=separator, invalid_row_handler=note),
            pc.ConvertOptions(
                column_types=dict.fromkeys(names, pa.string()),
                strings_can_be_null=False,
                quoted_strings_can_be_null=False,
            ),
        )
    except pa.ArrowInvalid as e:
        raise ValueError(str(e).splitlines()[0]) from e
    return [replace(_of_text(c, decimal), cells=c) for c in (c.combine_chunks() for c in table.columns)], ragged


def read_parquet(path: td.files.AnyPath) -> tuple[list[str], list[Column]]:
    """Names and columns, nested ones by their path as in a.b. Raises
    InputError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        with td.files.open_file(path) as opened:
            file = pq.ParquetFile(opened)
            if file.metadata.num_rows * file.metadata.num_columns > CELLS_MOST:
                raise InputError(f"{path}: more than {CELLS_MOST} cells")
            if _text_bytes(file) > BYTES_MOST:
                raise InputError(f"{path}: more than {BYTES_MOST} bytes of text")
            table = file.read().flatten()
        while any(pa.types.is_struct(t) for t in table.schema.types):
            table = table.flatten()
        columns = [column.combine_chunks() for column in table.columns]
        return list(table.column_names), [replace(_of_array(column), cells=column) for column in columns]
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror or str(e).splitlines()[0]}") from e
    except (pa.ArrowException, ValueError) as e:
        raise InputError(f"{path}: not readable as Parquet: {str(e).splitlines()[0]}") from e


def _text_bytes(file: Any) -> int:
    """At most, of the columns of text, by the longest value that the file's
    statistics tell of each."""
    total = 0
    for group in range(file.metadata.num_row_groups):
        for i in range(file.metadata.num_columns):
            column = file.metadata.row_group(group).column(i)
            if column.physical_type == "BYTE_ARRAY":
                told = column.statistics
                longest = len(told.max) if told is not None and told.has_min_max else 0
                total += max(column.total_uncompressed_size, longest * column.num_values)
    return total


def chosen(cells: Any, rows: NDArray[np.intp]) -> Any:
    """Those of these rows, as slices of them may be written."""
    import pyarrow as pa

    return cells.take(pa.array(rows))


def _of_array(array: pa.Array) -> Column:
    import pyarrow as pa
    import pyarrow.compute as pc

    kind = array.type
    if isinstance(kind, pa.DictionaryType):
        array = array.dictionary_decode()
        kind = array.type
    gaps = np.asarray(array.is_null())
    n = len(array)
    if pa.types.is_integer(kind):
        filled = pc.fill_null(array, 0)
        numbers = np.asarray(filled).astype(float)
        fits = not pa.types.is_uint64(kind) or bool((np.asarray(filled) < 2**63).all())
        numbers[gaps] = np.nan
        whole = np.asarray(filled).astype(np.int64) if fits else None
        return Column(numbers, gaps, np.zeros(n, bool), whole=whole)
    if pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        numbers = np.asarray(pc.fill_null(pc.cast(array, pa.float64()), np.nan)).copy()
        bad = ~np.isfinite(numbers)
        numbers[bad] = np.nan
        return Column(numbers, bad, np.zeros(n, bool), whole=_whole(numbers, ~bad))
    if pa.types.is_temporal(kind) and not pa.types.is_interval(kind):
        if pa.types.is_date(kind):
            array, kind = pc.cast(array, pa.timestamp("ms")), pa.timestamp("ms")
        counts = np.asarray(pc.fill_null(array.cast(pa.int32() if array.type.bit_width == 32 else pa.int64()), 0))
        moments = counts.astype(np.int64) * _NANOSECONDS[kind.unit]
        return Column(np.full(n, np.nan), gaps, np.zeros(n, bool), moments)
    if pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind):
        return _of_text(pc.fill_null(array, "").cast(pa.string()), ".")
    return Column(np.full(n, np.nan), gaps, ~gaps)


def _of_text(texts: pa.StringArray, decimal: str) -> Column:
    import pyarrow as pa
    import pyarrow.compute as pc

    texts = pc.utf8_trim_whitespace(texts)
    missing = pa.array(sorted(MISSING), pa.string())
    gaps = np.asarray(pc.or_(pc.is_in(pc.utf8_lower(texts), missing), pc.starts_with(texts, "#")))
    moments = _moments(texts, gaps)
    if moments is not None:
        values, strange = moments
        return Column(np.full(len(texts), np.nan), gaps, strange, values, texts=texts)
    pointed = pc.replace_substring(texts, ",", ".") if decimal == "," else texts
    fine = pc.match_substring_regex(pointed, _NUMBER)
    numbers = np.asarray(pc.cast(pc.if_else(fine, pointed, "nan"), pa.float64())).copy()
    strange = ~np.asarray(fine) & ~gaps
    numbers[~np.isfinite(numbers)] = np.nan  # 1e999
    strange |= np.isnan(numbers) & np.asarray(fine)
    return Column(numbers, gaps, strange, whole=_whole_of_text(pointed, ~(gaps | strange), numbers), texts=texts)


def _whole(numbers: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.int64] | None:
    held = np.where(usable, numbers, 0.0)
    if not (held == np.rint(held)).all() or np.abs(held).max(initial=0.0) >= 2**63:
        return None
    return held.astype(np.int64)


def _whole_of_text(
    texts: pa.StringArray, usable: NDArray[np.bool_], numbers: NDArray[np.float64]
) -> NDArray[np.int64] | None:
    """Exactly: nanoseconds since 1970 have more digits than a float."""
    import pyarrow as pa
    import pyarrow.compute as pc

    whole = _whole(numbers, usable)
    if whole is None or np.abs(whole).max(initial=0) < 2**53:
        return whole
    try:
        return np.asarray(pc.cast(pc.if_else(pa.array(usable), pc.utf8_ltrim(texts, characters="+"), "0"), pa.int64()))
    except pa.ArrowInvalid:
        return whole


def _moments(texts: pa.StringArray, gaps: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.bool_]] | None:
    """Nanoseconds where the first cells are moments or times of day, and which
    cells hold none of these.

    Of dates that are not those of ISO 8601 nothing is understood: where all
    rows have the same, the time of day is the time.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    first = next((str(texts[int(i)]) for i in np.flatnonzero(~gaps)[:1]), "")
    if MOMENT.fullmatch(first):
        fine = pc.match_substring_regex(texts, f"^(?:{MOMENT.pattern})$")
        zoned = bool(re.search(r":\d\d(?:[.,]\d+)? ?(?:Z|UTC|[+-]\d\d(?::?\d\d)?)$", first))
        texts = pc.replace_substring_regex(texts, r" ?UTC$", "Z")
        texts = pc.replace_substring_regex(texts, r" (Z|[+-]\d\d(?::?\d\d)?)$", r"\1")
    elif DAY_TIME.fullmatch(first) or DATED.fullmatch(first):
        dated = DATED.fullmatch(first)
        before, after = (dated[1], dated[3] or "") if dated else ("", "")
        fine = pc.match_substring_regex(texts, f"^{re.escape(before)}[ T]*{DAY_TIME.pattern}{re.escape(after)}$")
        zoned = False
        texts = pc.replace_substring_regex(texts, f"^{re.escape(before)}[ T]*(.*?){re.escape(after)}$", r"\1")
        texts = pc.replace_substring_regex(texts, r":(\d{3})$", r".\1")
        if after:  # by the clock of twelve hours, noon and midnight are its zero
            texts = pc.replace_substring_regex(texts, "^12:", "0:")
        texts = pc.binary_join_element_wise("1970-01-01", texts, " ")
        texts = pc.replace_substring_regex(texts, r" (\d:)", r" 0\1")
    else:
        return None
    texts = pc.replace_substring(texts, ",", ".")
    strange = ~np.asarray(fine) & ~gaps
    held = pc.if_else(fine, texts, "1970-01-01T00:00:00" + ("Z" if zoned else ""))
    found = _as_moments(held, pa.timestamp("ns", "UTC" if zoned else None))
    strange |= np.asarray(found.is_null())
    moments = np.asarray(pc.fill_null(found.cast(pa.int64()), 0)).copy()
    if not MOMENT.fullmatch(first):  # the time of day begins again at midnight
        usable = ~(gaps | strange)
        days = np.cumsum(np.diff(moments[usable], prepend=moments[usable][:1]) < -DAY_NS // 2)
        moments[usable] += days * DAY_NS
    return moments, strange


def _as_moments(texts: pa.Array, kind: pa.DataType) -> pa.Array:
    """Null where a text has the form of a moment and is none, as the thirteenth
    month."""
    import pyarrow as pa
    import pyarrow.compute as pc

    try:
        return pc.cast(texts, kind)
    except pa.ArrowInvalid:
        half = len(texts) // 2
        if not half:
            return pa.nulls(len(texts), kind)
        return pa.concat_arrays([_as_moments(texts[:half], kind), _as_moments(texts[half:], kind)])


def write_parquet(path: Path, blocks: Iterable[Rows], start_ns: int | None = None) -> int:
    """As `triaxcald.tables.native_csv.write_csv`, times in seconds as floats;
    the number of samples. ``path`` is overwritten. Raises RecordingError,
    OSError."""
    import pyarrow as pa  # 50 MB that nothing else needs
    import pyarrow.parquet as pq

    samples, names, writer = 0, None, None
    try:
        for block in blocks:
            names = require_alike(block, names, samples)
            if not len(block):
                continue
            start_ns = int(block.time_ns[0]) if start_ns is None else start_ns
            columns = {"t_s": (block.time_ns - start_ns) * 1e-9, **block.columns}
            table = pa.table({name: _array(values) for name, values in columns.items()})
            writer = writer or pq.ParquetWriter(path, table.schema)
            writer.write_table(table)
            samples += len(block)
        if writer is None:
            empty = {name: pa.array([], pa.float64()) for name in ("t_s", *(names or ("ux", "uy", "uz")))}
            writer = pq.ParquetWriter(path, pa.table(empty).schema)
    finally:
        if writer is not None:
            writer.close()
    return samples


def write_rows(path: Path, types: Mapping[str, type], rows: Iterable[Sequence[Any]]) -> None:
    """Rows of cells of these types (str, int, float), None for a gap. ``path`` is
    overwritten. Raises OSError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(name, kinds[of]) for name, of in types.items()])
    waiting = iter(rows)
    with pq.ParquetWriter(path, schema) as writer:
        while block := list(islice(waiting, ROWS_AT_ONCE)):
            columns = [
                pa.array(column, field.type) for column, field in zip(zip(*block, strict=True), schema, strict=True)
            ]
            writer.write_table(pa.Table.from_arrays(columns, schema=schema))


def read_rows(path: Path) -> tuple[list[str], Iterator[dict[str, Any]]]:
    """The columns of a Parquet file, and its rows as they are read. Raises
    InputError."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(path)
    except (OSError, pa.ArrowException) as e:
        raise InputError(f"{path}: not readable as Parquet: {str(e).splitlines()[0]}") from e

    def rows() -> Iterator[dict[str, Any]]:
        try:
            with file:
                for batch in file.iter_batches(ROWS_AT_ONCE):
                    yield from batch.to_pylist()
        except (OSError, pa.ArrowException) as e:
            raise InputError(f"{path}: not readable as Parquet: {str(e).splitlines()[0]}") from e

    return list(file.schema_arrow.names), rows()


def _array(values: Any) -> pa.Array:
    import pyarrow as pa

    return pa.array(np.ascontiguousarray(values)) if isinstance(values, np.ndarray) else values
