"""The demo: two units with an effect hidden in each; it is found, written back and gone after a power cycle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.documents import to_text
from triaxcald.schema.run import Demo


@pytest.mark.slow
def test_the_demo_finds_what_is_hidden_and_it_is_gone_after_a_power_cycle(
    tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    done = triaxcal("demo", "--out", tmp_path / "out", "--seed", "1", "--json")
    assert done.code == 0, done.err
    read = Demo.read(done.json)
    assert read is not None
    assert to_text(read.document()) == to_text(done.json)
    assert [u["unit"] for u in done.json["units"]] == ["can", "modbus"]
    for unit in done.json["units"]:
        assert unit["found"] is True
        (finding,) = (*unit["findings"], *unit["candidates"])
        assert finding["effect"] in unit["hidden"]
        for axis, truth in unit["hidden"][finding["effect"]].items():
            held = finding["coefficients"][axis]
            assert abs(held["value"] - truth) < 5 * held["standard_error"]
        assert unit["after"]["rms_g"] < 0.5 * unit["before"]["rms_g"]
        assert unit["verification"]["before_rms_g"] > 1e-3
        assert unit["verification"]["after_rms_g"] < 5e-5
        assert unit["after_power_cycle_rms_g"] < 5e-5
        for paper in ("recording", "certificate", "report"):
            assert Path(unit[paper]).parent == tmp_path / "out"
            assert Path(unit[paper]).stat().st_size > 0
        assert triaxcal("audit", unit["recording"]).code == 0


def test_a_demo_that_has_no_place_is_an_error(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    (tmp_path / "file").touch()
    triaxcal("demo", "--out", tmp_path / "file").failed(2, f"{tmp_path / 'file'}: File exists")
