"""The page as a reader and a browser see it: parsed, not matched against a golden file."""

from __future__ import annotations

import copy
import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcald.report import StreamOverview, render_report, thin

_spec = spec_from_file_location("sample_documents", Path(__file__).with_name("sample_documents.py"))
assert _spec is not None
assert _spec.loader is not None
samples = module_from_spec(_spec)
_spec.loader.exec_module(samples)

_VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """The tags, attributes, texts and tables of a page; fails on tags that do not nest."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.rows: list[list[str]] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in _VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        self.text += data
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] = (self.rows[-1][-1] + data).strip()

    def row(self, first: str) -> list[str]:
        return next(row for row in self.rows if row[0] == first)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def verdict_text(self) -> str:
        return self.text.split("What the poses show")[0].split("Before and after")[0].split("The error")[0]

    @property
    def verdict(self) -> str:
        boxes = [attributes["class"] or "" for attributes in self.named("div") if "class" in attributes]
        return next(box for box in boxes if box.startswith("verdict ")).removeprefix("verdict ")


def render(document: dict[str, Any], **options: Any) -> Page:
    return Page(render_report(document, title="TRIAX-REF 123", **options))


@pytest.fixture(scope="module")
def loop() -> dict[str, Any]:
    document: dict[str, Any] = samples.loop_document()
    return document


@pytest.fixture
def changed(loop: dict[str, Any]) -> dict[str, Any]:
    return copy.deepcopy(loop)


@pytest.fixture(scope="module")
def bare(loop: dict[str, Any]) -> dict[str, Any]:
    document: dict[str, Any] = samples.without_pictures(loop)
    return document


@pytest.fixture(scope="module")
def stream(loop: dict[str, Any]) -> StreamOverview:
    spans = tuple((pose["start_s"], pose["end_s"]) for pose in loop["calibration"]["poses"])
    return StreamOverview(*thin(*samples.raw_stream(loop)), spans, "V")


@pytest.fixture(scope="module")
def page(loop: dict[str, Any], stream: StreamOverview) -> Page:
    return render(loop, stream=stream, certificate=samples.certificate())


@pytest.mark.slow
def test_the_verdict_is_said_in_words_with_the_error_before_and_after(page: Page) -> None:
    assert page.verdict == "within"
    assert "Within limits" in page.text
    assert "held-out: 16.2 µg rms, 131 µg before; noise floor 14.9 µg" in page.text


@pytest.mark.slow
def test_limits_are_listed_with_what_was_measured(page: Page, loop: dict[str, Any]) -> None:
    measured_ug = loop["after"]["max_abs_g"] * 1e6
    limited = [row for row in page.rows if row[0] == "Residual, largest"][-1]
    assert limited == ["Residual, largest", f"{measured_ug:.1f} µg", "100 µg", "✓ within"]


def test_a_finding_shows_coefficients_with_errors_and_units_alternatives_reason_and_remedy(page: Page) -> None:
    assert "1. Second-order nonlinearity" in page.text
    assert re.fullmatch(r"0\.\d{3}\(\d\d\) × 10⁻³ g/g²", page.row("x")[3])
    assert page.row("x")[:3] == ["x", "x", "s²"]
    assert "e = q s²" in page.text
    assert "Bias drift: the bias drifts with time" in page.text
    assert "Warm up: the bias settles after the start" in page.text
    assert "It acts with probability 0.7, or else bias drift 0.2, warm up 0.095: one of them with 0.995." in page.text
    assert re.search(r"Warm up: the bias settles after the start[^()]*\(0\.095\)", page.text)
    assert "Repeat four poses at another temperature." in page.text
    assert "the bias drifts with time (bias drift, probability 0.2) or the bias settles" in page.text
    assert "these poses cannot tell which" in page.text


def test_the_calibration_table_gives_every_coefficient_to_the_place_of_its_error(page: Page) -> None:
    assert re.fullmatch(r"−2\.410\u202f\d{3}\(\d\d\) V/g", page.row("Scale factor x (kx)")[1])
    assert re.fullmatch(r"−0\.6\d[\d\u202f]*\(\d\d\) × 10⁻³ rad", page.row("Misalignment z (αz)")[1])
    assert len([row for row in page.rows if row[0].startswith("Second-order nonlinearity, ")]) == 3


def test_every_pose_has_its_row(page: Page, loop: dict[str, Any]) -> None:
    pose = loop["calibration"]["poses"][25]
    row = page.row("26")
    assert [row[1], row[2], row[10]] == ["1006.0", "1036.0", "yes"]
    assert float(row[3].replace("−", "-")) == pytest.approx(pose["mean"][0], abs=1e-6)
    assert float(row[7].replace("−", "-")) == pytest.approx(pose["residual_g"] * 1e6, rel=0.01, abs=0.01)


def test_the_certificate_is_the_provenance(page: Page) -> None:
    assert page.row("unit: serial number")[1] == "TR-000123"
    assert page.row("recording: sha256")[1] == "9f" * 32
    assert page.row("software: triaxcal")[1] == "0.1.0"


def test_every_picture_says_what_it_shows(page: Page, loop: dict[str, Any]) -> None:
    labels = [attributes["aria-label"] or "" for attributes in page.named("svg")]
    shown = [label.partition(":")[0].partition(" for ")[0].partition(" of ")[0] for label in labels]
    assert shown == [
        "Residual", "Bars. In the poses", "Residual over the sphere", "Residual over the sphere", "Residual",
        "Residual", "Channel temp_c", "Raw output x over time with 26 still spans shaded",
        "Raw output y over time with 26 still spans shaded", "Raw output z over time with 26 still spans shaded",
    ]  # fmt: skip
    assert "residual, standard errors against time, s, 26 poses" in labels[0]
    assert f"After {loop['after']['rms_g'] * 1e6:.1f} µg" in labels[1]
    assert {"+X", "−X", "+Y", "−Y"} <= set(re.findall(r">([+−][XY])</text>", page.html))


def test_tables_have_headers_with_a_scope(page: Page) -> None:
    assert page.named("th")
    assert all(attributes.get("scope") in ("row", "col") for attributes in page.named("th"))


def test_ids_are_unique_and_every_reference_inside_the_page_has_its_target(page: Page) -> None:
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    references = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page.html)
    assert references
    assert {used for pair in references for used in pair if used} <= set(ids)


def test_the_page_needs_nothing_from_outside_and_runs_nothing(page: Page) -> None:
    assert not re.search(r"https?://|@import|url\((?!#)|javascript:", page.html)
    assert {"script", "link", "iframe", "object", "img", "image"}.isdisjoint(tag for tag, _ in page.tags)
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert "src" not in {name for _, attributes in page.tags for name in attributes}


def test_drawings_take_their_colours_from_the_page(page: Page) -> None:
    assert "#0101" not in page.html
    used = set(re.findall(r"var\((--[a-z]+)\)", page.html))
    assert used <= set(re.findall(r"(--[a-z]+):", page.html))


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes_after_other_pages_and_in_another_process(
    loop: dict[str, Any], stream: StreamOverview, page: Page
) -> None:
    program = (
        "import runpy, sys; from triaxcald.report import StreamOverview, render_report, thin;"
        "s = runpy.run_path(sys.argv[1]); loop = s['loop_document']();"
        "spans = tuple((pose['start_s'], pose['end_s']) for pose in loop['calibration']['poses']);"
        "stream = StreamOverview(*thin(*s['raw_stream'](loop)), spans, 'V'); sys.stdout.buffer.write("
        "render_report(loop, title='TRIAX-REF 123', stream=stream, certificate=s['certificate']()).encode())"
    )
    sample = str(Path(__file__).with_name("sample_documents.py"))
    written = subprocess.run([sys.executable, "-c", program, sample], capture_output=True, check=True).stdout
    assert written.decode() == render(loop, stream=stream, certificate=samples.certificate()).html == page.html


@pytest.mark.slow
def test_hostile_text_stays_text(changed: dict[str, Any]) -> None:
    hostile = '"><script>alert(1)</script><img src=x onerror=alert(1)>{{ 7*7 }}\u202e\x00'
    changed["findings"][0].update(effect=hostile, reason=hostile, verdict=hostile, alternatives=[hostile])
    changed["findings"][0]["coefficients"] = {hostile: {"value": 1.0, "standard_error": 0.1, "unit": hostile}}
    changed["advice"] = changed["data_quality"] = [hostile]
    changed["calibration"]["units"] = hostile
    overview = StreamOverview(np.arange(2.0), np.eye(2, 3), ((0.0, 1.0),), "$\\frac{" + hostile)
    html = render_report(changed, title=hostile, stream=overview, certificate={"serial": hostile, hostile: 1})
    page = Page(html)
    assert {"script", "img"}.isdisjoint(tag for tag, _ in page.tags)
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert "\u202e" not in html
    assert "\x00" not in html
    assert "{{ 7*7 }}" in page.row("serial")[1]


def test_what_is_missing_is_a_dash(changed: dict[str, Any]) -> None:
    changed["after"] = dict.fromkeys(changed["after"])
    calibration = changed["calibration"]
    calibration["standard_error"] = None
    calibration["condition"] = float("inf")
    calibration["matrix"] = [[None] * 3] * 3
    calibration["poses"] = [dict.fromkeys(pose) for pose in calibration["poses"]]
    changed["findings"][0].update(probability=None, reason=None, remedy=None)
    page = render(changed)
    assert not re.search(r"\b(None|nan|inf)\b", page.text)
    assert page.row("Scale factor x (kx)")[1].endswith("V/g ± —")
    assert page.row("3")[1:10] == ["—"] * 9


def test_an_almost_empty_document_still_makes_a_page() -> None:
    assert render({}).verdict == "refused"
    assert render({"format": "triaxcal.loop/1", "calibration": None, "after": None}).verdict == "refused"


def test_a_refusal_gives_its_reason_in_place_of_empty_results() -> None:
    page = render({"format": "triaxcal.loop/1", "refused": "7 poses, at least 9 are needed", "advice": ["Add +X up"]})
    assert page.verdict == "refused"
    assert "7 poses, at least 9 are needed" in page.text
    assert "Add +X up" in page.text
    assert "Leverage" not in page.text
    assert "Scale factor" not in page.text


def test_an_exceeded_limit_is_outside_and_named(bare: dict[str, Any]) -> None:
    page = render(bare, certificate={"limits": {"rms_g": 5e-6}})
    assert page.verdict == "outside"
    assert "Residual, rms: over the limit." in page.text


@pytest.mark.parametrize(
    ("verdict", "limits", "box", "headline"),
    [
        ("fail", {"rms_g": 1e-3}, "outside", "Failed"),
        ("fail", {}, "outside", "Failed"),
        ("pass", {}, "within", "Within limits"),
        ("not_judged", {}, "unexplained", "Not judged; effect found and corrected"),
    ],
)
def test_the_headline_is_the_stations_own_word_on_the_unit(
    bare: dict[str, Any], verdict: str, limits: dict[str, float], box: str, headline: str
) -> None:
    """Which has the unit's own output before it; the fit alone may be within its limits, or have none."""
    said = {"verdict": "within limits", "outcome": {"verdict": verdict, "reason": "the check poses say so"}}
    sure = {**bare["findings"][0], "verdict": "adopted", "alternatives": []}
    page = render({**bare, "limits": limits, "findings": [sure]}, certificate=said)
    assert (page.verdict, headline in page.verdict_text) == (box, True), page.verdict_text
    assert "The check poses say so." in page.verdict_text
    assert ("No limit was declared" in page.verdict_text) is (verdict == "not_judged")
    assert not any(row and row[0] == "verdict" for row in page.rows)


def test_a_significant_remainder_is_unexplained_even_within_the_limits(bare: dict[str, Any]) -> None:
    left = {"significant": True, "probability": 0.98, "rms_g": 4e-5, "lead": "something acts; it goes with the time"}
    page = render({**bare, "unexplained": left}, certificate=samples.certificate())
    assert page.verdict == "unexplained"
    assert "Every declared limit is kept, but something acts; it goes with the time." in page.text
    assert "Something acts; it goes with the time." in page.text


@pytest.mark.parametrize("limits", [{"held_out_rms_g": 1e-4}, {"rms_g": None}, {"no_such_quantity": 1.0}])
def test_a_limit_without_a_measurement_is_never_taken_as_kept(
    bare: dict[str, Any], limits: dict[str, float | None]
) -> None:
    page = render({**bare, "held_out": None}, certificate={"limits": limits})
    assert page.verdict == "unexplained"
    assert "Not assessed" in page.text


@pytest.mark.slow
def test_a_fit_alone_judges_by_its_lack_of_fit_and_claims_no_search(bare: dict[str, Any]) -> None:
    fit = bare["calibration"]
    assert render(fit).verdict == "within"
    assert "effects were not searched for" in render(fit).text
    poor = {**fit, "residual": {**fit["residual"], "lack_of_fit_p": 1e-5}}
    assert render(poor).verdict == "unexplained"
    untested = {**fit, "residual": {**fit["residual"], "lack_of_fit_p": None}}
    assert "Not assessed" in render(untested).text


@pytest.mark.slow
def test_directions_come_from_the_matrix_where_the_document_has_none(changed: dict[str, Any]) -> None:
    for pose in changed["calibration"]["poses"]:
        del pose["direction"], pose["before_residual_g"]
    labels = [attributes["aria-label"] or "" for attributes in render(changed).named("svg")]
    assert [label for label in labels if "over the sphere for 26 poses, after" in label]


@pytest.mark.slow
def test_a_rejected_pose_is_counted_and_named(changed: dict[str, Any]) -> None:
    changed["calibration"]["poses"][4]["used"] = False
    page = render(changed)
    assert "1 of 26 poses not used." in page.text
    assert page.row("5")[10] == "no"
    assert "pose 5, not used" in page.html


@pytest.mark.slow
def test_four_hundred_poses_stay_below_a_megabyte_and_a_half() -> None:
    document = samples.loop_document(400)
    times, readings = samples.raw_stream(document, 10.0)
    overview = StreamOverview(*thin(times, readings, points=5000), ((0.0, 9.0),) * 400, "V")
    page = render(document, stream=overview)
    assert len(page.html.encode()) < 1_500_000
    assert page.row("400")[10] == "yes"


@pytest.fixture(scope="module")
def budgeted(bare: dict[str, Any]) -> dict[str, Any]:
    document = copy.deepcopy(bare)
    nine: dict[str, Any] = {"scale_factor": [1e-5] * 3, "misalignment": [2e-6] * 3, "bias": [3e-6] * 3}
    nine["effects"] = {"second_order_nonlinearity": {"x": 4e-6, "y": 4e-6}}
    document["calibration"]["uncertainty"] = {
        "level": 0.95,
        "expanded": nine,
        "coverage_factor": nine,
        "magnitude": {"standard_g": 4.4e-5, "coverage_factor": 1.96, "expanded_g": 8.6e-5},
        "budget": [
            {"source": "reference", "evaluation": "B", "magnitude_g": 4.3e-5, "share": 0.995, "how": "a <map>"},
            {"source": "lack_of_fit", "evaluation": "A", "magnitude_g": 3e-6, "share": 0.005, "how": "residuals"},
        ],
        "dominant": "reference",
        "halved_by": "know it better",
        "magnitude_if_halved_g": 2.2e-5,
        "not_evaluated": ["thermometer: not stated"],
    }
    return document


@pytest.mark.slow
def test_the_budget_is_a_table_with_the_largest_source_first(budgeted: dict[str, Any]) -> None:
    page = render(budgeted)
    assert page.row("Reference") == ["Reference", "B", "43.0 µg", "100 %", "a <map>"]
    assert page.row("Lack of fit")[3] == "< 1 %"
    assert "Dominant: reference. To halve it: know it better; combined then 22.0 µg." in page.text
    assert "thermometer: not stated" in page.text
    assert "assumption" not in page.text
    assert page.row("Misalignment x (αx)")[2] == "± 2.0 × 10⁻⁶"
    assert page.row("Second-order nonlinearity, y")[2] == "± 4.0 × 10⁻⁶"
    assert page.row("Second-order nonlinearity, z")[2] == ""


def test_a_page_without_a_budget_has_no_section_on_it(page: Page) -> None:
    assert "Uncertainty" not in page.text


@pytest.mark.parametrize("damage", [{"budget": "none"}, {"budget": [3, None]}, {"magnitude": 7}, {"expanded": []}])
def test_a_damaged_budget_still_gives_a_page(budgeted: dict[str, Any], damage: dict[str, Any]) -> None:
    document = copy.deepcopy(budgeted)
    document["calibration"]["uncertainty"] |= damage
    assert "cause uncertain" in render(document).text


@pytest.mark.slow
def test_another_reference_has_its_own_unit_everywhere(changed: dict[str, Any]) -> None:
    changed["calibration"]["units"] = {**changed["calibration"].get("units", {}), "reference": "<uT>", "output": "V"}
    page = render(changed)
    assert "µg" not in page.html
    assert "× 10⁻⁶ <uT> rms" in page.text


@pytest.mark.parametrize("contradicts", ["uncertainty", "correction", None])
def test_what_the_check_recording_contradicts_comes_first(bare: dict[str, Any], contradicts: str | None) -> None:
    bare["held_out"]["contradicts"] = contradicts
    page = render(bare)
    headline = "The check recording contradicts the calibration; "
    assert (headline in page.verdict_text) is (contradicts is not None)


def test_three_uncertainties_stand_by_what_they_are_of(budgeted: dict[str, Any]) -> None:
    budgeted["calibration"]["expanded_uncertainty_g"] = {
        "this_fit": 8.6e-5, "this_sessions_poses": 9.71e-5, "another_day": None,
    }  # fmt: skip
    text = " ".join(render(budgeted).text.split())
    assert "This fit: the calibration by itself, at the reference conditions86.0 µg" in text
    assert "This session’s poses: one more pose of this recording, with its noise97.1 µg" in text
    assert "Another day: the next recording, with how the unit starts—" in text


@pytest.mark.slow
def test_a_limit_below_the_expanded_uncertainty_is_reserved_against(budgeted: dict[str, Any]) -> None:
    said = "The expanded uncertainty of the magnitude, 86.0 µg, is above the limit of 50.0 µg"
    assert said in render(budgeted, certificate={"limits": {"rms_g": 5e-5}}).text
    assert "is above the limit" not in render(budgeted, certificate={"limits": {"rms_g": 9e-5}}).text


def test_a_fit_that_searched_for_nothing_claims_no_more_than_no_lack_of_fit(bare: dict[str, Any]) -> None:
    fitted = {**bare["calibration"], "residual": bare["after"]}
    page = render(fitted)
    assert "No lack of fit shows" in page.text
    assert "found" not in page.verdict_text
