"""Counts of activity are refused, whole readings of any converter are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.daemon.tables.exports import ACTIGRAPH
from tests.daemon.tables.written import asked, read
from triaxcald.tables.samples import Reading

RNG = np.random.default_rng(5)
COUNTS = (RNG.gamma(0.3, 300, (300, 3)) * (RNG.random((300, 1)) > 0.4)).astype(int)
"""An actigraph's: 0 where the wearer rests, skew where he moves."""
DIRECTIONS = RNG.normal(size=(300, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1)[:, None]
BY_NUMBER = {"ux": "1", "uy": "2", "uz": "3"}


def rows(values: object, before: str = "") -> str:
    return before + "".join(",".join(map(str, row)) + "\n" for row in np.asarray(values).tolist())


@pytest.mark.parametrize("epoch", ["00:00:01", "00:01:00"])
@pytest.mark.parametrize("header", ["", "Axis1,Axis2,Axis3\n"])
def test_counts_under_a_head_that_states_their_epoch(tmp_path: Path, epoch: str, header: str) -> None:
    head = ACTIGRAPH.replace("(hh:mm:ss) 00:00:00", f"(hh:mm:ss) {epoch}").replace(" at 100 Hz ", " ")
    assert "not acceleration" in asked(tmp_path, head + rows(COUNTS, header))


@pytest.mark.parametrize("rate", [1.0, 0.1, 30.0])
@pytest.mark.parametrize("header", ["", "Axis1,Axis2,Axis3\n", "x,y,z\n"])
def test_counts_without_a_head(tmp_path: Path, header: str, rate: float) -> None:
    assert "not acceleration" in asked(
        tmp_path, rows(COUNTS, header), Reading(BY_NUMBER if not header else {}, rate=rate)
    )


@pytest.mark.parametrize(("offset", "scale"), [(512, 100), (128, 84), (2048, 820), (32768, 16384), (100, 99)])
def test_a_converter_without_a_sign_is_read(tmp_path: Path, offset: int, scale: int) -> None:
    values = np.rint(offset + scale * DIRECTIONS).astype(int)
    table = read(tmp_path, rows(values, "Epoch time 1709993100\nx,y,z\n"), Reading(rate=1.0))
    np.testing.assert_array_equal(table.samples.readings, values)


@pytest.mark.parametrize(
    ("data", "package"),
    [(b"MD\xfc\x03" + bytes(1020), "actipy"), (b"Device Identity\r\nDevice Type:GENEActiv\r\n", "actipy")],
)
def test_a_file_of_a_wearable_names_its_converter(tmp_path: Path, data: bytes, package: str) -> None:
    assert package in asked(tmp_path, data)  # type: ignore[arg-type]
