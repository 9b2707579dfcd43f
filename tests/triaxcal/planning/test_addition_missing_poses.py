"""What a plan promises of an effect is what a fit with that effect then gives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import closed, directions
from triaxcal.model.sensor import Sensor
from triaxcal.planning.addition import MissingPoses, missing_poses
from triaxcal.planning.design import in_plan
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

ERROR_G = 1e-5
RECORDINGS, RUNS = 5, 60
"""Of chance: one recording in twenty shows more than noise, so the middle of several is asked; the scatter of three
coefficients or more in so many runs is known to 5 %."""


class Unit:
    """A unit with one effect of a size, in poses that are a degree off a plan's."""

    def __init__(self, name: str, size: float, count: int, *, comes_back_g: float = 0.0) -> None:
        self.effect, self.rng = effect_named(name), np.random.default_rng(1)
        ups = np.array([v for _, v in closed(directions(count))])
        ups += 0.02 * self.rng.standard_normal(ups.shape)
        self.ups = ups / np.linalg.norm(ups, axis=1, keepdims=True)
        self.temperature = 25 + 10 * np.cos(1.3 * np.arange(len(ups)))
        own = ((self.effect, size * np.ones(len(self.effect.coefficients))),)
        self.sensor = Sensor(
            np.array([2, 2.1, 1.9]), np.array([0.01, -0.005, 0.002]), np.array([0.01, 0.02, -0.01]), own
        )
        self.whole_g = float(np.hypot(ERROR_G, comes_back_g))

    def poses(self, added: MissingPoses | None = None) -> list[Pose]:
        """Of a recording, and of that with the poses which a plan wants of it. The noise known is `ERROR_G` alone."""
        more = added.wanted if added else []
        low, high = self.temperature.min(), self.temperature.max()
        levels = [(low + high) / 2 + (high - low) / 2 * a.levels.get("temp_c", 0.0) for a in more]
        poses = noisy_poses(
            self.sensor,
            np.concatenate([self.ups, *(a.up[None] for a in more)]),
            self.whole_g,
            self.rng,
            channels={"temp_c": np.append(self.temperature, levels)},
            channel_reference={"temp_c": 25.0, "t_s": 100.0},
        )
        return [replace(p, covariance=p.covariance * (ERROR_G / self.whole_g) ** 2) for p in poses]

    def planned(self) -> MissingPoses:
        return missing_poses(self.poses(), [in_plan(self.effect)], signs=(1, 1, 1), reference=1.0)

    def scatter_over(self, plan: MissingPoses) -> np.ndarray:
        """Of the coefficients, when the poses planned are taken and fitted with the effect, over those promised."""
        promised = (plan.wanted[-1].errors if plan.wanted else plan.now)[self.effect.name]
        found = [
            [v for v, _, _ in fit(self.poses(plan), effects=[self.effect]).coefficients_of(self.effect.name).values()]
            for _ in range(RUNS)
        ]
        return np.std(found, axis=0, ddof=1) / np.array(list(promised.values()), dtype=float)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "sizes"),
    [
        ("third_order_nonlinearity", 14, (0.0, 3e-4)),
        ("third_order_nonlinearity", 26, (3e-4,)),
        ("scale_factor_asymmetry", 26, (1e-3,)),
        ("cross_coupling", 14, (3e-4,)),
        ("temperature_bias", 14, (1e-4,)),
        ("bias_drift", 14, (1e-5,)),
    ],
)
def test_plan_for_within_a_tenth_of_what_simulation_gives(name: str, count: int, sizes: tuple[float, ...]) -> None:
    for size in sizes:
        unit = Unit(name, size, count)
        plans = [unit.planned() for _ in range(RECORDINGS)]
        noises = [plan.noise for plan in plans if plan.noise is not None]
        assert len(noises) == RECORDINGS
        ratio = float(np.sqrt(np.mean(unit.scatter_over(plans[0]) ** 2))) / float(np.median(noises))
        assert 0.9 < ratio < 1.1, size


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_what_poses_do_not_come_back_to_is_noise_and_the_effect_is_not(size: float) -> None:
    unit = Unit("third_order_nonlinearity", size, 26, comes_back_g=5e-5)
    noises = [plan.noise or 0.0 for plan in (unit.planned() for _ in range(20))]
    assert np.sqrt(np.mean(np.square(noises))) == pytest.approx(unit.whole_g, rel=0.15)


@pytest.mark.parametrize("name", ["warm_up", "bias_step"])
def test_effects_of_a_clock_are_promised_by_the_plans_clock(name: str) -> None:
    """Of coefficients in g, none is better known than a pose over the root of all of them."""
    unit = Unit(name, 1e-4, 26)
    plan = unit.planned()
    assert plan.noise == pytest.approx(ERROR_G, rel=0.1)
    assert all(v is not None and 1 / np.sqrt(len(unit.ups)) < v < 10 for v in plan.now[name].values())
