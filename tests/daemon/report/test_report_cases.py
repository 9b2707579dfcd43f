"""What each kind of outcome looks like on the page: the document's values appear, and what matters stands first."""

from __future__ import annotations

import copy
import re
from html import unescape
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from triaxcald.report import render_report
from triaxcald.report.charts import sphere_pictures
from triaxcald.report.document import read_device, read_document
from triaxcald.report.over_time import time_panels

_spec = spec_from_file_location("sample_documents", Path(__file__).with_name("sample_documents.py"))
assert _spec is not None
assert _spec.loader is not None
samples = module_from_spec(_spec)
_spec.loader.exec_module(samples)
_SAMPLE = samples.loop_document(14)
HOSTILE = "<script>x</script>"


def text_of(html: str) -> str:
    """What a reader sees; rows of tables with a bar between cells."""
    body = re.sub(r"<style.*?</style>|<svg.*?</svg>", " ", html, flags=re.DOTALL)
    body = re.sub(r"</t[hd]>\s*<t[hd][^>]*>", " | ", body)
    body = unescape(re.sub(r"<[^>]+>", " ", body))
    return " ".join(body.split())


def page(document: dict[str, Any], certificate: dict[str, Any] | None = None) -> tuple[str, str]:
    html = render_report(document, title="unit", certificate=certificate)
    assert "<script" not in html
    return html, text_of(html)


def labels(html: str) -> list[str]:
    return re.findall(r'aria-label="([^"]*)"', html)


def nothing_found() -> dict[str, Any]:
    document = copy.deepcopy(_SAMPLE)
    document["findings"], document["data_quality"], document["advice"], document["held_out"] = [], [], [], None
    document["before"] = document["after"]
    document["calibration"] |= {"terms": ["linear"], "effects": {}, "warnings": [], "blind_to": []}
    return document


@pytest.fixture
def loop() -> dict[str, Any]:
    return nothing_found()


@pytest.fixture
def bare(loop: dict[str, Any]) -> dict[str, Any]:
    document: dict[str, Any] = samples.without_pictures(loop)
    return document


@pytest.fixture(scope="module")
def page_of_nothing() -> tuple[str, str]:
    return page(nothing_found())


@pytest.fixture
def words(loop: dict[str, Any]) -> dict[str, Any]:
    """The same without poses, which need pictures."""
    loop["calibration"]["poses"] = []
    return loop


def add(document: dict[str, Any], effect: str, coefficients: dict[str, Any], **more: Any) -> None:
    """A finding in the model."""
    first = not document["findings"]
    if first:
        document["before"] = {**document["after"], "rms_g": 9e-4, "cross_validated_rms_g": 1.1e-3}
    known = {
        name: dict(zip(("value", "standard_error", "unit"), held, strict=True)) for name, held in coefficients.items()
    }
    document["calibration"]["terms"].append(effect)
    document["calibration"]["effects"][effect] = known
    document["findings"].append(
        {
            "effect": effect,
            "verdict": "confounded" if more.get("alternatives") else "adopted",
            "probability": 0.9998,
            "coefficients": known,
            "alternatives": [],
            "reason": "with it the error falls",
            "remedy": "Wait.",
        }
        | more
    )


@pytest.mark.slow
def test_nothing_found_says_so_in_the_first_sentence(page_of_nothing: tuple[str, str]) -> None:
    html, text = page_of_nothing
    assert text.index("Nothing found beyond noise") < text.index("No effect beyond the linear model was found.") < 300
    assert 'class="verdict within"' in html
    assert "Poses to take again" not in text
    assert "The linear model, and the one with what is corrected" not in text


@pytest.mark.slow
def test_an_adopted_effect_has_words_formula_shape_and_what_to_change(words: dict[str, Any]) -> None:
    words["calibration"]["channel_reference"] = {"since_start_s": 0.0}
    add(words, "warm_up", {"x": (8.27e-4, 1.5e-5, "g"), "time_constant": (88.1, 2.2, "s")})
    html, text = page(words)
    assert text.index("Effect found and corrected") < text.index("the bias settles after the start") < 300
    assert "e = q exp(−t / τ)" in text
    assert "x | x | exp(−t / τ) | 0.827(15) × 10⁻³ g" in text
    assert "time_constant | | τ | 88.1(2.2) s" in text
    assert "What to change Wait." in text
    assert 'class="verdict within"' in html


@pytest.mark.slow
def test_a_step_is_marked_on_the_time_axis_and_said_to_lie_between_its_poses(loop: dict[str, Any]) -> None:
    poses = loop["calibration"]["poses"]
    at_s = 0.5 * (poses[3]["end_s"] + poses[4]["start_s"])
    add(loop, "bias_step", {"x": (7e-4, 2e-5, "g"), "at": (at_s, None, "s")})
    html, text = page(loop)
    assert (
        f"between pose 4 and pose 5, that is between {poses[3]['end_s']:.1f} s and {poses[4]['start_s']:.1f} s" in text
    )
    assert ">Bias step</text>" in html


def test_a_step_within_a_pose_is_said_to_lie_in_it(bare: dict[str, Any]) -> None:
    at_s = bare["calibration"]["poses"][6]["start_s"] + 1.0
    add(bare, "bias_step", {"x": (7e-4, 2e-5, "g"), "at": (at_s, None, "s")})
    assert "The moment lies in pose 7." in page(bare)[1]


def test_a_step_that_may_have_been_poses_away_is_said_to(bare: dict[str, Any]) -> None:
    pose = bare["calibration"]["poses"][6]
    at_s, error_s = pose["start_s"] + 1.0, 0.6 * (pose["end_s"] - pose["start_s"])
    add(bare, "bias_step", {"x": (7e-4, 2e-5, "g"), "at": (at_s, error_s, "s")})
    said = f"two standard errors reach from {at_s - 2 * error_s:.1f} s to {at_s + 2 * error_s:.1f} s."
    assert f"The moment lies most likely in pose 7; {said}" in page(bare)[1]


def test_a_step_at_the_edge_of_a_pose_may_have_been_beside_it(bare: dict[str, Any]) -> None:
    at_s = bare["calibration"]["poses"][6]["start_s"] + 0.5
    add(bare, "bias_step", {"x": (7e-4, 2e-5, "g"), "at": (at_s, 0.5, "s")})
    said = f"The moment lies most likely in pose 7; two standard errors reach from {at_s - 1:.1f} s to {at_s + 1:.1f} s"
    assert said in page(bare)[1]


@pytest.mark.slow
@pytest.mark.parametrize(("gaps", "words"), [(1 / 12**0.5, "; the poses tell it no nearer."), (0.4, "; two standard")])
def test_a_step_between_poses_lies_there_where_its_error_is_that_of_a_rectangle(
    gaps: float, words: str, loop: dict[str, Any]
) -> None:
    poses = loop["calibration"]["poses"]
    begin, end = poses[3]["end_s"], poses[4]["start_s"]
    add(loop, "bias_step", {"x": (7e-4, 2e-5, "g"), "at": ((begin + end) / 2, gaps * (end - begin), "s")})
    assert f"between pose 4 and pose 5, that is between {begin:.1f} s and {end:.1f} s{words}" in page(loop)[1]


def test_confounded_effects_are_all_told_in_words_with_their_probabilities(words: dict[str, Any]) -> None:
    others = ["bias_drift", "warm_up", "channel_bias:fan_rpm"]
    likely = {"bias_drift": 0.3, "warm_up": 0.0321}
    add(words, "temperature_bias", {"y": (-2e-5, 1e-6, "g/K")}, alternatives=others, probabilities=likely,
        probability=0.6543)  # fmt: skip
    html, text = page(words)
    assert 'class="verdict unexplained"' in html
    assert text.index("Effect found, cause uncertain") < text.index("or others – these poses cannot tell which") < 450
    for said in (
        "Bias drift: the bias drifts with time (0.3)",
        "Channel bias: fan_rpm: the bias goes with fan_rpm",
    ):
        assert said in text
    assert re.search(r"Warm up: the bias settles [^()]*\(0\.032\)", text)
    assert "Probability 0.65 " in text
    assert "it is not certain that this effect acts, and it is corrected by as much as it is probable" in text


def test_an_effect_that_probably_acts_is_told_with_its_probability_and_called_no_finding(words: dict[str, Any]) -> None:
    known = {axis: {"value": 1e-4, "standard_error": 1e-5, "unit": "g/g^2"} for axis in "xyz"}
    words["candidates"] = [{"effect": "second_order_nonlinearity", "probability": 0.81, "coefficients": known}]
    words["calibration"]["effects"] = {"second_order_nonlinearity": {**known, "weight": 0.81}}
    html, text = page(words)
    assert 'class="verdict unexplained"' in html
    assert text.index("Effect probable, not certain") < text.index("Probable: the output bends with the square") < 300
    assert "1. Second-order nonlinearity candidate" in text
    assert "Probability 0.81 " in text
    assert "No effect beyond the linear model was found" not in text
    assert "What to change" not in text
    assert "Second-order nonlinearity, x |" in text
    assert "Second-order nonlinearity, weight" not in text


def test_a_confounded_effect_within_its_limits_is_within_limits(words: dict[str, Any]) -> None:
    add(words, "temperature_bias", {"y": (-2e-5, 1e-6, "g/K")}, alternatives=["bias_drift"])
    html, _ = page(words, {"limits": {"rms_g": 1e-3}})
    assert 'class="verdict within"' in html


@pytest.mark.slow
def test_two_effects_are_corrected_at_once_in_pictures_above_the_channels_that_moved(loop: dict[str, Any]) -> None:
    add(loop, "channel_bias:supply_v", {"x": (1e-4, 1e-5, "g/[supply_v]")})
    add(loop, "hysteresis", {"x": (1e-4, 1e-5, "g/g")}, alternatives=["bias_drift"])
    html, text = page(loop)
    assert "2 effects found, cause uncertain" in text
    last = loop["after"]
    assert f"Cross-validated error, rms | 1100 µg | {1e6 * last['cross_validated_rms_g']:.3g} µg" in text
    assert f"Residual, rms | 900 µg | {1e6 * last['rms_g']:.3g} µg" in text
    assert "Before 900 µg" in next(line for line in labels(html) if "Bars" in line)
    for what in ("over the sphere", "in order of time"):
        assert [line.rpartition(" ")[2] for line in labels(html) if what in line] == ["before", "after"]
    assert "Channel temp_c" in labels(html)


def test_what_no_effect_describes_is_told_in_the_words_of_the_document(words: dict[str, Any]) -> None:
    lead = f"something acts that no known effect describes (probability 0.98), 281.0 µg rms; {HOSTILE}"
    words["unexplained"] = {"significant": True, "probability": 0.98, "kind": "time", "rms_g": 2.81e-4, "lead": lead}
    html, text = page(words)
    assert 'class="verdict unexplained"' in html
    assert f"Something acts that no known effect describes (probability 0.98), 281.0 µg rms; {HOSTILE}." in text
    assert text.count(HOSTILE) == 2
    words["unexplained"]["lead"] = None
    assert "Something acts that no known effect describes, 281 µg rms." in page(words)[1]


def test_how_large_it_is_is_told_only_where_something_probably_acts_that_no_effect_describes(
    words: dict[str, Any],
) -> None:
    words["unexplained"] = {"significant": False, "probability": 0.043, "rms_g": 2.81e-6, "lead": ""}
    _, text = page(words)
    assert "No unexplained error is visible; one exists with probability 0.043." in text
    assert "2.81" not in text


@pytest.mark.parametrize(
    ("reference", "unit", "said"),
    [
        (None, None, "1 g"),
        (1.0, "g", "1 g"),
        (1.000957342, "g", "1.000957342 g"),
        (5e-5, "T", "5 × 10⁻⁵ T"),
        (None, "µT", "reference"),
    ],
)
def test_the_formula_of_the_residual_has_the_reference_that_it_is_against(
    words: dict[str, Any], reference: float | None, unit: str | None, said: str
) -> None:
    words["calibration"]["units"] = {"output": "V", "reference": unit}
    words["calibration"]["reference"] = reference
    assert f"rᵢ = |aᵢ| − {said}," in page(words)[1]


def test_a_fault_of_another_recording_keeps_its_title(words: dict[str, Any]) -> None:
    words["data_quality"] = ["b/check.csv: saturation: x at 2.1 in 687 samples: take again"]
    _, text = page(words)
    assert "Readings at the end of the range : b/check.csv: x at 2.1 in 687 samples: take again" in text


@pytest.mark.slow
def test_poses_left_out_are_named_above_all_figures(loop: dict[str, Any]) -> None:
    loop["calibration"]["poses"][4] |= {"used": False, "residual_g": 3.062e-3}
    html, text = page(loop)
    assert "Pose 5, at 166.0 s: off by 3062 µg" in text
    assert text.index("Poses to take again") < text.index("Residual, rms")
    assert "pose 5, not used" in html


@pytest.mark.parametrize("limits", [{}, {"limits": {"rms_g": 1e-3}}])
@pytest.mark.parametrize("fault", ["saturation", "stuck_output", ""])
def test_the_headline_is_not_that_all_is_well_while_poses_have_to_be_taken_again(
    bare: dict[str, Any], limits: dict[str, Any], fault: str
) -> None:
    good = "Within limits" if limits else "Nothing found beyond noise"
    html, text = page(bare, limits)
    assert 'class="verdict within"' in html
    assert f"{good}; poses" not in text
    if fault:
        bare["data_quality"] = [f"{fault}: x at 2.1 in 687 samples, in the pose that begins at 171.6 s: take again"]
    else:
        bare["calibration"]["poses"][4]["used"] = False
    html, text = page(bare, limits)
    assert 'class="verdict unexplained"' in html
    assert f"{good}; poses to take again" in text


def test_nothing_is_well_whose_unit_is_in_doubt(bare: dict[str, Any]) -> None:
    asked = "is it the same unit?"
    assert asked not in page(bare)[1]
    bare["doubts"] = ["unit"]
    html, text = page(bare)
    assert 'class="verdict unexplained"' in html
    assert f"Nothing found beyond noise; {asked}" in text


def test_a_first_pose_of_unknown_history_is_left_out_and_not_to_be_taken_again(bare: dict[str, Any]) -> None:
    bare["calibration"]["poses"][0] |= {"used": False, "left_out": "unknown_history"}
    _, text = page(bare)
    assert "again" not in text
    bare["calibration"]["poses"][0] |= {"excluded": "caller", "left_out": "caller"}
    _, text = page(bare)
    assert "again" not in text
    bare["calibration"]["poses"][0] |= {"excluded": None, "left_out": "spoiled"}  # of 0.1
    assert "poses to take again" in page(bare)[1]


def test_an_outlier_beside_what_no_effect_describes_is_to_be_taken_again(bare: dict[str, Any]) -> None:
    bare["unexplained"] |= {"significant": True, "probability": 0.9, "lead": "something acts"}
    assert "Unexplained error left Something" in page(bare)[1]
    bare["calibration"]["poses"][4] |= {"used": False, "excluded": "outlier"}
    assert "Unexplained error left; poses to take again" in page(bare)[1]


def test_an_effect_that_is_known_and_not_corrected_is_in_question_no_more_than_its_name(bare: dict[str, Any]) -> None:
    bare["findings"] = [
        {"effect": "bias_drift", "verdict": "confounded", "probability": 0.997, "coefficients": {}, "alternatives": [],
         "reason": "it acts with probability 0.997; not adopted, because a single pose decides the result",
         "remedy": ""}
    ]  # fmt: skip
    html, text = page(bare)
    assert 'class="verdict unexplained"' in html
    assert "Effect found, cause uncertain" in text
    assert "not adopted, because a single pose decides the result." in text
    assert "Probability 0.997 Or instead none" in text
    assert "it is not certain that this effect acts" not in text
    assert "Who corrects it Nobody: it is not in the model" in text


def test_nothing_found_is_not_certain_where_the_fit_is_worse_than_noise(bare: dict[str, Any]) -> None:
    _, text = page(bare)
    assert "Nothing found beyond noise" in text
    for block in (bare["after"], bare["calibration"]["residual"]):
        block["lack_of_fit_p"] = 0.003
    html, text = page(bare)
    assert 'class="verdict unexplained"' in html
    assert "Nothing certain found beyond noise" in text


def test_faults_that_spoil_poses_come_first_and_the_rest_stay_remarks(words: dict[str, Any]) -> None:
    words["data_quality"] = [
        "mains_pickup: 50.0 Hz, amplitude y 0.0014",
        "saturation: x at 2.1 in 687 samples, in the pose that begins at 171.6 s: take again",
        f"odd_fault: {HOSTILE}",
    ]
    _, text = page(words)
    top, rest = text.split("Residual, rms", 1)
    assert "Poses with faults are excluded, and have to be taken again" in top
    assert "Readings at the end of the range : x at 2.1 in 687 samples" in top
    assert "50.0 Hz" not in top
    assert rest.index("✗ take again") < rest.index("Mains hum | 50.0 Hz, amplitude y 0.0014 | no pose to take again")
    assert f"odd_fault: {HOSTILE}" in rest


@pytest.mark.slow
def test_another_reference_writes_its_errors_in_its_own_unit(loop: dict[str, Any]) -> None:
    loop["calibration"]["units"] |= {"reference": "µT", "bias": "µT"}
    add(loop, "bias_drift", {"x": (3e-5, 1e-6, "µT/s")}, reason="falls from 1.53e+04 1e-6 µT to 12 1e-6 µT")
    html, text = page(loop)
    assert "µg" not in html
    assert "Falls from 15300 × 10⁻⁶ µT to 12 × 10⁻⁶ µT." in text
    assert "residual, 10⁻⁶ µT" in html


@pytest.fixture
def registers() -> dict[str, Any]:
    return {
        "registers": {
            "terms": ["linear", "temperature_bias"],
            "left_to_host": ["hysteresis", "third_order_nonlinearity"],
            "rms_g": 4.4e-5,
            "rounding_rms_g": 2.2e-8,
            "words": [
                {"register": "bias_x", "role": "bias.x", "raw": "85471ac0", "wanted": 0.0056, "held": 0.00561},
            ],
        },
        "verification": {
            "before_rms_g": 1.3e-3, "after_rms_g": 6.5e-6, "after_max_abs_g": 1.4e-5, "noise_floor_g": 7e-6,
            "limit_rms_g": None, "verdict": "within limits",
        },
        "device": "the device holds the new calibration, verified",
        "result": {"before": {"rms_g": 0.123456}},
    }  # fmt: skip


def test_a_certificate_tells_what_the_device_holds_and_what_each_choice_leaves(
    words: dict[str, Any], registers: dict[str, Any]
) -> None:
    add(words, "temperature_bias", {"x": (1e-4, 1e-5, "g/K")})
    add(words, "third_order_nonlinearity", {"x": (1e-4, 1e-5, "g/g³")})
    _, text = page(words, registers)
    assert "The device holds the new calibration, verified." in text
    assert "With the old registers, rms | 1300 µg With the new registers, rms | 6.50 µg" in text
    assert "power cycle" not in text
    assert "Registers: linear model alone | 900 µg | 1100 µg" in text
    assert "Registers: linear model, temperature bias | 44.0 µg" in text
    last = f"{words['after']['rms_g'] * 1e6:.3g}"
    assert f"temperature bias; host: third-order nonlinearity | {last}" in text
    assert "no registers for third-order nonlinearity: the host has to correct it" in text
    assert "no register could hold: hysteresis" in text
    assert "Who corrects it The host: the device has no registers" in text
    assert "bias_x | bias.x | 0.0056 | 0.00561 | | 85471ac0" in text
    assert "0.123456" not in text
    assert text.index("The device holds") < text.index("Before and after")


def test_choices_that_a_document_states_are_told_as_they_are(words: dict[str, Any], registers: dict[str, Any]) -> None:
    add(words, "temperature_bias", {"x": (1e-4, 1e-5, "g/K")})
    add(words, "third_order_nonlinearity", {"x": (1e-4, 1e-5, "g/g³")})
    add(words, "warm_up", {"x": (1e-4, 1e-5, "g")})
    in_registers = ["linear", "temperature_bias"]
    words["choices"] = [
        {"corrected_by": ["registers"], "terms": ["linear"], "rms_g": 9e-4},
        {"corrected_by": ["registers", "process"], "terms": in_registers, "rms_g": 7e-5, "cross_validated_rms_g": 8e-5},
        {"corrected_by": ["registers", "host", "process"], "terms": [*in_registers, "third_order_nonlinearity"]},
    ]
    _, text = page(words, registers)
    assert "Registers: linear model alone | 900 µg | —" in text
    assert "Registers: linear model, temperature bias; process: avoid warm up | 70.0 µg | 80.0 µg" in text
    assert "temperature bias; host: third-order nonlinearity; process: avoid warm up | — | —" in text


def test_without_a_device_the_choice_is_to_correct_the_effects_or_not(words: dict[str, Any]) -> None:
    add(words, "third_order_nonlinearity", {"x": (1e-4, 1e-5, "g/g³")})
    add(words, "warm_up", {"x": (1e-4, 1e-5, "g")})
    _, text = page(words)
    assert "Host or registers: linear model alone | 900 µg | 1100 µg" in text
    assert "linear model, third-order nonlinearity; process: avoid warm up |" in text
    assert "Who corrects it The host, or the device where it has registers for it" in text
    assert "Who corrects it Nobody: it depends on how these poses were taken" in text


def test_where_nothing_was_found_there_is_nothing_to_choose(words: dict[str, Any]) -> None:
    assert "Who corrects what" not in page(words)[1]


@pytest.mark.parametrize("damage", [[None], [3, {}], [{"corrected_by": 7, "terms": [None], "rms_g": "x"}], {}])
def test_damaged_choices_break_nothing(words: dict[str, Any], damage: object) -> None:
    add(words, "warm_up", {"x": (1e-4, 1e-5, "g")})
    words["choices"] = damage
    assert "Warm up" in page(words)[1]


def test_a_device_without_registers_says_why(words: dict[str, Any]) -> None:
    _, text = page(words, {"registers": None, "not_written": f"no register for {HOSTILE}"})
    assert f"Nothing was written: no register for {HOSTILE}." in text
    assert "Wanted" not in text


@pytest.mark.parametrize("damage", [3, "x", [], {"words": 7, "terms": None}, {"words": [None, 4]}])
def test_damaged_registers_tell_nothing_and_break_nothing(damage: object) -> None:
    device = read_device({"registers": damage, "verification": damage})
    assert device is None or not any(word.raw for word in device.words)


@pytest.mark.parametrize("damage", ["x", "\ud800", "1e400", [1.0], {}, True, float("nan"), 10**400])
def test_a_damaged_figure_of_a_register_or_a_residual_counts_as_missing(words: dict[str, Any], damage: Any) -> None:
    device = read_device({"registers": {"words": [{"register": damage, "wanted": damage, "held": 1.5}]}})
    assert device is not None
    assert [(word.wanted, word.held) for word in device.words] == [(None, 1.5)]
    words["after"] |= {"rms_g": damage}
    assert read_document(words).final.rms_g is None
    assert read_document(words).final.max_abs_g is not None


@pytest.mark.parametrize("damage", [3, "x", {"temp_c": None}, {"temp_c": "warm"}])
def test_a_channel_that_a_pose_lacks_is_not_drawn(loop: dict[str, Any], damage: object) -> None:
    loop["calibration"]["poses"][2]["channels"] = damage
    outcome = read_document(loop)
    drawings = time_panels(outcome.poses, outcome.stages, None)
    assert drawings
    assert not any("temp_c" in drawing for drawing in drawings)


@pytest.mark.slow
def test_a_small_set_of_poses_carries_its_numbers_and_a_large_one_does_not() -> None:
    for count, numbered in ((14, True), (60, False)):
        outcome = read_document(samples.loop_document(count))
        drawing = sphere_pictures(outcome.poses, outcome.stages, 1.5e-5)[-1]
        assert (">13</text>" in drawing) is numbered


@pytest.mark.slow
def test_a_pose_taken_twice_has_one_label_with_both_numbers() -> None:
    document = copy.deepcopy(_SAMPLE)
    poses = document["calibration"]["poses"]
    poses[9]["direction"] = poses[2]["direction"]
    outcome = read_document(document)
    drawing = sphere_pictures(outcome.poses, outcome.stages, 1.5e-5)[-1]
    assert ">3, 10</text>" in drawing
    assert ">3</text>" not in drawing


def test_notes_that_would_lie_on_each_other_are_left_out() -> None:
    document = samples.loop_document(60)
    for pose in document["calibration"]["poses"]:
        pose |= {"residual_g": 1e-5, "studentized": 0.5}
    for number, residual_g in ((20, 9e-5), (21, 9.1e-5), (40, -9e-5)):
        document["calibration"]["poses"][number - 1] |= {"residual_g": residual_g, "studentized": residual_g * 1e5}
    outcome = read_document(document)
    drawings = time_panels(outcome.poses, outcome.stages, None)
    assert drawings
    assert ">pose 21</text>" in drawings[1]
    assert ">pose 40</text>" in drawings[1]
    assert ">pose 20</text>" not in drawings[1]


@pytest.mark.slow
def test_no_table_hides_its_rows_in_a_box(page_of_nothing: tuple[str, str]) -> None:
    html, _ = page_of_nothing
    assert "max-height" not in html
    assert "overflow: hidden" not in html
