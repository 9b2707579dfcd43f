"""Recordings of other software, whose figures may be off by a share of their uncertainty."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.daemon.audit.forging import OUTCOME, Forgery
from tests.daemon.audit.other_software import CERTIFICATE, GOLDEN, Edit, made_with
from triaxcald.audit import Audit, audit, text
from triaxcald.audit.conduct import Result
from triaxcald.audit.differences import differing
from triaxcald.audit.figures import Agreement, Figures
from triaxcald.audit.results import Again, as_stored, compute, digests
from triaxcald.audit.within import moved, same_within
from triaxcald.provision.registers import checksum_of
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.verification import verdict_by_limit

VERIFICATION = "verification.json"
BIAS = "result.calibration.bias[0]"
LIMIT = 0.01
OLDER = {"triaxcal": "0.1.9"}
OLDER_NUMPY = {"numpy": "1.26.0"}


def bias_moved(share: float) -> dict[str, Edit]:
    """By a share of its standard error, in the certificate and in the outcome, which copies it."""
    error: float = json.loads(Forgery.of(GOLDEN).attachment(CERTIFICATE).data)["result"]["calibration"][
        "standard_error"
    ]["bias"][0]

    def change(calibration: dict[str, Any]) -> None:
        calibration["bias"][0] += share * error

    return {
        CERTIFICATE: lambda c: change(c["result"]["calibration"]),
        OUTCOME: lambda o: change(o["measured"]["calibration"]),
    }


@pytest.fixture
def audited(auditor: Any, tmp_path: Path) -> Callable[..., Audit]:
    def run(software: Mapping[str, str], edits: Any = None, within: float | None = LIMIT) -> Audit:
        path = made_with(tmp_path / "x.mcap", software, edits)
        return audit(path, compute=auditor.compute, within=within)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("software", [OLDER, OLDER_NUMPY], ids=["triaxcal", "numpy"])
def test_a_figure_within_the_limit_agrees_and_is_stated(audited: Any, software: dict[str, str]) -> None:
    found = audited(software, bias_moved(0.005))
    assert found.differences == ()
    assert found.result is Result.WITHIN
    assert found.within.by == software
    assert (found.within.largest.part, found.within.largest.place) == (CERTIFICATE, BIAS)
    assert found.within.largest.of_uncertainty == pytest.approx(0.005, rel=1e-3)
    assert BIAS in text.heading(found)
    document = text.document("x.mcap", found)
    assert document["result"] == "within"
    assert document["within"]["limit"] == LIMIT
    assert document["within"]["largest"]["place"] == BIAS
    assert [figure["place"] for figure in document["within"]["figures"]] == [BIAS]


@pytest.mark.slow
@pytest.mark.parametrize("software", [OLDER, OLDER_NUMPY], ids=["triaxcal", "numpy"])
def test_a_figure_beyond_the_limit_differs_by_a_stated_share(audited: Any, software: dict[str, str]) -> None:
    found = audited(software, bias_moved(0.02))
    assert found.result is Result.DIFFERS
    places = [(OUTCOME, "measured.calibration.bias[0]"), (CERTIFICATE, BIAS)]
    assert [(d.part, d.place) for d in found.differences if not d.place.startswith("sha256")] == places
    assert found.differences[-1].of_uncertainty == pytest.approx(0.02, rel=1e-3)
    assert found.within.largest.of_uncertainty == pytest.approx(0.02, rel=1e-3)


@pytest.mark.slow
def test_without_the_option_the_same_figure_differs(audited: Any) -> None:
    found = audited(OLDER, bias_moved(0.005), within=None)
    assert found.result is Result.DIFFERS
    assert found.within is None


@pytest.mark.slow
def test_the_option_is_not_for_recordings_of_the_same_software(audited: Any) -> None:
    found = audited({}, bias_moved(0.005))
    assert found.result is Result.DIFFERS
    assert found.within is None
    assert text.document("x.mcap", found)["within"] is None


@pytest.mark.slow
def test_without_a_moved_figure_everything_is_the_same(audited: Any) -> None:
    found = audited(OLDER)
    assert found.result is Result.SAME_BYTES
    assert found.within.moved == ()
    assert found.within.largest is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edits", "place"),
    [
        (
            {CERTIFICATE: lambda c: c.update(verdict="outside limits"), OUTCOME: lambda o: o.update(verdict="fail")},
            "verdict",
        ),
        ({CERTIFICATE: lambda c: c["result"].update(call="investigate")}, "result.call"),
        ({CERTIFICATE: lambda c: c["registers"]["words"][0].update(raw="00000000")}, "registers.words[0].raw"),
        ({CERTIFICATE: lambda c: c["recording"].update(seconds=90.24)}, "recording.seconds"),
    ],
    ids=["verdict", "call", "register", "without uncertainty"],
)
def test_what_is_no_figure_with_an_uncertainty_differs(audited: Any, edits: dict[str, Edit], place: str) -> None:
    found = audited(OLDER, edits)
    assert found.result is Result.DIFFERS
    assert (CERTIFICATE, place) in [(d.part, d.place) for d in found.differences]


# Of the documents alone.


@pytest.fixture(scope="module")
def again() -> Again:
    with Recording.open(GOLDEN) as recording:
        return compute(recording, digests(recording))


@pytest.fixture(scope="module")
def stored() -> dict[str, Any]:
    with Recording.open(GOLDEN) as recording:
        return {name: json.loads(recording.attachments[name]) for name in (CERTIFICATE, VERIFICATION, OUTCOME)}


def places_off(again: Again, stored: Mapping[str, Any], limit: float = LIMIT) -> set[str]:
    """Where certificate and verification differ, as an audit finds it."""
    taken = same_within(as_stored(again, stored)[0], stored, limit, Agreement())
    assert taken.certified is not None
    documents = {CERTIFICATE: taken.certified.document, VERIFICATION: taken.verification}
    return {d.place for name, document in documents.items() for d in differing(name, stored[name], _plain(document))}


def _plain(document: Any) -> Any:
    return json.loads(json.dumps(document))


def _word_moved(again: Again, stored: Mapping[str, Any], role: str, share: float) -> tuple[dict[str, Any], int]:
    """A certificate whose register word is of a figure that is off, and whose checksum and figure held follow."""
    held = deepcopy(dict(stored))
    registers = held[CERTIFICATE]["registers"]
    at = next(i for i, w in enumerate(registers["words"]) if w["role"] == role)
    word, profile = registers["words"][at], again.bundle.profile
    uncertainty = Figures(registers).uncertainties[f"words[{at}].wanted"]
    word["raw"] = profile.encode(word["register"], word["wanted"] + share * uncertainty).hex()
    word["held"] = float(f"{profile.decode(word['register'], bytes.fromhex(word['raw'])):.10g}")
    assert profile.crc is not None
    checksum = next(w for w in registers["words"] if w["register"] == profile.crc.register_name)
    value = checksum_of(profile, {w["register"]: bytes.fromhex(w["raw"]) for w in registers["words"]})
    checksum.update(wanted=float(value), held=float(value), raw=profile.encode(checksum["register"], value).hex())
    return held, at


@pytest.mark.slow
def test_a_register_word_may_encode_a_figure_within_the_limit(again: Again, stored: dict[str, Any]) -> None:
    for role in ("bias.x", "misalignment.y", "second_order_nonlinearity.z"):
        held, at = _word_moved(again, stored, role, 0.005)
        words, before = (of[CERTIFICATE]["registers"]["words"] for of in (held, stored))
        assert words[at]["raw"] != before[at]["raw"]
        assert places_off(again, held) == set()


@pytest.mark.slow
def test_a_register_word_beyond_the_limit_differs(again: Again, stored: dict[str, Any]) -> None:
    held, at = _word_moved(again, stored, "bias.x", 0.02)
    assert f"registers.words[{at}].raw" in places_off(again, held)
    assert places_off(again, held, 0.05) == set()


@pytest.mark.slow
def test_a_checksum_that_does_not_follow_its_words_differs(again: Again, stored: dict[str, Any]) -> None:
    held, _ = _word_moved(again, stored, "bias.x", 0.005)
    words = held[CERTIFICATE]["registers"]["words"]
    of_old = next(w for w in stored[CERTIFICATE]["registers"]["words"] if w["role"] == "calibration_crc")
    at = next(i for i, w in enumerate(words) if w["role"] == "calibration_crc")
    words[at] = of_old
    assert places_off(again, held) == {f"registers.words[{at}].{key}" for key in ("raw", "wanted", "held")}


@pytest.mark.slow
def test_a_verdict_on_a_figure_within_the_limit_is_that_of_the_new_figure(again: Again, stored: dict[str, Any]) -> None:
    """The limit lies between what is stored and what is computed."""
    assert again.verification is not None
    figure, uncertainty = again.verification["after_rms_g"], again.verification["expanded_uncertainty_g"] / 2
    below = float(figure) - 0.005 * uncertainty
    limit_g = (below + figure) / 2
    document = {**again.verification, "limit_rms_g": limit_g, "verdict": verdict_by_limit(figure, limit_g)}
    held = deepcopy(stored)
    held[VERIFICATION] |= {"after_rms_g": below, "limit_rms_g": limit_g, "verdict": verdict_by_limit(below, limit_g)}
    assert held[VERIFICATION]["verdict"] != document["verdict"]
    assert places_off(replace(again, verification=document), held) == {"verdict"}


@pytest.mark.slow
def test_each_moved_figure_is_found_in_its_own_uncertainty(again: Again, stored: dict[str, Any]) -> None:
    """The uncertainty is the one that stands in the document."""
    held = deepcopy(stored)
    calibration = held[CERTIFICATE]["result"]["calibration"]
    calibration["scale_factor"][2] += 0.3 * calibration["standard_error"]["scale_factor"][2]
    calibration["poses"][3]["residual_g"] -= 2 * calibration["poses"][3]["standard_error_g"]
    held[CERTIFICATE]["recording"]["seconds"] += 1.0
    held[VERIFICATION]["poses"][1]["error_g"] += 0.1 * held[VERIFICATION]["poses"][1]["standard_error_g"]
    found = {(m.part, m.place): m.of_uncertainty for m in moved(again, held)}
    assert found == {
        (CERTIFICATE, "recording.seconds"): None,
        (CERTIFICATE, "result.calibration.scale_factor[2]"): pytest.approx(0.3, rel=1e-3),
        (CERTIFICATE, "result.calibration.poses[3].residual_g"): pytest.approx(2.0, rel=1e-3),
        (VERIFICATION, "poses[1].error_g"): pytest.approx(0.1, rel=1e-3),
    }


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("name", ["can-second-order.mcap", "modbus-temperature-bias.mcap"])
def test_poses_that_move_by_a_thousandth_of_their_error_move_no_figure_by_a_tenth(
    name: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with an arithmetic that rounds otherwise, and much more: only the means themselves have no uncertainty, and
    the choice of poses that may be outliers is a choice."""
    random, parted = np.random.default_rng(seed), Pipeline.parted

    def moved_poses(self: Pipeline, turn_s: float | None) -> list[Any]:
        return [
            replace(p, mean=p.mean + 1e-3 * np.linalg.cholesky(p.covariance) @ random.standard_normal(3))
            for p in parted(self, turn_s)
        ]

    monkeypatch.setattr(Pipeline, "parted", moved_poses)
    with Recording.open(GOLDEN.with_name(name)) as recording:
        again = compute(recording, digests(recording))
        held = {n: json.loads(recording.attachments[n]) for n in (CERTIFICATE, VERIFICATION, OUTCOME)}
    off = {re.sub(r"\[\d+\]", "[]", place).rpartition("poses[].")[2] for place in places_off(again, held, 0.1)}
    assert {"mean[]"} <= off <= {"mean[]", "outlier_probability"}
    found = [m for m in moved(again, held) if m.of_uncertainty is not None]
    assert len(found) > 500
    assert all(m.of_uncertainty < 0.1 for m in found if "outlier" not in m.place)
    assert len(places_off(again, held, 1e-3)) > 200


@pytest.mark.parametrize(
    ("stored", "again", "same"),
    [
        ("rms 12.35(42) µg of 26 poses", "rms 12.34(42) µg of 26 poses", True),
        ("rms 12.36(42) µg of 26 poses", "rms 12.34(42) µg of 26 poses", True),
        ("rms 12.38(42) µg of 26 poses", "rms 12.34(42) µg of 26 poses", False),
        ("rms 12.34(42) µg of 27 poses", "rms 12.34(42) µg of 26 poses", False),
        ("rms 12.34(42) g of 26 poses", "rms 12.34(42) µg of 26 poses", False),
    ],
)
def test_a_sentence_may_have_a_figure_within_the_limit_and_no_other_count(stored: str, again: str, same: bool) -> None:
    """A figure with two digits of its uncertainty moves by two in its last place at most."""
    assert Figures({}, LIMIT).same_words(stored, again) is same
