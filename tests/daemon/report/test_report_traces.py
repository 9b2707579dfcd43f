"""The trace picture and what a reader learns first: verdict, actions, trace, errors before and after."""

from __future__ import annotations

import copy
import re
from html import unescape
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.evidence.partial_residuals import Quantity
from triaxcald.report import render_report
from triaxcald.report.charts import read_traces

_spec = spec_from_file_location("sample_documents", Path(__file__).with_name("sample_documents.py"))
assert _spec is not None
assert _spec.loader is not None
samples = module_from_spec(_spec)
_spec.loader.exec_module(samples)


BY_Y = "Unexplained, by reading along y"


def trace(**other: Any) -> dict[str, Any]:
    x = np.linspace(-1, 1, 9)
    return {
        "effect": "second_order_nonlinearity", "axis": "y", "coefficients": ["y"], "variable": "reading_y",
        "variable_unit": "g", "quantity": "magnitude", "share": None, "pose": list(range(9)), "x": x.tolist(),
        "y": (3e-4 * x**3).tolist(), "error": [1.5e-5] * 9, "excluded": [False] * 8 + [True],
        "curve": {"x": x.tolist(), "y": (3e-4 * x**3).tolist(), "half_width": [2e-5] * 9},
    } | other  # fmt: skip


@pytest.fixture
def loop() -> dict[str, Any]:
    document: dict[str, Any] = samples.without_pictures(samples.loop_document(14))
    document["findings"] = document["findings"][:1]
    document["before"] |= {"weighted_rms": 7.31, "reduced_chi2": 98.2}
    document["after"] |= {"weighted_rms": 0.912, "reduced_chi2": 1.04}
    document["traces"] = [trace()]
    document["call"] = "usable"
    return document


def page(document: dict[str, Any]) -> tuple[str, str]:
    html = render_report(document, title="unit")
    body = re.sub(r"<style.*?</style>|<svg.*?</svg>", " ", html, flags=re.DOTALL)
    body = re.sub(r"</t[hd]>\s*<t[hd][^>]*>", " | ", body)
    return html, " ".join(unescape(re.sub(r"<[^>]+>", " ", body)).split())


def headline(html: str) -> str:
    found = re.search(r"<strong>(.*?)</strong>", html)
    assert found is not None
    return unescape(found[1])


def test_verdict_and_actions_come_first_then_the_trace_then_the_errors_before_and_after(loop: dict[str, Any]) -> None:
    html, text = page(loop)
    assert headline(html) == "Usable: effect found and corrected"
    places = [text.index(what) for what in (
        "Usable", "probability more than 0.999", "What to do", "Add two poses at 35 °C", "What the poses show",
        "Second-order nonlinearity, axis y", "Before and after", "Findings", "over the sphere", "Provenance",
    )]  # fmt: skip
    assert places == sorted(places)
    assert html.index("<svg") < html.index("Before and after")


def test_what_tells_most_stands_first_in_the_table_of_errors(loop: dict[str, Any]) -> None:
    html, text = page(loop)
    rows = re.findall(r'<tr(?: class="sum")?><th scope="row">([^<]*)</th><td class="n">([^<]*)</td><td', html)
    names = [unescape(name) for name, _ in rows]
    assert names[:4] == [
        "Held-out error, rms in 9 poses", "Cross-validated error, rms", "Residuals in standard errors, rms",
        "χ² per degree of freedom",
    ]  # fmt: skip
    assert names.index("Residual, rms") > 3
    assert "Residuals in standard errors, rms | 7.3 | 0.91" in text
    assert "χ² per degree of freedom | 98 | 1.0" in text
    assert "Error of the magnitude in the same 14 poses" in text


def test_excluded_poses_are_listed_beside_with_both_residuals_and_the_reason(loop: dict[str, Any]) -> None:
    assert "Poses excluded from both" not in page(loop)[1]
    for number, why in ((4, "outlier"), (0, "unknown_history")):
        loop["calibration"]["poses"][number] |= {
            "used": False, "excluded": why, "residual_g": 3.062e-3, "before_residual_g": 2.5e-3,
        }  # fmt: skip
    _, text = page(loop)
    assert "Error of the magnitude in the same 12 poses" in text
    assert "1, at 6.0 s | 2500 µg | 3062 µg | unknown history 5, at 166.0 s | 2500 µg | 3062 µg | outlier" in text


def test_a_trace_says_what_it_is_of_and_against_what(loop: dict[str, Any]) -> None:
    html, _ = page(loop)
    (label,) = (x for x in re.findall(r'aria-label="([^"]*)"', html) if x.startswith("Second-order"))
    assert label == (
        "Second-order nonlinearity, axis y: partial residual of |a|, µg against reading along y, g, 9 poses, 1 excluded"
    )


@pytest.mark.parametrize(
    "damage",
    [
        None, 3, "x", {}, [None], [3, {}], [trace(x=None)], [trace(y=[1.0])], [trace(quantity="weight")],
        [trace(x=["a"] * 9)], [trace(error=[None] * 9)], [trace(y=[float("nan")] * 9)],
    ],
)  # fmt: skip
def test_damaged_traces_leave_a_page_without_them(loop: dict[str, Any], damage: object) -> None:
    assert list(read_traces(damage)) == []
    loop["traces"] = damage
    assert "Before and after" in page(loop)[1]


@pytest.mark.parametrize("curve", [None, [], {"x": [1.0]}, {"x": [1.0, 2.0], "y": [None, 1.0], "half_width": [1, 1]}])
def test_a_damaged_curve_leaves_the_points(curve: object) -> None:
    (found,) = read_traces([trace(curve=curve)])
    assert len(found.x) == 9
    assert found.excluded.tolist() == [False] * 8 + [True]
    assert not len(found.grid)


def test_where_nothing_is_found_the_picture_says_that_nothing_is_left(loop: dict[str, Any]) -> None:
    x = [float(i) for i in range(9)]
    in_errors = {"quantity": Quantity.STANDARD_ERRORS.value, "y": [0.5] * 9, "error": [1.0] * 9, "curve": {}}
    of_time = trace(effect=None, axis=None, coefficients=[], variable="since_start_s", x=x)
    loop["traces"] = [of_time | in_errors]
    loop |= {"findings": [], "nothing_probability": 0.91, "before": loop["after"], "advice": ["use the calibration"]}
    loop["calibration"] |= {"terms": ["linear"], "effects": {}}
    html, text = page(loop)
    assert headline(html) == "Usable: nothing found beyond noise"
    assert "Nothing is left beyond noise (probability 0.91 that nothing acts)" in text
    assert "against time, s" in html


@pytest.mark.parametrize(
    ("p_value", "weight", "panels"),
    [(1.0, 0.31, ["Warm up, axis y"]), (1e-3, 0.31, ["Warm up, axis y", BY_Y]), (1.0, 0.01, ["Warm up, axis y", BY_Y])],
)
def test_a_panel_that_shows_nothing_is_drawn_only_where_no_other_shows_more(
    loop: dict[str, Any], p_value: float, weight: float, panels: list[str]
) -> None:
    known = {"x": {"value": 1e-4, "standard_error": 1e-4, "unit": "g"}, "weight": weight}
    loop |= {"findings": [], "traces": [trace(effect="warm_up"), trace(effect=None, share=0.17, p_value=p_value)]}
    loop["calibration"] |= {"terms": ["linear", "warm_up"], "effects": {"warm_up": known}}
    html, text = page(loop)
    assert [title for title in re.findall(r"<h3>(.*?)</h3>", html) if title in ("Warm up, axis y", BY_Y)] == panels
    assert ("No single variable tells what acts" in text) == (p_value == 1.0)


@pytest.mark.parametrize("nothing", [0.9, 0.1])
def test_above_investigate_no_headline_says_that_nothing_is_found(loop: dict[str, Any], nothing: float) -> None:
    loop |= {"findings": [], "call": "investigate", "nothing_probability": nothing, "doubts": ["unit"]}
    loop["another_unit"] = {"start_s": 100.0, "probability": 0.97}
    loop["calibration"] |= {"terms": ["linear"], "effects": {}}
    html, _ = page(loop)
    assert headline(html).startswith("Investigate: one calibration does not hold in all poses")
    assert 'class="verdict unexplained"' in html


@pytest.mark.parametrize("nothing", [0.9, 0.1])
def test_an_averaged_correction_is_no_absence_of_effects(loop: dict[str, Any], nothing: float) -> None:
    known = {"x": {"value": 1e-4, "standard_error": 1e-4, "unit": "g"}, "weight": 0.31}
    loop |= {"findings": [], "call": "record_more", "nothing_probability": nothing, "traces": [trace(effect="warm_up")]}
    loop["calibration"] |= {"terms": ["linear", "warm_up"], "effects": {"warm_up": known}}
    html, text = page(loop)
    assert headline(html).startswith("Record more: no effect certain")
    assert "No effect beyond the linear model was found" not in text
    assert text.count("warm up (0.31)") == 2
    assert "Probability 0.31; the correction contains that share of it" in text
    assert 'class="verdict unexplained"' in html


def test_an_outlier_is_nothing_that_is_left(loop: dict[str, Any]) -> None:
    loop |= {"findings": [], "call": "record_more", "nothing_probability": 0.001, "before": loop["after"]}
    loop["calibration"] |= {"terms": ["linear"], "effects": {}}
    loop["calibration"]["poses"][4] |= {"used": False, "excluded": "outlier"}
    html, text = page(loop)
    assert headline(html) == "Record more: nothing found beyond noise; poses to take again"
    assert "these poses do not tell what" not in text


def test_the_same_traces_give_the_same_bytes(loop: dict[str, Any]) -> None:
    assert page(loop)[0] == page(copy.deepcopy(loop))[0]
