"""What the budget owes to other models that explain the poses as well: nothing tells which of all is the right one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration
from triaxcal.conditions import at_reference
from triaxcal.effects.contract import SINCE_START
from triaxcal.errors import InvalidData, Refused
from triaxcal.uncertainty.basis import CompetingModels, ModelsToldApart
from triaxcal.uncertainty.components import Component
from triaxcal.uncertainty.linearised import SPHERE, Linearised

NOTHING = 1e-9
"""Share of a standard uncertainty that is a processor's rounding."""


def choice(calibration: Calibration, linearised: Linearised) -> list[Component]:
    """The rms of what all models, this one among them, make of the nine parameters and of the magnitude, about this
    one: each as likely as the others, whatever its fit says of itself.

    Models are compared as they are in the middle of the recording, which all of them have seen: of what a unit does
    long after its start a drift says nothing, and a warm-up much. A rival that has no value there has no part in it.
    """
    here = _middle(calibration, calibration)
    nine = _nine(calibration, here, linearised)
    u = calibration.sensor.output(linearised.up, here)
    names: list[str] = []
    shifts: list[Floats] = []
    errors: list[Floats] = []
    for name, rival in calibration.rivals.items():
        there = _middle(rival, calibration)
        try:
            shift = _nine(rival, there, linearised) - nine
            error = _length(rival, u, there) - _length(calibration, u, here)
        except (Refused, InvalidData):
            continue
        if np.isfinite(shift).all() and np.isfinite(error).all():
            names.append(name)
            shifts.append(shift)
            errors.append(error)
    count = 1 + len(shifts)
    parameters = np.zeros(len(calibration.parameters))
    parameters[:9] = np.sqrt(sum((shift**2 for shift in shifts), start=np.zeros(9)) / count)
    parameters[parameters < NOTHING * calibration.standard_errors] = 0.0
    if not parameters.any():
        return []
    magnitude = float(np.sqrt(sum(float(error @ error) for error in errors) / (SPHERE * count)))
    basis = CompetingModels(tuple(names))
    return [Component("choice_of_effect", "B", np.inf, parameters, magnitude, basis, ModelsToldApart())]


def _middle(model: Calibration, of: Calibration) -> dict[str, Floats]:
    """The conditions of a model, at each point of the sphere, in the middle of the recording that another is of."""
    held = at_reference(model.channel_reference, SPHERE)
    if SINCE_START in held:
        middle_s = float(np.mean([p.pose.t_s for p in of.poses]))
        held[SINCE_START] = np.full(SPHERE, middle_s - model.channel_reference[SINCE_START])
    for name in model.channel_reference.keys() & of.channel_reference.keys() - {SINCE_START}:
        held[name] = held[name] + of.channel_reference[name] - model.channel_reference[name]
    return held


def _length(model: Calibration, u: Floats, held: Mapping[str, Floats]) -> Floats:
    length, _ = model.sensor.magnitude(u, held)
    return length


def _nine(model: Calibration, held: Mapping[str, Floats], linearised: Linearised) -> Floats:
    """Scale factor, misalignment and bias (9,) with what the effects' conditions make of them, so far as |a| shows."""
    reference = at_reference(model.channel_reference, SPHERE)
    u = model.sensor.output(linearised.up, reference)
    moved = _length(model, u, held) - _length(model, u, reference)
    by_nine = linearised.by_parameters[:, :9]
    return np.asarray(model.values[:9] + np.linalg.lstsq(by_nine, moved, rcond=None)[0])
