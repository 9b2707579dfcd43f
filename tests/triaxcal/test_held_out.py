"""Errors in poses of another recording: what they say of the names that one recording leaves open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.test_loop import MINUS, poses_of
from triaxcal.effects import effect_named
from triaxcal.held_out import better_of, held_out, magnitude_errors
from triaxcal.loop import Loop, diagnose
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor

NONLINEAR = ("cross_coupling", "third_order_nonlinearity")
SECOND = {"second_order_nonlinearity": [4e-4, -5e-4, 6e-4]}


def checked(unit: Sensor, fourteen: np.ndarray, seed: int) -> tuple[Loop, list[Pose]]:
    """Fourteen poses, which leave open what it is, and a check recording of forty in all directions."""
    rng = np.random.default_rng(seed)
    v = rng.standard_normal((40, 3))
    check = poses_of(unit, v / np.linalg.norm(v, axis=1, keepdims=True), rng)
    return diagnose(poses_of(unit, fourteen, rng), signs=MINUS, check=check), check


@pytest.fixture(scope="module")
def recordings(with_effects: Callable[..., Sensor], fourteen: np.ndarray) -> list[tuple[Loop, list[Pose]]]:
    return [checked(with_effects(**SECOND), fourteen, seed) for seed in range(6)]


def test_a_check_recording_speaks_for_the_truth_among_names_that_do_as_well(
    recordings: list[tuple[Loop, list[Pose]]],
) -> None:
    """Or for cross coupling, which contains the second order."""
    (name,) = SECOND
    mistaken = 0
    for loop, _ in recordings:
        (finding,) = loop.findings
        held = loop.held_out
        assert held is not None
        assert held.instead.keys() <= set(finding.alternatives)
        others = {**held.instead, finding.effect: held.after_rms_g}
        assert others[name] < 1.1 * min(others.values())
        speaks = [line for line in loop.advice if line.startswith("the check recording speaks for ")]
        if finding.effect == name:
            assert (held.better, speaks) == ((), [])
        else:
            mistaken += 1
            assert name in held.better
            assert set(held.better) <= {name, "cross_coupling"}
            (line,) = speaks
            assert f"{name} ({1e6 * held.instead[name]:.3g} µg)" in line
    assert 1 <= mistaken < len(recordings)


def test_where_no_effect_does_better_than_the_linear_model_in_the_check_recording_advice_says_so(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A swing of the bias that passed for an effect of the unit; the check recording has none."""
    rng = np.random.default_rng(0)
    swing = 3e-4 * np.sin(2 * np.pi * np.arange(26) / 9)[:, None] * paper_unit.scale_factor
    poses = [replace(p, mean=p.mean + e) for p, e in zip(poses_of(paper_unit, twenty_six, rng), swing, strict=True)]
    check = poses_of(paper_unit, twenty_six, rng)
    before = fit(poses, signs=MINUS, aside=())
    wrong, other = (fit(poses, signs=MINUS, aside=(), effects=[effect_named(n)]) for n in NONLINEAR)
    held = held_out(before, wrong, check, {NONLINEAR[1]: other})
    assert held.after_rms_g > 1.2 * held.before_rms_g
    (line,) = better_of(held)
    assert line.startswith("in the check recording no effect does better than the linear model (")
    right = held_out(wrong, before, check, {})
    assert better_of(right) == []


def test_the_error_of_an_alternative_is_that_of_its_own_fit(
    recordings: list[tuple[Loop, list[Pose]]],
) -> None:
    loop, check = recordings[0]
    assert loop.held_out
    assert loop.held_out.instead
    for name, rms in loop.held_out.instead.items():
        effects = loop.findings[0].instead[name]
        again = diagnose([p.pose for p in loop.before.poses], signs=MINUS, check=check, catalogue=list(effects))
        if [e for e, _ in again.after.sensor.effects] == list(effects):
            assert again.held_out
            assert again.held_out.after_rms_g == pytest.approx(rms, rel=1e-6)


def test_an_alternative_whose_channel_the_check_recording_lacks_is_passed_over(
    recordings: list[tuple[Loop, list[Pose]]],
) -> None:
    loop, check = recordings[0]
    assert loop.held_out
    thermal = {name for name in loop.held_out.instead if name.startswith("temperature_")}
    assert thermal
    blind = [replace(p, channels={}, rates={}) for p in check]
    poses = [p.pose for p in loop.before.poses]
    held = diagnose(poses, signs=MINUS, check=blind).held_out
    assert held
    assert held.instead.keys() == loop.held_out.instead.keys() - thermal
    c = loop.after
    miss, error = magnitude_errors(c.sensor, blind, channel_reference=c.channel_reference, reference=c.reference)
    assert held.after_rms_g == pytest.approx(np.sqrt(np.mean(miss**2)))
    assert held.noise_floor_g == pytest.approx(np.sqrt(np.mean(error**2)))
