"""The contract of an effect.

An effect adds ``e`` to the reading: ``u = K (s + b + e(s, covariates))`` with
``s = R a`` the specific force along each sensitive axis, in g. ``e`` is linear
in the effect's coefficients: ``e = basis @ coefficients``. Nonlinear parameters (a
time constant, the moment of a step) are the effect's shape: the search tries
`Effect.variants` of it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.number_format import plain

TIME = "t_s"
"""The name of the covariate time, in seconds."""
SINCE_START = "since_start_s"
"""Seconds since the first sample of the recording; infinite for a unit in use,
which started long ago."""
DURATION = "held_s"
"""Duration of the pose in seconds; zero for a single reading."""
BEFORE = ("before_x", "before_y", "before_z")
"""The specific force along each sensitive axis in the previous pose, in g. The first
pose has its own."""
CHANGE = ("change_x", "change_y", "change_z")
"""The change along each sensitive axis since the previous pose, in g; zero in the
first pose."""
SCATTER = ("scatter_x", "scatter_y", "scatter_z")
"""The variance of the readings inside the pose along each axis, in g²."""
RUN = "run_index"
"""Index of the recording among several of the unit, from 0; infinite for a unit in
use, which is in none of them."""
CLOCKS = (TIME, SINCE_START, DURATION)
"""Covariates that follow from the times of the poses."""
DERIVED = (*CLOCKS, *BEFORE, *CHANGE, *SCATTER, RUN)
"""Covariates that need no logged channel. Rates of logged channels are derived, too."""
LOGGED = ".logged"
LAGS_S = (10, 15, 22, 33, 47, 68, 100, 150, 220, 330, 470, 680, 1000, 1500, 2200, 3300, 4700, 6800, 10000)
"""Time constants for which the poses have the lag of a channel: preferred numbers
(IEC 60063, E6)."""
IN_ONE_RUN = "{by}, in recording {n} alone"
_LAG = re.compile(r"(.+)\.lag:([1-9]\d{0,5})")


def rate_of(channel: str) -> str:
    """The name of the covariate that is a channel's rate of change, per second."""
    return f"{channel}.rate"


def lag_of(channel: str, constant_s: int) -> str:
    """The name of the covariate for a channel after a first-order lag of this time
    constant, less the channel itself. It is zero while the channel is constant, and
    −τ times the channel's rate after a long constant rate."""
    return f"{channel}.lag:{constant_s}"


def lag_in(covariate: str) -> tuple[str, int] | None:
    """The channel and the time constant of `lag_of`; None for any other covariate."""
    found = _LAG.fullmatch(covariate)
    return (found[1], int(found[2])) if found else None


def is_derived(covariate: str) -> bool:
    """Whether a covariate follows from the poses and needs no channel of its name."""
    return covariate in DERIVED or covariate.endswith(rate_of("")) or lag_in(covariate) is not None


def covariate_of(channel: str) -> str:
    """The name of the covariate for a logged channel: the channel's own name, with
    `LOGGED` if a derived covariate already has that name."""
    bare = channel
    while bare.endswith(LOGGED):
        bare = bare.removesuffix(LOGGED)
    return channel + LOGGED if is_derived(bare) else channel


condition_of = covariate_of  # the older name, which effects of other packages import


def channel_of(covariate: str) -> str:
    """The logged channel of a covariate: the inverse of `covariate_of`."""
    bare = covariate.removesuffix(LOGGED)
    return bare if covariate_of(bare) == covariate else covariate


@dataclass(frozen=True)
class Coefficient:
    """A coefficient of an effect. ``unit`` has g for the unit of the reference vector,
    also if that is another. Coefficients of one ``part`` belong together: an effect
    may act in one part alone, for example on one axis."""

    name: str
    unit: str
    part: str = ""


@dataclass(frozen=True)
class Meaning:
    """The description of an effect, in words and as a formula for the e of one axis in
    u = K (s + b + e).

    ``clause`` is a clause of a sentence, ``because`` names the usual cause.
    ``formula`` gives e by the coefficients and by letters that ``symbols`` explains;
    s is the specific force along the axis. ``factors`` has the factor of each
    coefficient, by the coefficient's name with ``*`` in place of the axis, and the
    letters of the shape by their names. ``reference`` is a letter of the formula and
    the covariate whose reference it is. ``in_run`` gives the factor of a coefficient
    in recording ``{n}``, with ``{by}`` for the factor in a single recording. In all of
    them ``{c}`` stands for the channel, for effects of any channel.
    """

    clause: str
    because: str
    formula: str
    factors: Mapping[str, str]
    symbols: str = ""
    reference: tuple[str, str] | None = None
    in_run: str = IN_ONE_RUN


T_REFERENCE = ("T₀", "temp_c")


class Effect(Protocol):
    """A departure of a sensor from the linear model.

    ``needs`` names the covariates on which it depends. Each is given as the deviation
    (n,) from its reference.
    """

    @property
    def name(self) -> str: ...
    @property
    def coefficients(self) -> tuple[Coefficient, ...]: ...
    @property
    def needs(self) -> tuple[str, ...]: ...
    @property
    def remedy(self) -> str: ...

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """(n,3,p): contribution of a unit of each coefficient to each axis, in g."""
        ...

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """(n,3,3,p): derivative of `basis` by s, as [n, axis, by axis,
        coefficient]."""
        ...

    def advice(self, largest: float, floor: float) -> str:
        """The remedy, with numbers if possible. ``largest`` is the largest coefficient;
        contributions up to ``floor``, in the same unit without the covariates', do
        not matter. The default is `remedy`."""
        return self.remedy

    @property
    def meaning(self) -> Meaning | None:
        """The description for reports and the reference. The default is None: reports
        show the name and the coefficients alone."""
        return None

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        """The nonlinear parameters: name → (value, unit). The default is none."""
        return {}

    @property
    def absent(self) -> str:
        """The conditions under which the effect adds nothing, in words, unless they
        follow from its ``needs``. The default is empty."""
        return ""

    @property
    def lasting(self) -> bool:
        """Whether its change outlasts a restart of the unit. The default is no."""
        return False

    @property
    def forms(self) -> tuple[Effect, ...]:
        """The forms of the effect, which differ in their coefficients. The default is
        one."""
        return (self,)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """The variants for the search under these covariates. The default is the
        forms."""
        return self.forms

    def shaped(self, values: Mapping[str, float]) -> Self:
        """The same effect with another `shape`."""
        return self


def per_axis(values: Floats) -> Floats:
    """(n,3) → (n,3,3): one coefficient per axis, which acts on its own axis alone."""
    out = np.zeros((*values.shape, 3))
    out[:, range(3), range(3)] = values
    return out


def per_axis_slope(values: Floats) -> Floats:
    """(n,3) → (n,3,3,3): the same for a derivative that is diagonal in the axes."""
    out = np.zeros((*values.shape, 3, 3))
    out[:, range(3), range(3), range(3)] = values
    return out


def on_each_axis(covariate: Floats) -> Floats:
    """(n,) → (n,3,3): a covariate that acts on each axis by its own coefficient,
    independent of the specific force."""
    return per_axis(np.repeat(covariate[:, None], 3, axis=1))


def signs(values: Floats, s: Floats, certain: float) -> Floats:
    """(n,3) signs of values (n,3) at the specific force s (n,3): ±1 from ``certain``
    on, a straight line through zero below. ``certain`` is a share of the order of
    magnitude of the specific force."""
    # A power of ten is the same in every pose. The reference may be 1 g, 50 µT or
    # 5e-5 T.
    length = np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-100)
    return np.asarray(np.clip(values / (certain * 10.0 ** np.rint(np.log10(length))), -1.0, 1.0))


def no_slope(s: Floats, coefficients: int = 3) -> Floats:
    """(n,3,3,p) of an effect that does not depend on the specific force."""
    return np.zeros((len(s), 3, 3, coefficients))


def xyz(unit: str, name: str = "{}") -> tuple[Coefficient, ...]:
    """A coefficient for each axis."""
    return tuple(Coefficient(name.format(axis), unit, axis) for axis in "xyz")


def span_of(t_s: Floats) -> tuple[float, float]:
    """The shortest time constant that a few of the poses at times (n,) show, and the
    duration of all, in seconds."""
    duration = float(np.ptp(t_s))
    return 1.5 * duration / max(len(t_s) - 1, 1), duration


def steady_within(remedy: str, largest: float, floor: float, unit: str) -> str:
    """The remedy with the permitted change of the covariate, in ``unit``, for an effect
    in proportion to it."""
    if not 0 < floor < np.inf or not largest:
        return remedy
    return f"{remedy} Within ±{plain(floor / abs(largest), 2)} {unit} what it does is below the noise floor."


def reshaped(effect: Effect, name: str, value: float) -> Effect:
    """The effect with another value of one nonlinear parameter."""
    return effect.shaped({n: v for n, (v, _) in effect.shape.items()} | {name: value})
