"""The notebook in docs/ runs, on five units, and what it shows is what it computed."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

pytestmark = pytest.mark.slow

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tutorial" / "fifty-units.ipynb"
UNITS = "UNITS = 50"


@pytest.fixture(scope="module")
def cells() -> list[dict[str, Any]]:
    found = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


@pytest.fixture(scope="module")
def run(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """The names that the cells leave, with five units."""
    code = ["".join(cell["source"]) for cell in cells]
    assert sum(UNITS in text for text in code) == 1
    mpl.use("Agg")
    names: dict[str, Any] = {"display": print}
    for text in code:
        exec(compile(text.replace(UNITS, "UNITS = 5"), NOTEBOOK.name, "exec"), names)
    return names


def test_the_units_are_calibrated_to_the_noise_of_their_poses(run: dict[str, Any]) -> None:
    assert list(run["table"]["poses"]) == [27] * 5
    assert run["errors"]["with effects"].max() < 60
    assert run["errors"]["linear"].max() > 1000
    assert np.abs(run["off"]).max() < 150


def test_the_unit_that_is_not_linear_is_found_and_its_effect_named(run: dict[str, Any]) -> None:
    assert list(run["suspects"]) == [3]
    assert [f.effect for f in run["loops"][3].findings] == ["second_order_nonlinearity"]


def test_a_document_that_was_saved_calibrates_the_recording(run: dict[str, Any]) -> None:
    held = run["calibrated"][["ax", "ay", "az"]].to_numpy()[:200]
    assert np.linalg.norm(held.mean(axis=0)) == pytest.approx(1, abs=2e-4)


def test_the_notebook_holds_the_outputs_of_all_its_cells_in_order(cells: list[dict[str, Any]]) -> None:
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    printed = "".join("".join(o.get("text", "")) for cell in cells for o in cell["outputs"])
    assert len(re.findall(r"^unit .*second_order_nonlinearity", printed, re.MULTILINE)) == 10
    kinds = {kind for cell in cells for o in cell["outputs"] for kind in o.get("data", {})}
    assert {"image/png", "text/html"} <= kinds
