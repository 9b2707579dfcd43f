"""The native CSV: reads samples from it, fast for valid files, exact about the first
fault of others; writes it for `triaxcal log export` and `triaxcal apply`."""

from __future__ import annotations

import csv
import gzip
import io
import re
import sys
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TextIO

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError, RecordingError
from triaxcald.stores import path_of

# The bytes of a table, a few MiB at a time: of a file, a gzip file, a pipe or
# standard input.

BLOCK = 2**22
EXPANSION_MOST = 200
"""So many times what is read of it may a gzip file unpack to, and one block.
Text of numbers comes to a third or a tenth, with two hundred columns that never
change to a hundredth; nothing but one and the same, to a thousandth."""


def label_of(name: str) -> str:
    return "standard input" if name == "-" else name


def blocks(source: Path | str | BinaryIO, label: str) -> Iterator[bytes]:
    """Of a file, ``.gz`` unpacked, of standard input (``-``) or of a stream.
    Raises InputError."""
    if not isinstance(source, Path | str):
        yield from _of(source, label)
    elif str(source) == "-":
        yield from _of(sys.stdin.buffer, label)
    else:
        packed = str(source).endswith(".gz")
        try:
            with td.files.open_file(path_of(str(source)), pipe=not packed) as file:
                if packed:
                    with gzip.GzipFile(fileobj=file) as unzipped:
                        yield from _of(unzipped, label, file)
                else:
                    yield from _of(file, label)
        except OSError as e:
            raise InputError(f"{label}: cannot be read: {e.strerror or e}") from e


def whole_lines(first: bytes) -> bytes:
    """Of the first block: it may end within a line, and within a letter."""
    return first[: first.rfind(b"\n") + 1] or first if len(first) >= BLOCK else first


def _of(stream: BinaryIO | gzip.GzipFile, label: str, packed: BinaryIO | None = None) -> Iterator[bytes]:
    unpacked = 0
    while block := _block(stream, label):
        unpacked += len(block)
        if packed is not None and unpacked > EXPANSION_MOST * packed.tell() + BLOCK:
            raise InputError(f"{label}: unpacks to more than {EXPANSION_MOST} times its size")
        yield block


def _block(stream: BinaryIO | gzip.GzipFile, label: str) -> bytes:
    try:
        return stream.read(BLOCK)
    except EOFError:
        raise InputError(f"{label}: the gzip data end too early, expected a whole file") from None
    except (gzip.BadGzipFile, zlib.error) as e:
        raise InputError(f"{label}: not readable as gzip: {e}") from e


# Reading.

REQUIRED = ("t_s", "ux", "uy", "uz")
_LINE_LIMIT = 2**20  # bytes; no line of numbers is that long
_VALUE_LIMIT = 1e100  # squares of values, and sums of them, have to be numbers too
TIME_LIMIT_S = 9.2e9  # beyond, nanoseconds do not fit 64 bits
FIELDS_MOST = 1000  # a table of numbers has some ten
_NUMBER_MOST = 400  # characters of a number; those of the longest are its zeros, 308 of them
_SKIP = "--skip-bad leaves such lines out"
_DASHES = re.compile(rb"[^0-9A-Za-z.]*(?:-{2}|={2}|_{2})[^0-9A-Za-z.]*")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMENTS = re.compile(r"^(?:[ \t]*#[^\n]*(?:\n|\Z))++", re.MULTILINE)
_BLANK = re.compile(r"(?:[ \t\r]*(?:#[^\n]*)?\n)*+")


@dataclass(frozen=True)
class CsvSamples:
    """Samples of a file: ``time_ns`` (n,) strictly increasing, from the file's own
    zero; ``readings`` (n,3); ``channels`` (n,) each.

    ``duplicates`` counts rows that repeat the row before them exactly; they are
    excluded.
    """

    time_ns: NDArray[np.int64]
    readings: NDArray[np.float64]
    channels: Mapping[str, NDArray[np.float64]]
    duplicates: int = 0


def read_csv(source: Path | str | BinaryIO, name: str | None = None) -> CsvSamples:
    """Read a ``.csv`` or ``.csv.gz`` file, standard input (``-``) or a stream of
    bytes.

    ``name`` stands for the input in messages. Raises InputError: file, line,
    field, what was expected.
    """
    label = name or (label_of(str(source)) if isinstance(source, Path | str) else "CSV")
    return samples_of_blocks(blocks(source, label), label)


def samples_of_blocks(data: Iterable[bytes], label: str) -> CsvSamples:
    """The same of bytes as they are read."""
    return _Parse(label).run(data)


def is_native(head: bytes) -> bool:
    """Whether text that begins so has our header, behind comments at most; below it
    our layout draws no dashes."""
    lines = head.removeprefix(b"\xef\xbb\xbf").split(b"\n")
    told = (line for line in map(bytes.strip, lines) if line and not line.startswith(b"#"))
    first, second = next(told, b""), next(told, b"")
    if _DASHES.fullmatch(second):
        return False
    return [field.strip() for field in first.split(b",")][: len(REQUIRED)] == [n.encode() for n in REQUIRED]


def _fields_of(line: str) -> list[str]:
    """Of a header, as RFC 4180 has quotes."""
    try:
        return next(csv.reader([line], skipinitialspace=True)) if '"' in line else line.split(",")
    except csv.Error:  # a name of more than 128 KiB
        return line.split(",")


def is_applied(names: Sequence[str]) -> bool:
    """Whether a table of our own layout with these columns is what
    `triaxcal apply` writes."""
    return any(
        tuple(names[-len(behind) :]) == behind
        for behind in (tc.documents.OUT, tc.documents.OUT + tc.documents.UNCERTAINTY)
    )


def header_of(data: bytes, label: str) -> tuple[str, tuple[str, ...], int]:
    """The text of a whole file, its names, and in which line, 0-based, its
    samples begin. Raises InputError."""
    parse = _Parse(label)
    text = parse.decoded(data.removeprefix(b"\xef\xbb\xbf")).replace("\r\n", "\n")
    names, first = parse.header(text)
    return text, names, first


class _Parse:
    """One reading of one file: where it is, and what it has found."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._line = 0  # lines done with
        self._fields: list[str] = []
        self._before: NDArray[np.float64] | None = None  # the last row
        self._tables: list[NDArray[np.float64]] = []
        self._times: list[NDArray[np.int64]] = []
        self._duplicates = 0

    def run(self, data: Iterable[bytes]) -> CsvSamples:
        empty = True
        for text in self._texts(data):
            empty = False
            self._take(text)
        if empty:
            raise InputError(f"{self._name}: empty file, expected the header {','.join(REQUIRED)}")
        if not self._fields:
            raise InputError(f"{self._name}: only comments, expected the header {','.join(REQUIRED)}")
        if not self._tables:
            raise InputError(f"{self._name}: line {self._line}: no samples after the header, expected some")
        table = np.concatenate(self._tables)
        channels = {name: table[:, i].copy() for i, name in enumerate(self._fields) if i >= len(REQUIRED)}
        return CsvSamples(np.concatenate(self._times), table[:, 1:4].copy(), channels, self._duplicates)

    def _fail(self, line: int, what: str) -> NoReturn:
        raise InputError(f"{self._name}: line {line}: {what}")

    def _texts(self, data: Iterable[bytes]) -> Iterator[str]:
        """Whole lines."""
        rest = b""
        first = True
        for block in data:
            if first:
                block = block.removeprefix(b"\xef\xbb\xbf")
                first = False
            block = rest + block
            end = block.rfind(b"\n") + 1
            rest = block[end:]
            if len(rest) > _LINE_LIMIT:
                self._fail(self._line + block.count(b"\n") + 1, "no end of line, expected CSV text")
            if end:
                yield self.decoded(block[:end])
        if rest:
            yield self.decoded(rest)

    def header(self, text: str) -> tuple[tuple[str, ...], int]:
        """The names, and in which line, 0-based, the samples begin."""
        self._header(text)
        return tuple(self._fields), self._line

    def decoded(self, data: bytes) -> str:
        nul = data.find(b"\0")
        if nul >= 0 or data.startswith((b"\x1f\x8b", b"\x89MCAP")):
            self._fail(self._line + data.count(b"\n", 0, max(nul, 0)) + 1, "binary data, expected CSV text")
        try:
            return data.decode()
        except UnicodeDecodeError as e:
            line = self._line + data.count(b"\n", 0, e.start) + 1
            self._fail(line, f"byte 0x{data[e.start]:02x}, expected UTF-8 text")

    def _take(self, text: str) -> None:
        if not self._fields:
            text = self._header(text)
            if not self._fields:
                return
        rows = self._fast(text)
        lines = None
        if rows is None:
            rows, lines = self._slow(text)
        if len(rows):
            self._keep(rows, text, lines)
        self._line += text.count("\n") + (not text.endswith("\n") and bool(text))

    def _header(self, text: str) -> str:
        """Takes the header off; what follows it."""
        skipped = _BLANK.match(text)
        at = skipped.end() if skipped else 0
        end = text.find("\n", at) + 1 or len(text)
        line = text[at:end].strip()
        self._line += text.count("\n", 0, at) + (at < len(text))
        if line and not line.startswith("#"):
            self._fields = self._check_header([field.strip() for field in _fields_of(line)])
        return text[end:]

    def _check_header(self, fields: list[str]) -> list[str]:
        expected = f"expected the header {','.join(REQUIRED)} and any further names"
        if _NUMBER.fullmatch(fields[0]):
            self._fail(self._line, f"no header, {expected}")
        for i, name in enumerate(REQUIRED):
            if i >= len(fields) or fields[i] != name:
                found = f"'{fields[i][:40]}'" if i < len(fields) else "nothing"
                self._fail(self._line, f"field {i + 1} of the header is {found} instead of '{name}', {expected}")
        if len(fields) > FIELDS_MOST:
            self._fail(self._line, f"{len(fields)} fields in the header, expected at most {FIELDS_MOST}")
        for i, field in enumerate(fields):
            if not field:
                self._fail(self._line, f"field {i + 1} of the header has no name, {expected}")
            if field in fields[:i]:
                self._fail(self._line, f"'{field[:40]}' is in the header twice, expected each name once")
        return fields

    def _fast(self, text: str) -> NDArray[np.float64] | None:
        """The rows, or None where anything at all is out of the ordinary."""
        if "#" in text:
            text = _COMMENTS.sub("", text)
        if not text or text.isspace():
            return np.empty((0, len(self._fields)))
        try:
            rows = np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2, comments=None)
        except ValueError:
            return None
        usual = rows.shape[1] == len(self._fields) and (np.abs(rows) < _VALUE_LIMIT).all()
        return rows if usual and (np.abs(rows[:, 0]) < TIME_LIMIT_S).all() else None

    def _slow(self, text: str) -> tuple[NDArray[np.float64], list[int]]:
        """The rows and their line numbers, or the first fault."""
        rows: list[list[float]] = []
        numbers: list[int] = []
        for number, line in enumerate(text.split("\n"), start=self._line + 1):
            stripped = line.strip()
            if stripped and not stripped.startswith("#"):
                rows.append(self._row(number, stripped))
                numbers.append(number)
        return np.array(rows).reshape(-1, len(self._fields)), numbers

    def _row(self, number: int, line: str) -> list[float]:
        texts = line.split(",")
        if len(texts) != len(self._fields):
            names = ",".join(self._fields)
            what = f"{len(texts)} fields, expected {len(self._fields)} ({td.hints.clipped(names)})"
            self._fail(number, f"{what}; {_SKIP}")
        row = []
        for field, text in zip(self._fields, map(str.strip, texts), strict=True):
            if not text:
                self._fail(number, f"field {td.hints.clipped(field)}: empty, expected a number; {_SKIP}")
            value = float(text) if len(text) <= _NUMBER_MOST and _NUMBER.fullmatch(text) else float("nan")
            if not abs(value) < _VALUE_LIMIT:
                self._fail(number, f"field {td.hints.clipped(field)}: '{text[:40]}', expected a finite number; {_SKIP}")
            row.append(value)
        if abs(row[0]) >= TIME_LIMIT_S:
            self._fail(number, f"field t_s: {texts[0].strip()[:40]}, expected seconds below {TIME_LIMIT_S:g}")
        return row

    def _keep(self, rows: NDArray[np.float64], text: str, lines: list[int] | None) -> None:
        """Adds the rows but for exact repetitions; times must rise."""
        chain = rows if self._before is None else np.vstack((self._before, rows))
        time_ns = np.rint(chain[:, 0] * 1e9).astype(np.int64)
        step = np.diff(time_ns)
        repeated = (chain[1:] == chain[:-1]).all(axis=1)
        wrong = np.flatnonzero((step <= 0) & ~repeated)
        if len(wrong):
            i = int(wrong[0]) + 1 - (len(chain) - len(rows))  # of the rows
            number = (lines if lines is not None else self._slow(text)[1])[i]
            before, after = chain[int(wrong[0]) : int(wrong[0]) + 2, 0].tolist()
            what = "comes twice with different values" if before == after else f"follows {before!r}"
            self._fail(number, f"field t_s: {after!r} {what}, expected times that rise")
        if self._before is None:
            keep = np.concatenate(([True], ~repeated))
        else:
            keep, time_ns = ~repeated, time_ns[1:]
        self._duplicates += int(len(keep) - keep.sum())
        self._before = rows[-1]
        self._tables.append(rows[keep])
        self._times.append(time_ns[keep])


# Writing.


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
