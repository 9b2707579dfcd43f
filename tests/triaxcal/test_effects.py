"""Every effect of the catalogue keeps the contract: names, basis, slope, needs, forms, shape, remedy, one file."""

from __future__ import annotations

import math
import pkgutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import triaxcal.effects
from triaxcal.diagnosis import diagnose
from triaxcal.effects import CATALOGUE, TIME, Effect, catalogue_for, effect_named, effect_of
from triaxcal.effects.catalogue import plugins
from triaxcal.effects.channel import ChannelBias, ChannelScaleFactor
from triaxcal.effects.contract import (
    BEFORE,
    CHANGE,
    DERIVED,
    DURATION,
    LAGS_S,
    RUN,
    SCATTER,
    SINCE_START,
    channel_of,
    covariate_of,
    is_derived,
    lag_in,
    lag_of,
    rate_of,
)
from triaxcal.effects.memory import Hysteresis
from triaxcal.effects.nonlinear import Compression
from triaxcal.effects.thermal import TemperatureLag
from triaxcal.effects.time import BiasDrift, BiasStep, WarmUp
from triaxcal.errors import InvalidData
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.text.advice import notes
from triaxcal.units import ErrorUnit

# The names that others script against (the contract of the command line).
AGREED = {
    "second_order_nonlinearity", "third_order_nonlinearity", "scale_factor_asymmetry", "cross_coupling",
    "temperature_bias", "temperature_bias_quadratic", "temperature_scale_factor", "thermal_gradient",
    "bias_drift", "warm_up", "bias_step", "hysteresis", "vibration_rectification", "fifth_order_nonlinearity",
    "compression", "scale_factor_drift", "temperature_lag", "remanence",
}  # fmt: skip
KNOWN = CATALOGUE
FORMS = [form for effect in KNOWN for form in effect.forms]
CHANNEL_EFFECTS: list[Effect] = [ChannelBias("supply_v"), ChannelScaleFactor("supply_v")]
EVERY = [*FORMS, *CHANNEL_EFFECTS]

# One pose, in round numbers: s = (2, −3, 5) g, ΔT = 7 K and so on. Half of it lies before the step at 40 s.
S = np.array([[2.0, -3.0, 5.0]])
HERE: dict[str, float] = {
    "temp_c": 7.0, rate_of("temp_c"): 0.25, "supply_v": -0.5, TIME: 11.0, SINCE_START: 40.0, DURATION: 10.0,
    "before_x": 0.5, "before_y": -0.25, "before_z": 0.75, "change_x": 1.5, "change_y": -2.75, "change_z": 0.0,
    "scatter_x": 1e-4, "scatter_y": 4e-4, "scatter_z": 9e-4,
    **{lag_of("temp_c", constant_s): -1e-3 * constant_s for constant_s in LAGS_S},
}  # fmt: skip
I3 = np.eye(3)


def bent(s: float) -> float:
    return 0.07 * math.log1p(math.exp((s - 0.7) / 0.07))


# What a unit of each coefficient adds to axis x, y, z, written by hand for that pose; by name and number of form.
BY_HAND = {
    ("second_order_nonlinearity", 0): np.diag([4.0, 9.0, 25.0]),
    ("third_order_nonlinearity", 0): np.diag([8.0, -27.0, 125.0]),
    ("scale_factor_asymmetry", 0): np.diag([2.0, 3.0, 5.0]),
    # Columns x_xy, x_xz, y_yx, y_yz, z_zx, z_zy, and the one that x, y, z share.
    ("cross_coupling", 0): np.array(
        [[-6, 10, 0, 0, 0, 0, -15], [0, 0, -6, -15, 0, 0, 10], [0, 0, 0, 0, 10, -15, -6.0]]
    ),
    # Then y_xx, z_xx, x_yy, z_yy, x_zz, y_zz, and x_yz, y_xz, z_xy.
    ("cross_coupling", 1): np.array(
        [
            [-6, 10, 0, 0, 0, 0, 0, 0, 9, 0, 25, 0, -15, 0, 0],
            [0, 0, -6, -15, 0, 0, 4, 0, 0, 0, 0, 25, 0, 10, 0],
            [0, 0, 0, 0, 10, -15, 0, 4, 0, 9, 0, 0, 0, 0, -6.0],
        ]
    ),
    ("temperature_bias", 0): 7 * I3,
    ("temperature_bias_quadratic", 0): np.concatenate([7 * I3, 49 * I3], axis=1),
    ("temperature_scale_factor", 0): np.diag([14.0, -21.0, 35.0]),
    ("thermal_gradient", 0): 0.25 * I3,
    ("bias_drift", 0): 11 * I3,
    ("bias_drift", 1): np.concatenate([11 * I3, 121 * I3], axis=1),
    ("bias_drift", 2): np.concatenate([11 * I3, 121 * I3, 1331 * I3], axis=1),
    ("warm_up", 0): 0.8751733190429475 * I3,  # exp(−40/300)
    ("bias_step", 0): 0 * I3,  # at 0 s: long since over
    ("hysteresis", 0): np.diag([0.5, -0.25, 0.75]),
    ("hysteresis", 1): np.diag([1.0, -1.0, 0.0]),
    ("vibration_rectification", 0): np.diag([1e-4, 4e-4, 9e-4]),
    ("fifth_order_nonlinearity", 0): np.diag([32.0, -243.0, 3125.0]),
    # The knee at 0.7: 1.3, 2.3 and 4.3 beyond it, and what its bend, 0.07 wide, leaves so far off.
    ("compression", 0): np.diag([bent(-2) - bent(2), bent(3) - bent(-3), bent(-5) - bent(5)]),
    ("compression", 1): np.diag([2 * bent(0) - bent(v) - bent(-v) for v in (2, 3, 5)]),
    ("scale_factor_drift", 0): np.diag([22.0, -33.0, 55.0]),
    ("temperature_lag", 0): 6.67 * I3,  # 7 K less 330 s at 1 mK/s
    # Along y the pose before had half of what leaves the whole, in a force of the order of 10.
    ("remanence", 0): np.diag([1.0, -0.5, 1.0]),
    ("channel_bias:supply_v", 0): -0.5 * I3,
    ("channel_scale_factor:supply_v", 0): np.diag([-1.0, 1.5, -2.5]),
}


def each(effect: Effect) -> str:
    return f"{effect.name}-{len(effect.coefficients)}-{getattr(effect, 'kind', '')}".rstrip("-")


def one() -> dict[str, np.ndarray]:
    return {name: np.array([value]) for name, value in HERE.items()}


def held(n: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    out = {name: rng.uniform(-300, 300, n) for name in HERE}
    return out | {SINCE_START: rng.uniform(0, 600, n), DURATION: rng.uniform(1, 20, n)}


@pytest.mark.parametrize("effect", KNOWN, ids=each)
def test_the_name_is_one_agreed_on_and_units_and_remedy_are_stated(effect: Effect) -> None:
    assert effect.name in AGREED
    assert effect_named(effect.name) is effect
    assert effect.remedy.endswith(".")


def test_the_catalogue_has_every_name_that_is_agreed_on_once() -> None:
    assert sorted(e.name for e in CATALOGUE) == sorted(AGREED)


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_coefficients_have_names_of_their_own_and_units(effect: Effect) -> None:
    assert all(c.name and c.unit for c in effect.coefficients)
    assert len({c.name for c in effect.coefficients}) == len(effect.coefficients)
    assert not {c.name for c in effect.coefficients} & set(effect.shape)


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_a_unit_of_each_coefficient_adds_what_the_formula_says(effect: Effect) -> None:
    form = [e for e in EVERY if e.name == effect.name].index(effect)
    basis = effect.basis(S, one())
    assert basis.shape == (1, 3, len(effect.coefficients))
    assert basis[0] == pytest.approx(BY_HAND[effect.name, form], rel=1e-12)


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_the_slope_is_the_finite_difference_of_the_basis(effect: Effect) -> None:
    rng = np.random.default_rng(0)
    s, covariates = rng.uniform(-1.5, 1.5, (20, 3)), held(20, rng)
    slope = effect.slope(s, covariates)
    assert slope.shape == (20, 3, 3, len(effect.coefficients))
    for by in range(3):
        h = 1e-6 * np.eye(3)[by]
        difference = (effect.basis(s + h, covariates) - effect.basis(s - h, covariates)) / 2e-6
        assert slope[:, :, by] == pytest.approx(difference, rel=1e-7, abs=1e-7)


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_no_more_conditions_are_used_than_are_declared(effect: Effect) -> None:
    rng = np.random.default_rng(0)
    s, covariates = rng.standard_normal((5, 3)), held(5, rng)
    declared = {n: covariates[n] for n in effect.needs}
    assert np.array_equal(effect.basis(s, declared), effect.basis(s, covariates))
    for name in effect.needs:
        with pytest.raises(KeyError):
            effect.basis(s, {n: v for n, v in declared.items() if n != name})


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_each_part_is_one_axis_or_a_group_that_acts_on_its_own(effect: Effect) -> None:
    parts = {c.part for c in effect.coefficients}
    if effect.name == "cross_coupling":
        assert len(parts) == 7
    else:
        assert parts == {"x", "y", "z"}
        basis = effect.basis(S, {n: np.array([v + 0.1]) for n, v in HERE.items()})[0]
        for k, c in enumerate(effect.coefficients):
            others = [i for i in range(3) if "xyz"[i] != c.part]
            assert np.all(basis[others, k] == 0)


def test_hysteresis_by_the_way_goes_through_zero_where_hardly_anything_changed() -> None:
    reversal = Hysteresis("reversal")
    # Whatever the unit of the reference.
    for reference in (1.0, 9.80665, 5e4, 4.8e-5):
        order = 10.0 ** np.rint(np.log10(reference))
        change = {n: np.array([v * order]) for n, v in zip(CHANGE, (2.5e-4, -5e-4, 2e-3), strict=True)}
        s = reference * np.array([[0.61, -0.5, 0.6]])
        assert np.diag(reversal.basis(s, change)[0]) == pytest.approx([0.25, -0.5, 1.0])
    assert reversal.needs == CHANGE
    assert Hysteresis().needs == BEFORE


# Shapes.


def test_a_step_counts_in_full_before_it_in_part_within_a_pose_and_not_at_all_after_it() -> None:
    middle, lasts = np.array([5.0, 15.0, 25.0, 35.0]), np.array([10.0, 10.0, 8.0, 10.0])
    held = {SINCE_START: middle, DURATION: lasts}
    # Poses end at 10, 20, 29, 40 s; 17 s is seven tenths through the second.
    expected = {10.0: [-1, 0, 0, 0], 17.0: [-1, -0.7, 0, 0], 20.5: [-1, -1, 0, 0], 23.0: [-1, -1, -0.25, 0]}
    for at_s, weights in expected.items():
        basis = BiasStep(at_s).basis(np.zeros((4, 3)), held)
        for axis in range(3):
            assert basis[:, axis, axis] == pytest.approx(weights)


def test_the_search_tries_a_step_between_any_two_poses_and_within_all_but_the_first_and_last() -> None:
    middle, lasts = np.array([5.0, 17.0, 32.0, 45.0]), np.array([10.0, 10.0, 12.0, 10.0])
    tried = [v.shape["at"] for v in BiasStep().variants({SINCE_START: middle, DURATION: lasts})]
    # Poses are 0–10, 12–22, 26–38, 40–50 s.
    assert [value for value, _ in tried] == pytest.approx([11.0, 17.0, 24.0, 32.0, 39.0])
    assert {unit for _, unit in tried} == {"s"}


def test_the_search_tries_time_constants_from_a_few_poses_to_the_whole_recording() -> None:
    t = np.linspace(5.0, 255.0, 26)
    tried = [v.shape["time_constant"][0] for v in WarmUp().variants({SINCE_START: t})]
    assert tried == sorted(tried)
    assert tried[0] == pytest.approx(15.0)
    assert tried[-1] == pytest.approx(1000.0)
    # Close enough that the one between two tried is told from either by little: an exponential of time constant τ and
    # one of √ratio τ correlate, beside a constant, to a few per cent of their size.
    x = np.exp(-t[:, None] / np.array([tried[2], np.sqrt(tried[2] * tried[3])]))
    x = x - x.mean(axis=0)
    assert np.corrcoef(x.T)[0, 1] > 0.98


@pytest.mark.parametrize(
    ("effect", "shape"), [(WarmUp(), "time_constant"), (BiasStep(), "at"), (Compression(), "knee")]
)
def test_shaped_changes_the_shape_and_nothing_else(effect: Effect, shape: str) -> None:
    other = effect.shaped({shape: 123.0})
    assert dict(other.shape) == {shape: (123.0, effect.shape[shape][1])}
    assert (other.name, other.coefficients, other.needs) == (effect.name, effect.coefficients, effect.needs)


def test_effects_without_a_shape_come_back_as_they_are() -> None:
    for effect in KNOWN:
        if not effect.shape:
            assert effect.shaped({}) is effect
            assert set(effect.variants(one())) <= set(effect.forms)


def test_drift_comes_straight_curved_and_with_a_turn() -> None:
    forms = BiasDrift().forms
    assert [len(f.coefficients) for f in forms] == [3, 6, 9]
    assert [c.name for c in forms[2].coefficients] == ["x", "y", "z", "x2", "y2", "z2", "x3", "y3", "z3"]
    assert [c.unit for c in forms[2].coefficients[::3]] == ["g/s", "g/s²", "g/s³"]


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_at_its_reference_an_effect_of_time_or_environment_adds_nothing(effect: Effect) -> None:
    """A unit in use started long ago, and nothing deviates: only what the input itself does is left."""
    covariates = {n: np.array([np.inf if n == SINCE_START else 0.0]) for n in HERE}
    basis = effect.basis(S, covariates)
    if effect.needs:
        assert np.all(basis == 0)
    else:
        assert np.any(basis != 0)


# Names.


@pytest.mark.parametrize("effect", EVERY, ids=each)
def test_an_effect_comes_back_from_its_name_and_its_values(effect: Effect) -> None:
    q = np.arange(1.0, len(effect.coefficients) + 1)
    shape = {n: v + 17.0 for n, (v, _) in effect.shape.items()}
    values = {c.name: float(v) for c, v in zip(effect.coefficients, q, strict=True)}
    again, found = effect_of(effect.name, values | shape)
    assert again == (effect.shaped(shape) if shape else effect)
    assert np.array_equal(found, q)


def test_coefficients_that_are_not_given_are_zero() -> None:
    effect, q = effect_of("second_order_nonlinearity", {"y": 2e-4})
    assert effect == effect_named("second_order_nonlinearity")
    assert q.tolist() == [0.0, 2e-4, 0.0]
    effect, q = effect_of("warm_up", {"z": 1e-4, "time_constant": 90.0})
    assert effect == WarmUp(90.0)
    assert q.tolist() == [0.0, 0.0, 1e-4]
    # The smallest form that has them all.
    effect, q = effect_of("bias_drift", {"x": 1e-6, "z2": 1e-9})
    assert effect == BiasDrift(2)
    assert q.tolist() == [1e-6, 0, 0, 0, 0, 1e-9]
    assert effect_of("temperature_lag", {"x": 1e-4, "time_constant": 90.0})[0] == TemperatureLag(90.0)
    effect, q = effect_of("hysteresis", {"sign_z": 1e-4})
    assert effect == Hysteresis("reversal")


@pytest.mark.parametrize(
    ("name", "values", "blamed"),
    [
        ("second_order_nonlinearity", {"w": 1.0}, r"second_order_nonlinearity\.w"),
        ("hysteresis", {"x": 1.0, "sign_y": 1.0}, r"hysteresis\.x, sign_y"),
        ("bias_drift", {"x": 1.0, "x4": 1.0}, r"bias_drift\.x4"),
        ("witchcraft", {"x": 1.0}, "witchcraft"),
        ("channel_bias:", {"x": 1.0}, "channel_bias:"),
    ],
)
def test_a_name_or_a_coefficient_that_nobody_knows_is_a_key_error_that_names_it(
    name: str, values: dict[str, float], blamed: str
) -> None:
    with pytest.raises(KeyError, match=blamed):
        effect_of(name, values)


@pytest.mark.parametrize(
    ("name", "values", "blamed"),
    [
        ("warm_up", {"time_constant": 90.0, "w": 1.0}, r"warm_up\.w"),
        ("bias_drift", {"x2": 1.0, "x4": 1.0}, r"bias_drift\.x4"),
    ],
)
def test_a_coefficient_that_nobody_knows_is_named_beside_a_shape_or_a_higher_form_too(
    name: str, values: dict[str, float], blamed: str
) -> None:
    with pytest.raises(KeyError, match=blamed):
        effect_of(name, values)


def test_every_logged_channel_gets_a_bias_and_a_scale_factor_effect_of_its_own() -> None:
    there = [*DERIVED, "temp_c", rate_of("temp_c"), "field_x", rate_of("field_x"), "supply_v", rate_of("supply_v")]
    effects = catalogue_for(there)
    assert effects[: len(CATALOGUE)] == CATALOGUE
    assert [e.name for e in effects[len(CATALOGUE) + len(plugins()[0]) :]] == [
        "channel_bias:field_x",
        "channel_scale_factor:field_x",
        "channel_bias:supply_v",
        "channel_scale_factor:supply_v",
    ]
    assert all(effect_named(e.name) == e for e in effects)
    assert catalogue_for(DERIVED) == (*CATALOGUE, *plugins()[0])


@pytest.mark.parametrize(
    "channel",
    ["flow.rate", "temp_c.rate", "temp_c.lag:33", TIME, DURATION, "before_x", f"{DURATION}.logged", "x.logged"],
)
def test_a_logged_channel_may_have_any_name(channel: str) -> None:
    condition = covariate_of(channel)
    assert not is_derived(condition)
    assert channel_of(condition) == channel
    effects = catalogue_for([*DERIVED, rate_of("flow"), rate_of("temp_c"), condition, rate_of(condition)])
    assert [e.name for e in effects[-2:]] == [f"channel_bias:{channel}", f"channel_scale_factor:{channel}"]
    for effect in effects[-2:]:
        assert effect.needs == (condition,)
        assert effect_named(effect.name) == effect


def test_no_two_logged_channels_are_one_condition() -> None:
    channels = [
        TIME,
        "supply_v",
        "supply_v.logged",
        *(f"{n}{'.logged' * k}" for n in (DURATION, "a.rate") for k in range(4)),
    ]
    assert len({covariate_of(c) for c in channels}) == len(channels)
    # Names that collide with nothing stay as documents have them.
    assert [covariate_of(c) for c in ("temp_c", "supply_v", "supply_v.logged")] == [
        "temp_c",
        "supply_v",
        "supply_v.logged",
    ]


def test_every_effect_of_the_catalogue_lies_in_a_family() -> None:
    """A file of the room is a family, or what all families share."""
    files = {m.name for m in pkgutil.iter_modules(triaxcal.effects.__path__)}
    shared = {"contract", "catalogue", "odds", "wrapped", "plugins"}
    families = {type(e).__module__.rpartition(".")[2] for e in (*KNOWN, *CHANNEL_EFFECTS)}
    assert families <= files - shared
    # The effects of several recordings, and the empirical term, are not searched for in a recording by itself.
    assert files - shared - families == {"runs", "empirical"}


def test_the_conditions_that_need_no_channel_are_those_of_the_contract() -> None:
    assert set(DERIVED) == {TIME, SINCE_START, DURATION, *BEFORE, *CHANGE, *SCATTER, RUN}
    for effect in CATALOGUE:
        assert all(n in {*DERIVED, "temp_c", "temp_c.rate"} or lag_in(n) for n in effect.needs)


# Effects of other packages.

GOOD = '''
from dataclasses import dataclass
import numpy as np
from triaxcal.effects import Coefficient, Effect

@dataclass(frozen=True)
class Radiation(Effect):
    """e_x = q dose."""
    name: str = "radiation"
    coefficients: tuple = (Coefficient("x", "g/Gy"),)
    needs: tuple = ("dose_gy",)
    remedy: str = "Shield it."

    def basis(self, s, conditions):
        out = np.zeros((len(s), 3, 1))
        out[:, 0, 0] = conditions["dose_gy"]
        return out

    def slope(self, s, conditions):
        return np.zeros((len(s), 3, 3, 1))

made = Radiation(remedy="Shield it well.")

class Flat(Radiation):
    def basis(self, s, conditions):
        return np.zeros((len(s), 3))

class Endless(Radiation):
    def basis(self, s, conditions):
        return np.full((len(s), 3, 1), np.nan)

class Nameless(Radiation):
    def __init__(self):
        super().__init__(name="")


class Explodes(Radiation):
    def __init__(self):
        raise OSError("no such table")
'''
POINTS = """[triaxcal.effects]
a_missing = dosimetry_effects:NotThere
b_radiation = dosimetry_effects:Radiation
c_no_module = no_such_module_at_all:Effect
d_flat = dosimetry_effects:Flat
e_endless = dosimetry_effects:Endless
f_nameless = dosimetry_effects:Nameless
g_explodes = dosimetry_effects:Explodes
"""


Install = Callable[[str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs a distribution by its code and its entry points."""

    def install(code: str, points: str) -> None:
        info = tmp_path / "dosimetry_effects-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dosimetry-effects\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(points)
        (tmp_path / "dosimetry_effects.py").write_text(code)
        monkeypatch.delitem(sys.modules, "dosimetry_effects", raising=False)
        monkeypatch.syspath_prepend(tmp_path)
        plugins.cache_clear()

    yield install
    plugins.cache_clear()


@pytest.fixture
def installed(install: Install) -> None:
    """A distribution with one effect that works among six that do not."""
    install(GOOD, POINTS)


@pytest.mark.usefixtures("installed")
def test_an_effect_of_another_package_is_in_the_catalogue_by_its_entry_point() -> None:
    found, _ = plugins()
    assert [e.name for e in found] == ["radiation"]
    (radiation,) = found
    assert radiation in catalogue_for(["t_s"])
    assert effect_named("radiation") is radiation
    again, q = effect_of("radiation", {"x": 3e-6})
    assert (again, q.tolist()) == (radiation, [3e-6])
    # Its channel may be any other effect's too.
    names = [e.name for e in catalogue_for(["dose_gy"])]
    assert names[-3:] == ["radiation", "channel_bias:dose_gy", "channel_scale_factor:dose_gy"]


@pytest.mark.slow
@pytest.mark.usefixtures("installed")
def test_an_effect_of_another_package_is_searched_for(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    (radiation,) = plugins()[0]
    rng = np.random.default_rng(0)
    dose = rng.uniform(0, 100, 26)
    sensor = replace(paper_unit, effects=((radiation, np.array([8e-6])),))
    poses = noisy_poses(sensor, twenty_six, 1.5e-5, rng, channels={"dose_gy": dose})
    (finding,) = diagnose(poses, signs=(-1, -1, -1)).findings
    # It is the bias of one axis by that channel too, and the poses cannot tell by what name to call it.
    assert "radiation" in (finding.effect, *finding.alternatives)


@pytest.mark.usefixtures("installed")
def test_a_broken_effect_gives_its_reason_and_leaves_the_others_alone() -> None:
    found, broken = plugins()
    assert len(found) == 1
    reasons = dict(broken)
    assert list(reasons) == ["a_missing", "c_no_module", "d_flat", "e_endless", "f_nameless", "g_explodes"]
    assert "NotThere" in reasons["a_missing"]
    assert reasons["c_no_module"].startswith("ModuleNotFoundError")
    assert "(4, 3, 1)" in reasons["d_flat"]
    assert "finite" in reasons["e_endless"]
    assert "name" in reasons["f_nameless"]
    assert reasons["g_explodes"] == "OSError: no such table"


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ("name='temperature_bias'", "the name temperature_bias is taken by triaxcal"),
        ("name='run_bias'", "the name run_bias is taken by triaxcal"),
        ("name='run_scale_factor'", "the name run_scale_factor is taken by triaxcal"),
        ("name='compression'", "the name compression is taken by triaxcal"),
        ("name='empirical'", "the name empirical is taken by triaxcal"),
        ("name='linear'", "the name linear is taken by triaxcal"),
        ("name='channel_bias:dose_gy'", "the name channel_bias:dose_gy is that of an effect of a channel"),
        ("name='channel_scale_factor:x'", "the name channel_scale_factor:x is that of an effect of a channel"),
        ("name='fine', needs='dose_gy'", "needs: expected a tuple of names, not 'dose_gy'"),
        ("name='fine', needs=('dose_gy', 3)", "needs: expected a tuple of names"),
        ("name='radiation'", "the name radiation is taken by another effect of another package"),
        ("name='fine', coefficients=(Coefficient('x', 'g'),) * 2", "names of their own, not x, x"),
    ],
)
def test_an_effect_is_refused_by_what_it_says_of_itself(changed: str, reason: str, install: Install) -> None:
    points = "[triaxcal.effects]\na_radiation = dosimetry_effects:Radiation\nb_other = dosimetry_effects:other\n"
    install(f"{GOOD}\nother = Radiation({changed})\n", points)
    found, ((name, why),) = plugins()
    assert [e.name for e in found] == ["radiation"]
    assert name == "b_other"
    assert reason in why


def test_an_effect_that_has_no_value_for_a_unit_in_use_is_refused(install: Install) -> None:
    code = GOOD.replace('needs: tuple = ("dose_gy",)', 'needs: tuple = ("since_start_s",)')
    install(code.replace("dose_gy", "since_start_s"), "[triaxcal.effects]\na = dosimetry_effects:Radiation\n")
    assert "finite" in dict(plugins()[1])["a"]


FAILING = {
    "raises": ("basis", 'raise RuntimeError("no such table")', "RuntimeError: no such table"),
    "flat": ("basis", "return np.zeros((len(s), 3))", "expected finite numbers of shape (26, 3, 1), not (26, 3)"),
    "endless": ("basis", "return np.full((len(s), 3, 1), np.nan)", "not infinite ones or none"),
    "huge": ("basis", "return np.full((len(s), 3, 1), 1e200)", "not infinite ones or none"),
    "text": ("basis", "return [['a']]", "ValueError"),
    "slope": ("slope", "raise KeyError('dose')", "KeyError: 'dose'"),
    "variants": ("variants", "raise ValueError('none')", "ValueError: none"),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", FAILING)
def test_an_effect_that_fails_on_real_poses_is_left_out_with_its_reason(
    kind: str, install: Install, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    method, does, reason = FAILING[kind]
    arguments = "self, conditions" if method == "variants" else "self, s, conditions"
    install(
        f"""{GOOD}
class Failing(Radiation):
    def {method}({arguments}):
        if len(conditions["dose_gy"]) > 10:
            {does}
        return super().{method}({arguments.removeprefix("self, ")})
""",
        "[triaxcal.effects]\na = dosimetry_effects:Failing\n",
    )
    ((radiation,), broken) = plugins()
    assert not broken
    rng = np.random.default_rng(0)
    dose = rng.uniform(0, 100, 26)
    sensor = replace(paper_unit, effects=((ChannelBias("dose_gy"), np.array([8e-6, 0.0, 0.0])),))
    poses = noisy_poses(sensor, twenty_six, 1.5e-5, rng, channels={"dose_gy": dose})
    loop = diagnose(poses, signs=(-1, -1, -1))
    assert [f.effect for f in loop.findings] == ["channel_bias:dose_gy"]
    ((name, why),) = loop.faulty.items()
    assert name == "radiation"
    assert reason in why
    said = list(notes(loop, ErrorUnit.of("g", 1.0)))
    assert f"the effect radiation of the package dosimetry-effects cannot be used: {why}" in said
    # Who asks for it all the same gets one line that names it.
    asked = partial(fit, poses, signs=(-1, -1, -1), effects=[radiation])
    if method == "variants":
        asked = partial(radiation.variants, loop.posterior.evidence.rows.problem.covariates)
    with pytest.raises(InvalidData, match="the effect radiation of the package dosimetry-effects: "):
        asked()


def test_no_plugin_is_there_where_none_is_installed() -> None:
    plugins.cache_clear()
    assert not [e for e in plugins()[0] if e.name == "radiation"]
