"""What the residuals go with: the patterns that they show beyond chance, and what would tell more of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, PoseResult
from triaxcal.conditions import channels_of, with_scale
from triaxcal.distributions import f_sf
from triaxcal.effects.contract import BEFORE, CHANGE, HELD, RUN, SCATTER, SINCE_START, TIME, channel_of, rate_of
from triaxcal.figures import plain
from triaxcal.planning.directions import linear_design
from triaxcal.search.apart import FROM_OTHER_SIDES, UNSHAKEN

LEAD = 0.01
"""Probability of a pattern as clear as this by chance, the choice among all patterns allowed for, up to which it is a
lead."""
LEADS_MOST = 3
NEAR_1 = 0.05
"""A reference that is no further from one is a gravity, in g."""
PERIODS = 24
NAMES = {TIME: "the time", RUN: "the recording", HELD: "how long the pose was held"}
NAMES |= {b: f"the pose before, along {b[-1]}" for b in BEFORE}
NAMES |= {c: f"the change since the pose before, along {c[-1]}" for c in CHANGE}
NAMES |= {s: f"the scatter of axis {s[-1]}" for s in SCATTER}

LOG = "log what else changes (temperature, supply, what stands nearby)"
SWINGS = "log what may go up and down about every {} s (supply, heating, what runs nearby)"
CONVERTER = (
    "test the converter by itself, with a slow ramp or a sine at its input, or tilt AXIS in steps of much less than "
    "{} UNIT: an integral nonlinearity makes such a wave"
)
AGAIN = f"take some directions again at another azimuth and at another time, and {LOG}"
"""Where nothing points anywhere: the unit's own error comes back, the room's goes with the azimuth."""
TOWARDS = {TIME: f"record again, and {LOG}", RUN: f"record again, and {LOG}"}
TOWARDS |= {HELD: "hold each pose for as long as any other, or some directions for both long and short"}
TOWARDS |= dict.fromkeys((*BEFORE, *CHANGE), FROM_OTHER_SIDES) | dict.fromkeys(SCATTER, UNSHAKEN)


@dataclass(frozen=True)
class Lead:
    """A hint at what is left, and what to do to learn more: empty where it points nowhere."""

    text: str
    towards: str = ""


@dataclass(frozen=True)
class _Pattern:
    """A pattern of the residuals: its columns (n,q) in g, and how to say it. Of one family the clearest is told."""

    columns: Floats
    text: str
    family: str
    towards: str = AGAIN


def clear_patterns(after: Calibration, used: Sequence[PoseResult]) -> list[Lead]:
    """The patterns that the residuals of the poses ``used`` show beyond chance, the clearest first."""
    patterns = _patterns(after, used)
    error = np.array([p.error_g for p in used])
    y = np.array([p.residual_g for p in used]) / error
    model, _ = np.linalg.qr(_fitted(after, used) / error[:, None])
    free = len(y) - model.shape[1] - sum(len(effect.shape) for effect, _ in after.sensor.effects)
    y = y - model @ (model.T @ y)
    total = float(y @ y)
    found: dict[str, tuple[float, Lead]] = {}
    for pattern in patterns:
        columns = pattern.columns / error[:, None]
        size = np.linalg.norm(columns, axis=0)
        columns = columns[:, size > 0] / size[size > 0]
        left, singular, _ = np.linalg.svd(columns - model @ (model.T @ columns), full_matrices=False)
        basis = left[:, singular > 0.05]
        q, rest = basis.shape[1], free - basis.shape[1]
        if not q or rest < 2:
            continue
        share = float(np.sum((basis.T @ y) ** 2)) / total
        p = float(f_sf(share / q / max((1 - share) / rest, 1e-12), q, rest)) * len(patterns)
        if p < LEAD and (pattern.family not in found or p < found[pattern.family][0]):
            found[pattern.family] = (p, Lead(f"{share:.0%} of it goes with {pattern.text}", pattern.towards))
    return [lead for _, lead in sorted(found.values(), key=lambda f: (f[0], f[1].text))[:LEADS_MOST]]


def _fitted(after: Calibration, used: Sequence[PoseResult]) -> Floats:
    """(n,9+p) what the model can make of the magnitude: the nine parameters, and the effects in it."""
    direction = np.array([p.direction for p in used])
    poses = [p.pose for p in used]
    held = after.conditions_of(poses)
    at = after.sensor.radius(np.array([p.mean for p in poses]), held)
    effects = [np.einsum("ni,nip->np", at.by_v, effect.basis(at.s, held)) for effect, _ in after.sensor.effects]
    return np.concatenate([linear_design(direction, direction), *effects], axis=1)


def _patterns(after: Calibration, used: Sequence[PoseResult]) -> list[_Pattern]:
    direction = np.array([p.direction for p in used])
    poses = [p.pose for p in used]
    out = [
        _Pattern(_monomials(direction, 3), "an odd pattern on the sphere (degree 3, as of second order)", "odd"),
        _Pattern(_monomials(direction, 4), "an even pattern on the sphere (degree 4, as of third order)", "even"),
    ]
    sensor = after.sensor
    held = with_scale(channels_of(poses), poses, sensor.scale_factor, sensor.bias)
    for name, values in held.items():
        if name != SINCE_START and np.ptp(values) > 1e-9 * np.max(np.abs(values)):
            scaled = (values - values.mean()) / np.ptp(values)
            said, towards = _of_condition(name)
            out.append(_Pattern(scaled[:, None], said, name, towards))
            out.append(_Pattern(scaled[:, None] * direction, f"{said}, as a bias", name, towards))
    t, n = held[TIME], len(poses)
    slow, long, short = (0.8, max(n / 2.5, 2.0)), (0.8, 10.0), (2.0, 10.0)
    axes = [(axis, direction[:, i : i + 1]) for i, axis in enumerate("xyz")]
    swing = _Wave("time", "a swing in time with a period of {} s", SWINGS, digits=2)
    out += swing.along([(t, np.ones((n, 1)))], slow)
    out += swing.along([(t, direction)], slow, ", as a bias")
    unit = "g" if abs(after.reference - 1) < NEAR_1 else "of the reference"
    for axis, own in axes:
        out += swing.along([(t, own)], slow, f", as a bias of axis {axis}")
        out += _wave_of(f"axis {axis}", unit).along([(own[:, 0], own)], long)
    # Longer ones along all axes make any even pattern.
    out += _wave_of("every axis", unit).along([(own[:, 0], own) for _, own in axes], short)
    return out


def _of_condition(name: str) -> tuple[str, str]:
    """How it is said, and what would tell more of it."""
    if name in NAMES:
        return NAMES[name], TOWARDS[name]
    again, rate = "take the same poses again while", rate_of("")
    if name.endswith(rate):
        channel = channel_of(name.removesuffix(rate))
        return f"how fast {channel} changes", f"{again} {channel} changes at another rate"
    return channel_of(name), f"{again} {channel_of(name)} goes another way"


@dataclass(frozen=True)
class _Wave:
    """Sines of many lengths, each a pattern of one ``family``; the length goes into its ``text`` and ``towards``, with
    so many ``digits``."""

    family: str
    text: str
    towards: str
    digits: int

    def along(
        self, parts: Sequence[tuple[Floats, Floats]], cycles: tuple[float, float], how: str = ""
    ) -> list[_Pattern]:
        """From the first number of ``cycles`` in the whole range to the last, together of all ``parts``: along x (n,),
        of the sizes (n,m). Each counts as chosen among them."""
        whole = max(float(np.ptp(x)) for x, _ in parts) or 1.0
        out = []
        for count in np.geomspace(*cycles, PERIODS):
            angles = [(2 * np.pi * count * x[:, None] / whole, size) for x, size in parts]
            turns = [turn(angle) * size for angle, size in angles for turn in (np.sin, np.cos)]
            length = plain(whole / count, self.digits)
            text, towards = self.text.format(length) + how, self.towards.format(length)
            out.append(_Pattern(np.concatenate(turns, axis=1), text, self.family, towards))
        return out


def _wave_of(axis: str, unit: str) -> _Wave:
    text = f"a wave along the output of {axis}, {{}} {unit} long"
    tilted = "an axis" if axis == "every axis" else axis
    return _Wave("wave", text, CONVERTER.replace("AXIS", tilted).replace("UNIT", unit), digits=2)


def _monomials(a: Floats, degree: int) -> Floats:
    """(n,m) all products of ``degree`` components of directions (n,3): what is left of them beside the nine parameters
    are the harmonics of that degree."""
    powers = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array([a[:, 0] ** i * a[:, 1] ** j * a[:, 2] ** k for i, j, k in powers]).T
