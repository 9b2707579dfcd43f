"""How |a| goes inside the poses: it tells effects apart that the means cannot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.diagnosis import Verdict, diagnose
from triaxcal.effects import effect_named
from triaxcal.effects.catalogue import PluginEffect
from triaxcal.effects.contract import Coefficient, Effect, no_slope, on_each_axis, xyz
from triaxcal.errors import Refused
from triaxcal.estimate.creep import PoseSlopes, left_by_slopes, slopes_p, with_slopes
from triaxcal.estimate.fit_assessment import Excess, cross_validated
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.estimate.likelihood import State, linearise, linearise_all, residual_sum_of_squares, solve
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Posterior, Refusal, posterior_of
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.stillness.detector import StillnessDetector
from triaxcal.synthetic import Tumble, noisy_poses
from triaxcal.text import holds
from triaxcal.uncertainty import Stated, budget

MINUS = (-1.0, -1.0, -1.0)
SIGMA_G = 1.5e-5
TREND_G = 12**0.5 * SIGMA_G
"""White noise that moves a mean by σ moves the ends of a straight line through it by √12 σ from each other."""
HOLD_S = 10.0
SENSITIVITY = np.array([4e-4, -3e-4, 5e-4])  # g/K
TEMPERATURE = effect_named("temperature_bias")
SQUARE = effect_named("second_order_nonlinearity")


def history(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Temperature in the middle of each of n poses, °C, and its rate there, K/s."""
    t = (np.arange(n) + 0.5) * HOLD_S
    return 25 + 3 * np.sin(t / 37), 3 / 37 * np.cos(t / 37)


def moving(
    unit: Sensor, ups: np.ndarray, rng: np.random.Generator, effects: tuple[tuple[Effect, np.ndarray], ...] = ()
) -> list[Pose]:
    """Poses whose outputs go on moving inside as the temperature's effect makes them, with noise."""
    temp_c, rate = history(len(ups))
    sensor = replace(unit, effects=effects)
    channels, reference = {"temp_c": temp_c}, {"temp_c": 25.0}
    poses = noisy_poses(sensor, ups, SIGMA_G, rng, channels=channels, channel_reference=reference, hold_s=HOLD_S)
    begin, end = (sensor.output(ups, {"temp_c": temp_c - 25 + x * rate * HOLD_S}) for x in (-0.5, 0.5))
    scale = float(np.abs(unit.scale_factor).mean())
    return [
        replace(
            p,
            rates={"temp_c": rate[i]},
            rate_errors={"temp_c": 0.0},
            bends={"temp_c": 0.0},
            bend_errors={"temp_c": 0.0},
            slope=end[i] - begin[i] + scale * TREND_G * rng.standard_normal(3),
            slope_error=scale * TREND_G,
        )
        for i, p in enumerate(poses)
    ]


def misfit(poses: list[Pose], effects: tuple[Effect, ...]) -> float:
    """How far the slopes are from those that a model of the means predicts, as near as the means let it come."""
    problem = problem_of(poses, signs=MINUS, reference=1.0)
    state = solve(problem, start(problem, poses, MINUS), effects)
    _, J, s = linearise(problem, State(state.theta, effects))
    slopes = PoseSlopes.of(problem, poses)
    assert slopes
    r, by_theta, error = slopes.linearise(state)
    columns = np.concatenate([J / s[:, None], by_theta / error[:, None]])
    return residual_sum_of_squares(columns, np.concatenate([np.zeros(len(J)), r / error]))


def blind(poses: list[Pose]) -> list[Pose]:
    """The same poses without their trends."""
    return [replace(p, slope_error=np.inf) for p in poses]


def seen_in(poses: list[Pose]) -> Posterior:
    return posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS)


@pytest.mark.parametrize("effects", [(), (TEMPERATURE,), (TEMPERATURE, SQUARE)], ids=str)
def test_under_the_true_model_trends_scatter_as_their_errors_say(
    paper_unit: Sensor, twenty_six: np.ndarray, effects: tuple[Effect, ...]
) -> None:
    rng = np.random.default_rng(3)
    inside = ((TEMPERATURE, SENSITIVITY),) if effects else ()
    total = sum(misfit(moving(paper_unit, twenty_six, rng, inside), effects) for _ in range(40))
    low, high = stats.chi2.ppf([0.5e-3, 1 - 0.5e-3], 40 * 26)
    assert low < total < high


def test_a_model_that_lacks_what_moves_inside_the_poses_is_found_out(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """By what the poses' |a| moves, in units of its errors."""
    poses = moving(paper_unit, twenty_six, np.random.default_rng(0), ((TEMPERATURE, SENSITIVITY),))
    moved = np.linalg.inv(paper_unit.axes) @ np.outer(SENSITIVITY, history(26)[1] * HOLD_S)
    along = np.einsum("in,ni->n", moved, twenty_six) / TREND_G
    beyond = float(along @ along)
    assert beyond > 300
    assert misfit(poses, ()) == pytest.approx(26 + beyond, abs=4 * np.sqrt(2 * 26 + 4 * beyond))
    assert misfit(poses, (TEMPERATURE,)) < 60


def test_a_unit_that_turns_on_its_stand_has_no_trend(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """A milliradian in every pose, a hundred times what noise does."""
    rng = np.random.default_rng(1)
    poses = moving(paper_unit, twenty_six, rng)
    across = np.cross(twenty_six, rng.standard_normal(twenty_six.shape))
    across *= 1e-3 / np.linalg.norm(across, axis=1, keepdims=True)
    turned = across @ paper_unit.axes.T * paper_unit.scale_factor
    tilted = [replace(p, slope=p.slope + t) for p, t in zip(poses, turned, strict=True)]
    assert misfit(tilted, ()) == pytest.approx(misfit(poses, ()), rel=0.1)


def test_a_thermometer_that_says_nothing_of_its_rate_proves_nothing(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """The coefficient of the temperature is known; how far it moved in the pose is not."""
    poses = moving(paper_unit, twenty_six, np.random.default_rng(2), ((TEMPERATURE, SENSITIVITY),))
    blind = [replace(p, rates={"temp_c": 0.0}, rate_errors={"temp_c": 0.1}) for p in poses]
    sure = [replace(p, rate_errors={"temp_c": 0.0}) for p in blind]
    assert misfit(blind, (TEMPERATURE,)) < 60
    assert misfit(sure, (TEMPERATURE,)) > 300


def test_poses_that_know_no_trend_have_none(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, SIGMA_G, np.random.default_rng(0))
    assert PoseSlopes.of(problem_of(poses, signs=MINUS, reference=1.0), poses) is None


def test_a_model_that_does_not_hold_inside_the_poses_is_infinitely_far_from_their_trends(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = moving(paper_unit, twenty_six, np.random.default_rng(0))
    problem = with_slopes(problem_of(poses, signs=MINUS, reference=1.0), poses, (TEMPERATURE,))
    assert problem is not None
    fitted = solve(problem, start(problem, poses, MINUS), (TEMPERATURE,))
    assert left_by_slopes(problem, fitted) < 100
    nowhere = State(fitted.theta * np.nan, fitted.effects)
    with np.errstate(invalid="ignore"):
        assert left_by_slopes(problem, nowhere) == np.inf
        assert slopes_p(problem, nowhere, 1e6) == 0.0


OF_TIME = {"bias_drift", "warm_up", "bias_step", "temperature_bias", "temperature_bias_quadratic",
           "temperature_scale_factor", "temperature_lag", "thermal_gradient", "scale_factor_drift"}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "size"), [(TEMPERATURE, 0.3 * SENSITIVITY), (SQUARE, np.array([2e-4, -1e-4, 3e-4]))]
)
def test_of_fourteen_poses_trends_tell_what_the_means_cannot(
    paper_unit: Sensor, fourteen: np.ndarray, effect: Effect, size: np.ndarray
) -> None:
    """Temperature, drift and the square of the output do alike to 14 means, but not inside the poses."""
    rng = np.random.default_rng(5)
    poses = moving(paper_unit, fourteen[rng.permutation(14)], rng, ((effect, size),))
    means, both = seen_in(blind(poses)), seen_in(poses)
    others = [
        seen.any_of(OF_TIME - {effect.name}) + seen.unmodelled_kind_probabilities[UnmodelledKind.TIME]
        for seen in (means, both)
    ]
    assert others[1] < min(others[0] / 3, 0.05)
    assert both.effect_probabilities[effect.name] > means.effect_probabilities[effect.name]
    if effect is TEMPERATURE:
        assert both.effect_probabilities[effect.name] > 0.99 > 0.95 > means.effect_probabilities[effect.name]


@pytest.mark.slow
def test_what_has_no_name_and_moves_inside_the_poses_goes_with_the_time(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A temperature that nobody logged, up and down too often for a drift."""
    rng = np.random.default_rng(8)
    hot = moving(paper_unit, twenty_six, rng, ((TEMPERATURE, 3 * SENSITIVITY),))
    kept = [replace(p, channels={}, rates={}, rate_errors={}, bends={}, bend_errors={}) for p in hot]
    still = [replace(p, slope=np.zeros(3)) for p in kept]
    moves, rests = (diagnose(poses, signs=MINUS, catalogue=[SQUARE]) for poses in (kept, still))
    for loop in (moves, rests):
        assert loop.found.unexplained.probability > 0.99
        assert loop.refusal is Refusal.UNMODELLED
    assert moves.posterior.unmodelled_kind_probabilities[UnmodelledKind.TIME] > 0.99
    assert rests.posterior.unmodelled_kind_probabilities[UnmodelledKind.TIME] < 0.01


@pytest.mark.slow
def test_a_step_between_two_poses_is_no_slope_inside_them(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """Hundreds of times what noise does, while the unit is turned from the eighth pose to the ninth."""
    path = Tumble(fourteen, hold_s=10.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    at_s = 8 * path.step_s - 0.75
    step, size = effect_named("bias_step").shaped({"at": at_s}), np.array([3e-3, -2e-3, 1.5e-3])
    clean, total = paper_unit.output(path.specific_force(t_s), {}), 0.0
    for seed in range(10):
        noise = 1e-4 * np.random.default_rng(seed).standard_normal((len(t_s), 3))
        u = clean + noise
        detector = StillnessDetector()
        detector.feed((t_s * 1e9).astype(np.int64), u + np.outer(t_s >= at_s, size * paper_unit.scale_factor), {})
        detector.finish()
        total += misfit(poses_of(detector.windows(), detector.spans()), (step,))
    assert total / 140 == pytest.approx(1, abs=0.35)


@dataclass(frozen=True)
class Table(Effect):
    """What temperature does to the bias, by a table that ends where the means of these poses end."""

    name: str = "table"
    coefficients: tuple[Coefficient, ...] = xyz("g/K")
    needs: tuple[str, ...] = ("temp_c",)
    remedy: str = "Make the table longer."
    end_k: float = 2.0

    def basis(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
        if np.abs(covariates["temp_c"]).max() > self.end_k:
            raise ValueError("outside the table")
        return on_each_axis(covariates["temp_c"])

    def slope(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
        return no_slope(s)

    def advice(self, largest: float, floor: float) -> str:
        raise NotImplementedError

    @property
    def absent(self) -> str:
        raise NotImplementedError


@pytest.mark.slow
def test_an_effect_of_another_package_that_is_known_at_the_means_alone_is_left_out_and_told(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """What it predicts inside the poses nobody knows."""
    poses = moving(paper_unit, twenty_six, np.random.default_rng(4), ((TEMPERATURE, SENSITIVITY),))
    means = np.array([p.channels["temp_c"] for p in poses])
    table = Table(end_k=float(np.abs(means - round(float(means.mean()), 1)).max()) + 1e-4)
    loop = diagnose(poses, signs=MINUS, catalogue=[PluginEffect(table, "the package of a table")])
    ((name, why),) = loop.faulty.items()
    assert name == "table"
    assert "outside the table" in why
    assert loop.after.terms == ("linear",)
    assert loop.findings == loop.candidates == ()
    assert loop.found.unexplained.kind is UnmodelledKind.TIME
    # Where no slope is known it is asked about.
    seen = diagnose(blind(poses), signs=MINUS, catalogue=[PluginEffect(table, "the package of a table")])
    (found,) = seen.findings
    assert (found.effect, found.verdict, found.remedy) == ("table", Verdict.ADOPTED, table.remedy)
    effects = [effect for effect, _ in seen.after.sensor.effects]
    assert holds(effects, seen.after.channel_reference)[0].startswith("at temp_c = ")


QUADRATIC = effect_named("temperature_bias_quadratic")
CURVED = np.array([4e-4, -3e-4, 5e-4, 6e-5, 8e-5, -7e-5])  # g/K and g/K²


@pytest.mark.slow
def test_trends_fitted_along_with_the_means_narrow_the_intervals_and_these_hold_the_truth(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    """But for one recording of a hundred, whose trends look by chance as if they contradicted the means."""
    rng, inside, narrower, seeds = np.random.default_rng(6), 0, [], 60
    for _ in range(seeds):
        poses = moving(paper_unit, fourteen[rng.permutation(14)], rng, ((TEMPERATURE, SENSITIVITY),))
        c, means = (fit(p, signs=MINUS, effects=[TEMPERATURE], excluded=()) for p in (poses, blind(poses)))
        assert not means.slopes
        low, high = (side[9:] for side in c.interval())
        inside += int(np.count_nonzero((low < SENSITIVITY) & (high > SENSITIVITY)))
        if c.slopes:
            narrower.append(c.standard_errors[9:] / c.birge_ratio / (means.standard_errors[9:] / means.birge_ratio))
    assert len(narrower) > 0.96 * seeds
    assert np.max(narrower) < 1
    assert np.mean(narrower) < 0.95
    assert 0.93 < inside / (3 * seeds) < 0.985


def test_trends_that_contradict_the_means_have_no_part_in_the_fit(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """A unit that follows its thermometer late, so that inside the poses it goes the other way."""
    poses = moving(paper_unit, twenty_six, np.random.default_rng(7), ((TEMPERATURE, SENSITIVITY),))
    late = [replace(p, slope=-p.slope) for p in poses]
    c, means = (fit(p, signs=MINUS, effects=[TEMPERATURE], excluded=()) for p in (late, blind(poses)))
    assert not c.slopes
    assert np.array_equal(c.values, means.values)


def test_means_that_leave_nothing_are_not_believed_against_the_trends(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """Twelve poses fit twelve parameters whatever they are."""
    ups = twenty_six[np.random.default_rng(3).permutation(26)[:12]]
    poses = moving(paper_unit, ups, np.random.default_rng(7), ((TEMPERATURE, SENSITIVITY),))
    assert fit(poses, signs=MINUS, effects=[TEMPERATURE], excluded=()).slopes
    with pytest.raises(Refused, match="12 poses cannot carry 12 parameters"):
        fit([replace(p, slope=-p.slope) for p in poses], signs=MINUS, effects=[TEMPERATURE], excluded=())


def test_trends_have_no_part_in_a_model_that_nothing_moves_inside_the_poses(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    poses = moving(paper_unit, twenty_six, np.random.default_rng(8), ((SQUARE, np.array([2e-3, -1e-3, 3e-3])),))
    for effects in ([], [SQUARE]):
        c, means = (fit(p, signs=MINUS, effects=effects, excluded=()) for p in (poses, blind(poses)))
        assert not c.slopes
        assert np.array_equal(c.values, means.values)


@pytest.mark.slow
def test_fourteen_poses_carry_six_coefficients_by_what_moves_inside_them(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    """Six coefficients and nine parameters are more than fourteen means, by which alone nothing can be said."""
    alone, pulls = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        poses = moving(paper_unit, fourteen[rng.permutation(14)], rng, ((QUADRATIC, CURVED),))
        loop = diagnose(poses, signs=MINUS)
        assert loop.probabilities[QUADRATIC.name] > 0.99
        assert {name for f in loop.findings for name in (f.effect, *f.alternatives)} <= {QUADRATIC.name}
        assert loop.after.terms == ("linear", QUADRATIC.name)
        alone.append([f.verdict for f in loop.findings])
        elsewhere = loop.after.channel_reference["temp_c"] - 25
        there = CURVED + np.concatenate([2 * elsewhere * CURVED[3:], np.zeros(3)])
        pulls.append((loop.after.values[9:] - there) / loop.after.standard_errors[9:])
        if not seed:
            means = diagnose(blind(poses), signs=MINUS)
            assert means.probabilities[QUADRATIC.name] < 0.5
            assert means.findings == ()
    # One of the three hangs on a single pose.
    assert alone.count([Verdict.ADOPTED]) >= 2
    assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1, abs=0.4)


def test_a_pose_left_out_for_cross_validation_leaves_with_its_trend(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    """Against as many fits from the beginning."""
    poses = moving(paper_unit, fourteen, np.random.default_rng(9), ((TEMPERATURE, SENSITIVITY),))
    problem = with_slopes(problem_of(poses, signs=MINUS), poses, [TEMPERATURE])
    assert problem
    begin = start(problem, poses, MINUS)
    state = solve(problem, begin, (TEMPERATURE,))
    misses = []
    for i in range(len(poses)):
        rest = solve(problem.only(np.delete(np.arange(len(poses)), i)), begin, (TEMPERATURE,))
        misses.append(linearise(problem.only(slice(i, i + 1)), rest, jacobian=False)[0][0])
    assert cross_validated(problem, state) == pytest.approx(np.sqrt(np.mean(np.square(misses))), rel=1e-3)


def test_what_all_poses_have_beside_their_noise_widens_the_trend_of_each_as_its_mean(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    rng = np.random.default_rng(11)
    poses = moving(paper_unit, twenty_six, rng, ((TEMPERATURE, SENSITIVITY),))
    poses = [replace(p, covariance=p.covariance * f) for p, f in zip(poses, rng.uniform(1, 9, 26), strict=True)]
    problem = with_slopes(problem_of(poses, signs=MINUS), poses, [TEMPERATURE])
    assert problem
    state = solve(problem, start(problem, poses, MINUS), (TEMPERATURE,))
    before = linearise_all(problem, state)[2].reshape(2, 26)
    beside = Excess(excess_g=SIGMA_G).added_to(problem, state)
    after = linearise_all(beside, state)[2].reshape(2, 26)
    assert after[0] == pytest.approx(np.hypot(before[0], SIGMA_G))
    assert after[1] / before[1] == pytest.approx(after[0] / before[0])
    some = linearise_all(beside.only(np.array([3, 20])), state)[2].reshape(2, 2)
    assert some == pytest.approx(after[:, [3, 20]])


@pytest.mark.slow
def test_means_that_come_back_less_well_leave_honest_errors_beside_the_trends(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    truth = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    pulls = []
    for seed in range(24):
        rng = np.random.default_rng([seed, 12])
        off = 4 * SIGMA_G * rng.standard_normal((26, 1)) * twenty_six * paper_unit.scale_factor
        poses = moving(paper_unit, twenty_six, rng, ((TEMPERATURE, SENSITIVITY),))
        poses = [replace(p, mean=p.mean + o) for p, o in zip(poses, off, strict=True)]
        c = fit(poses, signs=MINUS, effects=[TEMPERATURE], excluded=())
        if c.slopes and c.excess_g:
            pulls.append((c.values[:6] - truth[:6]) / c.standard_errors[:6])
    assert len(pulls) > 15
    assert 0.8 < np.sqrt(np.mean(np.square(pulls))) < 1.2


def test_the_budget_of_a_fit_to_means_and_trends_has_the_errors_of_the_fit(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    poses = moving(paper_unit, fourteen, np.random.default_rng(10), ((TEMPERATURE, SENSITIVITY),))
    c = fit(poses, signs=MINUS, effects=[TEMPERATURE], excluded=())
    assert c.slopes
    scatter = [part.parameters for part in budget(c).components if part.evaluation == "A"]
    assert np.sqrt(np.sum(np.square(scatter), axis=0)) == pytest.approx(c.standard_errors, rel=1e-6)
    # An error of the reference is one of the scale factors, and nothing of the temperature's.
    (reference,) = [p for p in budget(c, Stated(reference=1e-4)).components if p.source == "reference"]
    assert reference.parameters[:3] == pytest.approx(1e-4 * np.abs(c.sensor.scale_factor), rel=0.01)
    assert np.all(reference.parameters[9:] < 1e-3 * np.abs(SENSITIVITY))


@pytest.mark.slow
def test_what_moves_inside_the_poses_alone_says_nothing_of_the_means(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """Second order explains the means; that a pose turns up and down in its length nothing explains."""
    rng = np.random.default_rng(9)
    truth = np.array([1e-3, -8e-4, 6e-4])
    poses = moving(paper_unit, twenty_six, rng, ((SQUARE, truth),))
    for share, only in ((0.0, False), (3e-4, True)):
        odd = [replace(p, slope=p.slope + share * rng.standard_normal() * p.mean) for p in poses]
        loop = diagnose(odd, signs=MINUS, catalogue=[SQUARE, TEMPERATURE])
        inside = loop.posterior.unmodelled_kind_probabilities[UnmodelledKind.WITHIN_POSE]
        assert inside > 0.99 if only else inside < 0.05
        assert not loop.found.unexplained.significant
        assert loop.probabilities[SQUARE.name] > 0.95
        assert np.all(np.abs(loop.after.values[9:] - truth) < 4 * loop.after.standard_errors[9:])


@pytest.mark.slow
def test_what_an_effect_of_the_means_foretells_in_vain_inside_the_poses_is_a_part_of_their_slopes(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A temperature that acts from pose to pose and not inside them: its rate may be noise of the thermometer, and the
    coefficients are those of the means."""
    rng = np.random.default_rng(0)
    quiet = moving(paper_unit, twenty_six, rng)
    means = moving(paper_unit, twenty_six, rng, ((TEMPERATURE, SENSITIVITY),))
    for share, in_vain in ((0.0, False), (0.5, True)):
        poses = [
            replace(p, slope=q.slope, rates={"temp_c": share * p.rates["temp_c"]})
            for p, q in zip(means, quiet, strict=True)
        ]
        loop = diagnose(poses, signs=MINUS, catalogue=[TEMPERATURE, SQUARE])
        inside = loop.posterior.unmodelled_kind_probabilities[UnmodelledKind.WITHIN_POSE]
        assert inside > 0.99 if in_vain else inside < 0.05
        assert [(f.effect, f.verdict) for f in loop.findings] == [(TEMPERATURE.name, Verdict.ADOPTED)]
        assert np.all(np.abs(loop.after.values[9:] - SENSITIVITY) < 4 * loop.after.standard_errors[9:])


@pytest.mark.slow
def test_a_channel_that_foretells_what_the_poses_do_not_do_inside_is_not_named_beside_one_that_does(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A supply that goes with the means, and with nothing inside the poses."""
    rng = np.random.default_rng(3)
    poses = []
    for p in moving(paper_unit, twenty_six, rng, ((TEMPERATURE, SENSITIVITY),)):
        off_v = 0.3 * rng.standard_normal()
        poses.append(
            replace(
                p,
                mean=p.mean + paper_unit.scale_factor * SENSITIVITY * off_v,
                channels={**p.channels, "supply_v": 5 + off_v},
                rates={**p.rates, "supply_v": 0.02 * rng.standard_normal()},
                rate_errors={**p.rate_errors, "supply_v": 0.0},
                bends={**p.bends, "supply_v": 0.0},
                bend_errors={**p.bend_errors, "supply_v": 0.0},
            )
        )
    loop = diagnose(poses, signs=MINUS)
    assert loop.probabilities[TEMPERATURE.name] > 0.99
    assert loop.probabilities.get("channel_bias:supply_v", 0.0) < 0.1
    assert loop.found.unexplained.probability > 0.9
    assert loop.after.terms == ("linear",)
