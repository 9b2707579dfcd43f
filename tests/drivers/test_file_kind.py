"""What a file is, by its first bytes."""

from __future__ import annotations

import gzip
import io
import zipfile

import numpy as np
import pytest

from triaxcal_drivers.files import document_kind, kind, special_kind


def _zipped() -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a", "b")
    return out.getvalue()


def _array() -> bytes:
    out = io.BytesIO()
    np.save(out, np.zeros(3))
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (bytes.fromhex("89 4d 43 41 50 30 0d 0a 01"), "an MCAP file"),
        (gzip.compress(b"t_s,ux,uy,uz\n", mtime=0), "a gzip file"),
        (bytes.fromhex("50 41 52 31 15 04 15 00"), "a Parquet file"),
        (_zipped(), "a ZIP file, as spreadsheets are"),
        (_array(), "a NumPy file"),
        (b'{"format": "triaxcal.calibration/1"}', "a JSON document of format triaxcal.calibration/1"),
        (b'\xef\xbb\xbf {\n "format" : "triaxcal.loop/1",', "a JSON document of format triaxcal.loop/1"),
        (b'{"result": {"format": "triaxcal.loop/1"}}', "a JSON document"),
        (b'{"format": "\x1b[31m/1"}', "a JSON document"),
        (b'[{"a": 1}]', "a JSON document"),
        (b'# A station.\nname = "x"\nformat = "triaxcal.station/1"\n', "a TOML file of format triaxcal.station/1"),
        (b"format='triaxcal.device/1'", "a TOML file of format triaxcal.device/1"),
        (b'[[units]]\nformat = "triaxcal.device/1"\n', "text"),
        (b"PAR1 = 1\nMDF = 2", "text"),
        (b"LOGGER,ux,uy,uz\n", "text"),
        ("temperature [°C]\n".encode() * 1000, "text"),
        (b"\xc2" + b"\xb0\xc2" * 5000, "text"),
        (b"\0\1\2", "a binary file of no known kind"),
        (b"\xff\xfe", "a binary file of no known kind"),
        (b"", "an empty file"),
    ],
)
def test_a_file_is_named_by_its_first_bytes(data: bytes, expected: str) -> None:
    assert kind(data) == expected
    special = expected.startswith("a") and "binary" not in expected and "empty" not in expected
    assert special_kind(data) == (expected if special else None)
    assert document_kind(data) == (expected if " of format " in expected else None)


def test_a_reader_of_json_is_told_of_no_json_and_one_of_toml_of_no_toml() -> None:
    document, table = b'{"format": "triaxcal.plan/1"}', b'format = "triaxcal.device/1"'
    assert special_kind(document, json=False) is None
    assert special_kind(table, toml=False) is None
    assert special_kind(document, toml=False) == kind(document)
    assert special_kind(table, json=False) == kind(table)
