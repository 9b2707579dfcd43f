"""Learned odds: a share of units with known truth, bounds, and what a document must be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import triaxcal as tc
from triaxcal.documents import to_text
from triaxcal.effects.catalogue import CATALOGUE
from triaxcal.evidence.prior import Odds
from triaxcal.population import LearnedEffect, LearnedOdds, SeenEffect, SeenUnit, learned_odds
from triaxcal.population.odds import CATALOGUE_ODDS, LEAST, MOST
from triaxcald.documents import loop_document

NAMES = [effect.name for effect in CATALOGUE[:6]]


def drawn(rng: np.random.Generator, share: float, strength: float) -> SeenUnit:
    """A unit with the first effect, or none: a normal statistic of this strength for each name gives its likelihood
    ratio, and the posterior has one of the names or none."""
    truth = np.zeros(len(NAMES))
    truth[0] = rng.random() < share
    x = rng.normal(size=len(NAMES)) + strength * truth
    weight = CATALOGUE_ODDS * np.exp(strength * x - strength**2 / 2)
    p = weight / (1 + weight.sum())
    return SeenUnit({name: SeenEffect(float(q), {}, CATALOGUE_ODDS) for name, q in zip(NAMES, p, strict=True)}, 0.02)


@pytest.mark.parametrize(("share", "strength"), [(0.3, 5.0), (0.3, 2.5), (0.05, 5.0)])
def test_the_odds_are_those_of_the_population(share: float, strength: float) -> None:
    """Over seeds: unbiased within the scatter of so many units, also where no unit by itself is certain."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        odds = learned_odds([drawn(rng, share, strength) for _ in range(200)]).effects[NAMES[0]].odds
        found.append(odds / (1 + odds))
    assert abs(np.mean(found) - share) < 0.1 * share + 3 * np.std(found) / np.sqrt(20)


def test_effects_that_no_unit_has_become_unlikelier_and_never_impossible() -> None:
    rng = np.random.default_rng(1)
    for units in (3, 30, 3000):
        learned = learned_odds([drawn(rng, 0.9, 6.0) for _ in range(units)])
        assert all(LEAST <= learned.effects[name].odds <= MOST for name in NAMES)
        assert all(learned.effects[name].odds <= CATALOGUE_ODDS for name in NAMES[1:])
    assert learned.effects[NAMES[0]].odds == MOST
    assert learned.effects[NAMES[3]].odds == LEAST


def test_a_few_units_change_little_and_uncertain_names_count_less_than_certain_ones() -> None:
    def with_first(p: float | None) -> LearnedOdds:
        return learned_odds([SeenUnit({NAMES[0]: SeenEffect(p), NAMES[1]: SeenEffect(0.001)})] * 2)

    uncertain, certain = with_first(None), with_first(0.995)
    assert CATALOGUE_ODDS < uncertain.effects[NAMES[0]].odds < certain.effects[NAMES[0]].odds < 0.55
    assert CATALOGUE_ODDS / 2 < certain.effects[NAMES[1]].odds < CATALOGUE_ODDS


def test_names_that_exclude_each_other_share_their_units() -> None:
    """Of two names that no unit tells apart neither has more units than there are."""
    units = [SeenUnit({n: SeenEffect(0.495, {}, CATALOGUE_ODDS) for n in NAMES[:2]}) for _ in range(40)]
    learned = learned_odds(units)
    assert learned.effects[NAMES[0]].odds == learned.effects[NAMES[1]].odds
    assert learned.effects[NAMES[0]].units + learned.effects[NAMES[1]].units <= 40


def test_odds_of_the_unit_are_not_counted_twice() -> None:
    """The same evidence under learned odds gives the same counts."""
    ratio = 40.0

    def under(odds: float) -> SeenUnit:
        return SeenUnit({NAMES[0]: SeenEffect(ratio * odds / (1 + ratio * odds), {}, odds)})

    first, second = learned_odds([under(CATALOGUE_ODDS)] * 30), learned_odds([under(0.2)] * 30)
    assert first.effects[NAMES[0]].odds == pytest.approx(second.effects[NAMES[0]].odds, rel=1e-9)


def test_a_document_comes_back_and_is_refused_for_another_part_number() -> None:
    learned = LearnedOdds("P", 12, {NAMES[0]: LearnedEffect(0.25, 6.5)}, 0.1)
    document = tc.interchange.odds_document(learned)
    assert tc.interchange.odds_of(document, where="x") == learned
    assert tc.interchange.odds_of(document, where="x", part_number="P") == learned
    with pytest.raises(tc.InvalidData, match=r"^x: odds of part number P, and the unit has Q$"):
        tc.interchange.odds_of(document, where="x", part_number="Q")


def test_without_units_there_are_no_odds() -> None:
    with pytest.raises(tc.InvalidData):
        learned_odds([])


@pytest.mark.slow
def test_diagnose_takes_odds_as_they_are_as_a_document_and_as_a_file(tmp_path: Path) -> None:
    up = np.array([v for _, v in tc.planning.directions(26)], dtype=float)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    u = up + 4e-5 * up**2 + rng.normal(size=up.shape) * 2e-5
    poses = tc.Poses.of_means(u, standard_errors=np.full(u.shape, 2e-5))
    name = "second_order_nonlinearity"
    learned = LearnedOdds(None, 30, {name: LearnedEffect(0.5, 28.0)}, 0.05)
    document = tc.interchange.odds_document(learned)
    path = tmp_path / "odds.json"
    path.write_text(to_text(document), encoding="utf-8")
    found = [tc.diagnose(poses, odds=odds) for odds in (learned, document, path, str(path))]
    assert len({repr(d.probabilities) for d in found}) == 1
    plain = tc.diagnosis.diagnose(poses)
    before, after = (tc.diagnosis.diagnose(poses, odds=odds).probabilities for odds in (None, learned.prior))
    assert before == plain.probabilities
    assert after[name] > before[name]
    seen = SeenUnit.of(tc.diagnosis.diagnose(poses, odds=learned.prior))
    assert seen.effects[name].prior_odds == 0.5
    assert seen.unmodelled_prior == 0.05 != Odds().unmodelled_probability


@pytest.mark.slow
@pytest.mark.parametrize("channels", [{"temp_c": 22 + 0.01 * np.arange(26)}, {}], ids=["temperature", "none"])
def test_a_loop_document_says_what_its_loop_says(channels: dict[str, np.ndarray]) -> None:
    up = np.array([v for _, v in tc.planning.directions(26)], dtype=float)
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    rng = np.random.default_rng(4)
    u = 4096 * (up + 2e-4 * up**2 + [3e-3, 0.0, -1e-3]) + rng.normal(size=up.shape) * 0.05
    poses = tc.Poses.of_means(
        u,
        t=12.0 * np.arange(26),
        standard_errors=np.full(u.shape, 0.05),
        channels=channels,
    )
    loop = tc.diagnosis.diagnose(poses)
    document = loop_document(loop, output_unit="counts")
    by_loop, by_document = SeenUnit.of(loop), tc.interchange.seen_unit_in(document, where="x")
    for name, seen in by_loop.effects.items():
        assert by_document.effects[name].prior_odds == pytest.approx(seen.prior_odds)
        other = by_document.effects[name].probability
        if seen.probability is None or other is None:
            assert seen.probability is other
        else:
            assert other == pytest.approx(seen.probability, abs=2e-3)
    run = tc.interchange.unit_run_in(document, serial="1", time_s=5.0, where="x", station="S", hour=3.0)
    assert np.allclose(run.coefficients[:3], 4096, rtol=1e-3)
    assert run.poses is not None
    assert run.poses.planned is not None
    assert np.allclose(np.sum(run.poses.planned * run.poses.measured, axis=1), 1, atol=1e-3)
    # What effects are likely is the loop's to say: the run has the same of it.
    assert {name: (seen.probability, seen.prior_odds) for name, seen in run.effects.items()} == {
        name: (seen.probability, seen.prior_odds) for name, seen in by_document.effects.items()
    }
    assert by_document.effects["second_order_nonlinearity"].probability == pytest.approx(
        by_loop.effects["second_order_nonlinearity"].probability, abs=2e-3
    )
    assert (
        by_document.effects["second_order_nonlinearity"].probability
        > 10 * by_document.effects["hysteresis"].probability
    )
    with pytest.raises(tc.InvalidData):
        tc.interchange.seen_unit_in({"format": "triaxcal.poses/1"}, where="x")
