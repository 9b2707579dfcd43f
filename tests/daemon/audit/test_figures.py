"""Which figures an audit takes for the same, and that it finds any other: leaf by leaf of the documents of a golden
recording."""

from __future__ import annotations

import json
import math
import re
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from triaxcal.rounding import Printed
from triaxcald.audit.differences import differing
from triaxcald.audit.drawings import same_report
from triaxcald.audit.figures import Agreement, Figures, same_figure
from triaxcald.audit.results import Again, as_stored, compute, digests
from triaxcald.recording.reader import Recording
from triaxcald.station.config import Limits

GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
CERTIFICATE, VERIFICATION = "certificate.json", "verification.json"


def stored_documents() -> dict[str, Any]:
    with Recording.open(GOLDEN) as recording:
        return {name: json.loads(recording.attachments[name]) for name in (CERTIFICATE, VERIFICATION)}


def leaves(node: Any, at: str = "") -> dict[str, Any]:
    """Of a JSON document, by place."""
    if isinstance(node, dict):
        return {k: v for key, inner in node.items() for k, v in leaves(inner, f"{at}.{key}" if at else key).items()}
    if isinstance(node, list):
        return {k: v for i, inner in enumerate(node) for k, v in leaves(inner, f"{at}[{i}]").items()}
    return {at: node}


def put(document: Any, place: str, value: Any) -> None:
    keys = [int(k) if k.isdigit() else k for k in re.findall(r"[^.\[\]]+", place)]
    for key in keys[:-1]:
        document = document[key]
    document[keys[-1]] = value


def of(document: Any, place: str) -> Any:
    return leaves(document)[place]


STORED = stored_documents()
NOT_COMPUTED = re.compile(r"limits\.|settings\.|reference$|limit_rms_g|\.level$|words\[\d+\]\.held")
"""Given, or following from the raw word beside it."""
KINDS: dict[tuple[str, str], list[str]] = {}
for name, document in STORED.items():
    for place, value in leaves(document).items():
        if type(value) is float and not NOT_COMPUTED.search(place):
            KINDS.setdefault((name, re.sub(r"\[\d+\]", "[]", place)), []).append(place)


@pytest.fixture(scope="module")
def again() -> Again:
    with Recording.open(GOLDEN) as recording:
        return compute(recording, digests(recording))


@pytest.fixture(scope="module")
def figures(again: Again) -> dict[str, Figures]:
    assert again.certified is not None
    assert again.verification is not None
    return {CERTIFICATE: Figures(again.certified.document), VERIFICATION: Figures(again.verification)}


def found(figures: Figures, stored: Any) -> set[str]:
    """The places that differ, as an audit finds them."""
    taken = figures.taken("x", stored, Agreement())
    return {d.place for d in differing("x", stored, json.loads(json.dumps(taken)))}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind[0].split('.')[0]} {kind[1]}")
def test_a_figure_off_by_a_hundredth_of_its_uncertainty_is_found(
    figures: dict[str, Figures], kind: tuple[str, str]
) -> None:
    """By two printed steps where it has none: one may be a rounding to the other side."""
    name, _ = kind
    computed = leaves(figures[name].document)
    for sign in (-1, 1):
        stored = deepcopy(STORED[name])
        for place in KINDS[kind]:
            figure = computed[place]
            assert isinstance(figure, Printed)
            uncertainty = figures[name].uncertainties.get(place) or figure.known_to
            off = max(0.01 * uncertainty, 2 * figure.step) if uncertainty else max(2 * figure.step, 1e-8 * abs(figure))
            put(stored, place, float(figure) + sign * off)
        assert found(figures[name], stored) == set(KINDS[kind])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: f"{kind[0].split('.')[0]} {kind[1]}")
def test_a_figure_off_by_a_hundred_thousandth_of_its_uncertainty_is_the_same(
    figures: dict[str, Figures], kind: tuple[str, str]
) -> None:
    name, _ = kind
    computed = leaves(figures[name].document)
    for sign in (-1, 1):
        stored = deepcopy(STORED[name])
        for place in KINDS[kind]:
            figure = computed[place]
            uncertainty = figures[name].uncertainties.get(place) or figure.known_to
            off = 1e-5 * uncertainty if uncertainty else 1e-10 * abs(figure)
            put(stored, place, float(figure) + sign * off)
        assert found(figures[name], stored) == set()


STATED = {
    "result.calibration.bias[0]": "result.calibration.standard_error.bias[0]",
    "result.calibration.scale_factor[2]": "result.calibration.standard_error.scale_factor[2]",
    "result.calibration.misalignment[1]": "result.calibration.standard_error.misalignment[1]",
    "result.calibration.effects.second_order_nonlinearity.x.value": (
        "result.calibration.effects.second_order_nonlinearity.x.standard_error"
    ),
    "result.candidates[0].coefficients.x.value": "result.candidates[0].coefficients.x.standard_error",
    "result.calibration.poses[3].residual_g": "result.calibration.poses[3].standard_error_g",
}


@pytest.mark.slow
@pytest.mark.parametrize("place", STATED)
def test_the_uncertainty_is_the_one_that_the_document_states(figures: dict[str, Figures], place: str) -> None:
    uncertainty = of(STORED[CERTIFICATE], STATED[place])
    for share, differs in ((1e-5, False), (0.9e-3, False), (0.01, True)):
        stored = deepcopy(STORED[CERTIFICATE])
        put(stored, place, of(stored, place) + share * uncertainty)
        assert (place in found(figures[CERTIFICATE], stored)) is differs, share


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("verdict", "outside limits"),
        ("unit.serial", "4712"),
        ("result.call", "investigate"),
        ("result.candidates[0].effect", "compression"),
        ("result.calibration.poses[3].used", False),
        ("result.calibration.terms[1]", "compression"),
        ("recording.poses", 7),
        ("recording.samples", 7.0),
        ("recording.raw_sha256", "0" * 64),
        ("registers.words[0].register", "scale_factor_y"),
        ("registers.words[0].raw", "90471ac1"),
        ("result.calibration.bias[0]", None),
        ("result.calibration.bias[0]", "0.1"),
        ("result.calibration.bias[0]", math.nan),
        ("result.calibration.bias[0]", math.inf),
        ("result.calibration.bias[0]", True),
        ("result.calibration.bias[0]", 0),
    ],
)
def test_what_is_no_figure_is_compared_exactly(figures: dict[str, Figures], place: str, value: Any) -> None:
    stored = deepcopy(STORED[CERTIFICATE])
    put(stored, place, value)
    assert place in found(figures[CERTIFICATE], stored)


@pytest.mark.slow
def test_a_key_or_an_entry_more_or_less_is_found(figures: dict[str, Figures]) -> None:
    more, fewer = deepcopy(STORED[CERTIFICATE]), deepcopy(STORED[CERTIFICATE])
    more["result"]["after"]["x"] = 1.0
    more["result"]["calibration"]["bias"].append(0.0)
    del fewer["result"]["after"]["rms_g"]
    del fewer["result"]["calibration"]["poses"][-1]
    assert found(figures[CERTIFICATE], more) == {"result.after.x", "result.calibration.bias"}
    assert found(figures[CERTIFICATE], fewer) == {"result.after.rms_g", "result.calibration.poses"}


@pytest.mark.parametrize(
    ("stored", "exact", "same"),
    [
        (1.235, 1.2345, True),  # on the edge
        (1.234, 1.2345 + 4e-4, True),  # by less than half a digit beyond
        (1.234, 1.2345 + 6e-4, False),
        (1.235, 1.2339, False),
        (1.2346, 1.2345, False),  # nobody prints that
        (1.234, 1.2336, True),
        (1.236, 1.2349, False),
    ],
)
def test_a_figure_on_the_edge_of_its_rounding_may_stand_as_either(stored: float, exact: float, same: bool) -> None:
    figure = Printed(float(f"{exact:.4g}"), exact, 1e-3)
    assert same_figure(stored, figure, None) is same


@pytest.mark.parametrize(
    ("stored", "again", "same"),
    [
        ("rms 12.4 µg of 26 poses", "rms 12.3 µg of 26 poses", True),
        ("rms 12.2 µg of 26 poses", "rms 12.3 µg of 26 poses", False),
        ("rms 12.3 µg of 27 poses", "rms 12.3 µg of 26 poses", False),
        ("rms 12.3 ng of 26 poses", "rms 12.3 µg of 26 poses", False),
        ("rms 12.3 µg of 26 poses or so", "rms 12.3 µg of 26 poses", False),
        ("rms 12.3 µg of 26 poses", "rms 12.3 µg of 26 poses", True),
        ("rms 1e999 µg of 26 poses", "rms 12.3 µg of 26 poses", False),
        (f"rms 1e{'9' * 5000} µg of 26 poses", "rms 12.3 µg of 26 poses", False),
    ],
)
def test_a_sentence_may_have_the_other_rounding_of_a_figure_and_no_other_word(
    stored: str, again: str, same: bool
) -> None:
    figures = Figures({"rms_g": Printed(1.235e-5, 1.23500001e-5, 1e-11), "p": Printed(0.26, 0.26, 0.01)})
    assert figures.same_words(stored, again) is same


@pytest.mark.parametrize("limit_g", [1.234e-5, 1.235e-5])
@pytest.mark.slow
def test_a_verdict_follows_from_the_stored_figure_as_it_is_printed(again: Again, limit_g: float) -> None:
    """A figure on the edge of its rounding, and a limit that is one of the two."""
    assert again.certified is not None
    document = deepcopy(again.certified.document)
    document["result"]["after"]["rms_g"] = Printed(1.235e-5, 1.2345001e-5, 1e-8)
    station = again.station.model_copy(update={"limits": Limits(rms_g=limit_g)})
    other = replace(again, certified=replace(again.certified, document=document), station=station)
    for printed in (1.234e-5, 1.235e-5):
        stored = deepcopy(STORED[CERTIFICATE])
        stored["result"]["after"]["rms_g"] = printed
        taken, agreement = as_stored(other, {CERTIFICATE: stored, VERIFICATION: STORED[VERIFICATION]})
        assert taken.certified is not None
        assert taken.certified.document["result"]["after"]["rms_g"] == printed
        assert taken.certified.within_limits is (printed <= limit_g)
        assert taken.certified.document["verdict"] == ("within limits" if printed <= limit_g else "outside limits")
        assert agreement.figures == (printed != 1.235e-5)


@pytest.mark.slow
def test_a_register_word_follows_from_the_stored_coefficient(again: Again) -> None:
    """One that is nearly in the middle of two float32 is rounded to either."""
    certified, profile = again.certified, again.bundle.profile
    assert certified is not None
    word = next(w for w in certified.document["registers"]["words"] if w["role"] == "scale_factor.x")
    held = profile.decode(word["register"], bytes.fromhex(word["raw"]))
    ulp = 2.0 ** (math.floor(math.log2(abs(held))) - 23)
    middle = held + 0.5 * ulp
    near, far = (float(f"{v:.10g}") for v in (middle - 3e-9, middle + 3e-9))
    raws = [profile.encode(word["register"], v).hex() for v in (near, far)]
    assert raws[0] != raws[1]
    document = deepcopy(certified.document)
    place = document["registers"]["words"].index(word)
    document["registers"]["words"][place]["wanted"] = Printed(near, near, 1e-9)
    other = replace(again, certified=replace(certified, document=document))
    stored = deepcopy(STORED[CERTIFICATE])
    stored["registers"]["words"][place]["wanted"] = far
    taken, _ = as_stored(other, {CERTIFICATE: stored})
    assert taken.certified is not None
    assert taken.certified.image is not None
    assert taken.certified.document["registers"]["words"][place]["raw"] == raws[1]
    assert taken.certified.image.raw[word["register"]].hex() == raws[1]


PAGE = (
    '<p>rms 12.3 µg</p><svg role="img" aria-label="rms 12.3 µg" viewBox="0 0 10 20"><title>rms 12.3 µg</title>'
    '<path id="bars-m0123456789" d="M 1.234567 -2.5 L 3 4" style="stroke: var(--ink)"/>'
    '<use href="#bars-m0123456789" x="1.000001" y="7"/><text x="1" y="2">12.3</text></svg><p>and 4 more</p>'
)


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("1.234567", "1.234568", True),
        ("-2.5", "-2.5000001", True),
        ("0123456789", "fedcba9876", True),
        ('id="bars-m0123456789"', 'id="bars-mfedcba9876"', False),
        ("1.234567", "1.244567", False),
        ("-2.5", "2.5", False),
        ("L 3 4", "L 3 4 5", False),
        ("12.3 µg</p>", "12.4 µg</p>", False),
        ("12.3 µg</title>", "12.4 µg</title>", False),
        ('label="rms 12.3', 'label="rms 12.4', False),
        (">12.3<", ">12.30001<", False),
        ("--ink", "--grid", False),
        ("and 4 more", "and 5 more", False),
        ("µg</p>", "ng</p>", False),
        ("<path", "<line", False),
    ],
)
def test_a_report_may_place_a_line_by_a_last_digit_and_say_nothing_else(old: str, new: str, same: bool) -> None:
    assert old in PAGE
    assert same_report(PAGE.replace(old, new).encode(), PAGE, {}, Agreement()) is same


@pytest.mark.parametrize("page", [b"", b"\xff", b"<html>all is well</html>", PAGE.encode() + b" "])
def test_another_page_is_no_report(page: bytes) -> None:
    assert not same_report(page, PAGE, {}, Agreement())
