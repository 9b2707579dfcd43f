from __future__ import annotations

import gzip
import io
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcald.errors import InputError
from triaxcald.tables import native_csv
from triaxcald.tables.native_csv import CsvSamples, read_csv

HEAD = b"t_s,ux,uy,uz\n"
DATASETS = Path(__file__).parents[4] / "shared" / "datasets"


def read(data: bytes) -> CsvSamples:
    return read_csv(io.BytesIO(data), "a.csv")


def test_samples_and_channels_are_read() -> None:
    found = read(b"t_s,ux,uy,uz,temp_c,supply_v\n0.000,1,2,3,21.5,5\n0.010,-1e-3,+.5,6.,22,4.9\n")
    assert found.time_ns.tolist() == [0, 10_000_000]
    assert found.readings.tolist() == [[1, 2, 3], [-0.001, 0.5, 6]]
    assert {name: values.tolist() for name, values in found.channels.items()} == {
        "temp_c": [21.5, 22],
        "supply_v": [5, 4.9],
    }
    assert found.time_ns.dtype == np.int64


@pytest.mark.parametrize(
    "text",
    [
        b"# before\n\nt_s,ux,uy,uz\n# between\n0,1,2,3\n\n   \n  # indented, with, commas\n1,4,5,6\n# after\n",
        b" t_s , ux,uy ,uz \n 0, 1 ,2,3\n1,4,5 , 6 \n",
        b"t_s,ux,uy,uz\r\n0,1,2,3\r\n1,4,5,6\r\n",
        b"\xef\xbb\xbft_s,ux,uy,uz\n0,1,2,3\n1,4,5,6",
        b"t_s,ux,uy,uz\n0,1,2,3\n# temp\xc3\xa9rature\n1,4,5,6\n",
    ],
)
def test_comments_blank_lines_spaces_line_ends_and_a_byte_order_mark_do_no_harm(text: bytes) -> None:
    found = read(text)
    assert found.time_ns.tolist() == [0, 1_000_000_000]
    assert found.readings.tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (b"", "empty file, expected the header t_s,ux,uy,uz"),
        (b"# nothing\n\n", "only comments, expected the header t_s,ux,uy,uz"),
        (HEAD, "line 1: no samples after the header, expected some"),
        (HEAD + b"# none\n", "line 2: no samples after the header, expected some"),
        (b"0,1,2,3\n", "line 1: no header, expected the header t_s,ux,uy,uz and any further names"),
        (b"t_s,ux,uz,uy\n", "line 1: field 3 of the header is 'uz' instead of 'uy', expected the header"),
        (b"t_s,ux\n", "line 1: field 3 of the header is nothing instead of 'uy', expected the header"),
        (b"#\nt_s,ux,uy,uz,\n", "line 2: field 5 of the header has no name, expected the header"),
        (b"t_s,ux,uy,uz,a, a\n", "line 1: 'a' is in the header twice, expected each name once"),
        (HEAD + b"0,1,2,3\n1,nan,2,3\n", "line 3: field ux: 'nan', expected a finite number"),
        (HEAD + b"0,1,2,-inf\n", "line 2: field uz: '-inf', expected a finite number"),
        (HEAD + b"0,1,1e999,3\n", "line 2: field uy: '1e999', expected a finite number"),
        (HEAD + b"0,1,,3\n", "line 2: field uy: empty, expected a number"),
        (HEAD + b"#\n\n0,1,2,3\n1,1,two,3\n", "line 5: field uy: 'two', expected a finite number"),
        (HEAD + b"0,1,1_0,3\n", "line 2: field uy: '1_0', expected a finite number"),
        (HEAD + b"0,1,0x10,3\n", "line 2: field uy: '0x10', expected a finite number"),
        (HEAD + b'0,1,"2",3\n', "line 2: field uy: '\"2\"', expected a finite number"),
        (HEAD + b"0,1,2,3,4\n", "line 2: 5 fields, expected 4 (t_s,ux,uy,uz)"),
        (HEAD + b"0,1,2,3\n1,2\n", "line 3: 2 fields, expected 4 (t_s,ux,uy,uz)"),
        (HEAD + b"0,1,2\n", "line 2: 3 fields, expected 4 (t_s,ux,uy,uz)"),
        (HEAD + b"0;1;2;3\n", "line 2: 1 fields, expected 4 (t_s,ux,uy,uz)"),
        (HEAD + b"0,1,2,3\n#\n2,1,2,3\n1,1,2,3\n", "line 5: field t_s: 1.0 follows 2.0, expected times that rise"),
        (
            HEAD + b"0,1,2,3\n0,1,2,4\n",
            "line 3: field t_s: 0.0 comes twice with different values, expected times that rise",
        ),
        (HEAD + b"1e10,1,2,3\n", "line 2: field t_s: 1e10, expected seconds below 9.2e+09"),
        (HEAD + b"0,1,2,3\n1,\xb5,2,3\n", "line 3: byte 0xb5, expected UTF-8 text"),
        (HEAD + b"0,1,2,3\n\0\0", "line 3: binary data, expected CSV text"),
        (b"\x89MCAP0\r\n\x01", "line 1: binary data, expected CSV text"),
        (gzip.compress(HEAD, mtime=0), "line 1: binary data, expected CSV text"),
        (HEAD + b"1" * 2**21, "line 2: no end of line, expected CSV text"),
    ],
    ids=lambda value: value if isinstance(value, str) else "text",
)
def test_a_fault_is_told_with_its_line_its_field_and_what_was_expected(text: bytes, expected: str) -> None:
    with pytest.raises(InputError) as e:
        read(text)
    message = str(e.value)
    assert message.startswith(f"a.csv: {expected}")
    assert "\n" not in message


def test_a_fault_far_into_a_long_file_has_the_right_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native_csv, "BLOCK", 64)
    good = HEAD + b"# c\n" + b"".join(b"%d.5,1,2,3\n" % i for i in range(500))
    assert len(read(good).time_ns) == 500
    with pytest.raises(InputError, match=r"line 503: field uy: 'x'"):
        read(good + b"600,1,x,3\n")
    with pytest.raises(InputError, match=r"line 503: field t_s: 499\.0 follows 499\.5"):
        read(good + b"499,1,2,3\n")
    with pytest.raises(InputError, match=r"line 503: byte 0xff"):
        read(good + b"600,1,\xff,3\n")


def test_rows_that_repeat_exactly_are_left_out_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    text = HEAD + b"0,1,2,3\n" * 3 + b"1,4,5,6\n" * 2
    for block in (2**22, 8):
        monkeypatch.setattr(native_csv, "BLOCK", block)
        found = read(text)
        assert found.time_ns.tolist() == [0, 1_000_000_000]
        assert found.duplicates == 3


@pytest.mark.slow
@given(
    st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=30),
    st.integers(1, 100),
    st.lists(st.integers(0, 30), max_size=4),
)
def test_the_samples_do_not_depend_on_how_the_text_is_cut(
    readings: list[tuple[float, float, float]], block: int, comments: list[int]
) -> None:
    lines = [f"{i},{x!r},{y!r},{z!r}\n" for i, (x, y, z) in enumerate(readings)]
    for at in comments:
        lines.insert(min(at, len(lines)), "# a comment\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(native_csv, "BLOCK", block)
        found = read(HEAD + "".join(lines).encode())
    assert found.readings.tolist() == [list(row) for row in readings]


def test_gzip_is_read_and_its_faults_are_told(tmp_path: Path) -> None:
    path = tmp_path / "a.csv.gz"
    packed = gzip.compress(HEAD + b"".join(b"%d,%d,2,3\n" % (i, i * 7919 % 1013) for i in range(5000)))
    path.write_bytes(packed)
    assert len(read_csv(path).time_ns) == 5000
    path.write_bytes(packed[:-100])
    with pytest.raises(InputError, match=r"a\.csv\.gz: the gzip data end too early, expected a whole file$"):
        read_csv(path)
    path.write_bytes(HEAD)
    with pytest.raises(InputError, match=r"a\.csv\.gz: not readable as gzip: Not a gzipped file"):
        read_csv(path)
    path.write_bytes(packed[:-8] + bytes([packed[-8] ^ 1]) + packed[-7:])
    with pytest.raises(InputError, match=r"a\.csv\.gz: not readable as gzip: CRC check failed"):
        read_csv(path)
    path.write_bytes(packed[:200] + bytes([packed[200] ^ 0xFF]) * 50 + packed[250:])
    with pytest.raises(InputError, match=r"a\.csv\.gz: "):
        read_csv(path)


def test_a_dash_is_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(HEAD + b"0,1,2,x\n")))
    with pytest.raises(
        InputError, match=r"^standard input: line 2: field uz: 'x', expected a finite number; --skip-bad"
    ):
        read_csv("-")


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.csv: cannot be read: No such file or directory$"):
        read_csv(tmp_path / "none.csv")


@pytest.mark.slow
@pytest.mark.datasets
@pytest.mark.skipif(not DATASETS.is_dir(), reason="the measured recordings are not beside the project")
def test_the_measured_recordings_are_read() -> None:
    paths = sorted(DATASETS.glob("*/*.csv.gz"))
    assert paths
    for path in paths:
        with gzip.open(path) as text:
            lines = sum(1 for _ in text)
        found = read_csv(path)
        assert len(found.time_ns) + found.duplicates == lines - 1
        assert (np.diff(found.time_ns) > 0).all()


@pytest.mark.slow
def test_a_table_of_two_hundred_constant_columns_is_no_gzip_bomb(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv.gz"
    names, rest = "".join(f",c{i}" for i in range(200)), ",0.000" * 200
    rng = np.random.default_rng(1)
    rows = "".join(
        f"{i / 100},{x:.6f},{y:.6f},{z:.6f}{rest}\n" for i, (x, y, z) in enumerate(rng.normal(size=(5000, 3)))
    )
    path.write_bytes(gzip.compress(f"t_s,ux,uy,uz{names}\n{rows}".encode()))
    assert len(read_csv(path).time_ns) == 5000


@pytest.mark.slow
def test_a_gzip_file_that_unpacks_to_a_thousand_times_its_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.csv.gz"
    path.write_bytes(gzip.compress(b"t_s,ux,uy,uz\n" + b"0,1,2,3\n" * 2**20))
    with pytest.raises(InputError, match="unpacks to more than 200 times its size"):
        read_csv(path)
