"""What every effect states about itself.

An effect adds ``e`` to the reading: ``u = K (s + b + e(s, covariates))`` with
``s = R a`` the specific force along each sensitive axis, in g. ``e`` is linear
in the effect's coefficients: ``e = basis @ coefficients``. What is not linear
(a time constant, the moment of a step) is the effect's shape: the search tries
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
"""The name under which time stands among the covariates, in seconds."""
SINCE_START = "since_start_s"
"""Seconds since the first sample of the recording; infinite for a unit in use,
which started long ago."""
DURATION = "held_s"
"""How long the unit was held still, in seconds; zero where a single reading is
asked for."""
BEFORE = ("before_x", "before_y", "before_z")
"""The specific force along each sensitive axis in the pose before, in g; in the
first pose, that of the pose itself."""
CHANGE = ("change_x", "change_y", "change_z")
"""The change along each sensitive axis since the pose before, in g; zero in the
first pose."""
SCATTER = ("scatter_x", "scatter_y", "scatter_z")
"""The variance of the readings inside the pose along each axis, in g²."""
RUN = "run_index"
"""Which of several recordings of the unit, from 0; infinite for a unit in use,
which is in none of them."""
CLOCKS = (TIME, SINCE_START, DURATION)
"""Covariates that follow from when and for how long the unit was held."""
DERIVED = (*CLOCKS, *BEFORE, *CHANGE, *SCATTER, RUN)
"""Covariates that no channel has to be logged for, beside the rates of those
that are."""
LOGGED = ".logged"
LAGS_S = (10, 15, 22, 33, 47, 68, 100, 150, 220, 330, 470, 680, 1000, 1500, 2200, 3300, 4700, 6800, 10000)
"""Time constants for which it is known how far a channel's lag is behind it:
preferred numbers (IEC 60063, E6)."""
IN_ONE_RUN = "{by}, in recording {n} alone"
_LAG = re.compile(r"(.+)\.lag:([1-9]\d{0,5})")


def rate_of(channel: str) -> str:
    """The name of the covariate that is a channel's rate of change, per second."""
    return f"{channel}.rate"


def lag_of(channel: str, constant_s: int) -> str:
    """The name of the covariate that is a channel after a first-order lag of
    this time constant, less the channel itself: zero while the channel stands
    still, −τ times its rate where that has long been the same."""
    return f"{channel}.lag:{constant_s}"


def lag_in(covariate: str) -> tuple[str, int] | None:
    """The channel and the time constant of `lag_of`; None of any other
    covariate."""
    found = _LAG.fullmatch(covariate)
    return (found[1], int(found[2])) if found else None


def is_derived(covariate: str) -> bool:
    """Whether a covariate follows from the poses, whatever is logged."""
    return covariate in DERIVED or covariate.endswith(rate_of("")) or lag_in(covariate) is not None


def covariate_of(channel: str) -> str:
    """The name of the covariate that a logged channel is: its own, with
    `LOGGED` where a derived covariate has that."""
    bare = channel
    while bare.endswith(LOGGED):
        bare = bare.removesuffix(LOGGED)
    return channel + LOGGED if is_derived(bare) else channel


condition_of = covariate_of  # effects of other packages import it by its older name


def channel_of(covariate: str) -> str:
    """The logged channel that a covariate is: the inverse of `covariate_of`."""
    bare = covariate.removesuffix(LOGGED)
    return bare if covariate_of(bare) == covariate else covariate


@dataclass(frozen=True)
class Coefficient:
    """``unit`` uses g for the unit of the reference vector, whatever that is.
    Coefficients of one ``part`` belong together: an effect may act in one part
    alone, on one axis say."""

    name: str
    unit: str
    part: str = ""


@dataclass(frozen=True)
class Meaning:
    """What an effect is, in words and as a formula for one axis, as u = K (s +
    b + e) has it.

    ``clause`` says it in a clause, ``because`` what usually makes it.
    ``formula`` gives e in the coefficients and in letters that ``symbols``
    explains; s is the specific force along the axis. ``factors`` are what a
    coefficient is multiplied by, by its name with ``*`` in place of the axis,
    and the letters of the shape by their names. ``reference`` is a letter of
    the formula and the condition whose reference it is. ``in_run`` says what a
    coefficient of recording ``{n}`` is multiplied by, where ``{by}`` is that of
    a single one. In all of them ``{c}`` is the channel of an effect that is one
    of any channel.
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
    """One way in which a sensor departs from the linear model.

    ``needs`` names the covariates it depends on; each is given as the deviation
    from its reference, (n,).
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
        """(n,3,p): what a unit of each coefficient adds to each axis, in g."""
        ...

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        """(n,3,3,p): derivative of `basis` by s, as [n, axis, by axis,
        coefficient]."""
        ...

    def advice(self, largest: float, floor: float) -> str:
        """Its remedy, with numbers where it can: for the ``largest`` of its
        coefficients, where what it makes up to ``floor``, in the same unit but
        for the covariates, does not matter. `remedy`, unless said otherwise."""
        return self.remedy

    @property
    def meaning(self) -> Meaning | None:
        """What it is, for reports and the reference; its name and its
        coefficients alone, unless said otherwise."""
        return None

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        """What the effect has beside its coefficients: name → (value, unit).
        None, unless said otherwise."""
        return {}

    @property
    def absent(self) -> str:
        """Under which conditions it adds nothing, in words, where that does not
        follow from its ``needs``: nothing, unless said otherwise."""
        return ""

    @property
    def lasting(self) -> bool:
        """Whether what it changes stays so when the unit is switched off and
        on: no, unless said otherwise."""
        return False

    @property
    def forms(self) -> tuple[Effect, ...]:
        """The forms that it comes in, which differ in their coefficients: one,
        unless said otherwise."""
        return (self,)

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """What the search should try under these covariates: its forms, unless
        said otherwise."""
        return self.forms

    def shaped(self, values: Mapping[str, float]) -> Self:
        """The same effect with another `shape`."""
        return self


def per_axis(values: Floats) -> Floats:
    """(n,3) → (n,3,3): one coefficient an axis, each acting on its own axis
    alone."""
    out = np.zeros((*values.shape, 3))
    out[:, range(3), range(3)] = values
    return out


def per_axis_slope(values: Floats) -> Floats:
    """(n,3) → (n,3,3,3): likewise for a derivative that is diagonal in the
    axes."""
    out = np.zeros((*values.shape, 3, 3))
    out[:, range(3), range(3), range(3)] = values
    return out


def on_each_axis(covariate: Floats) -> Floats:
    """(n,) → (n,3,3): a covariate that acts on every axis by a coefficient of
    its own, whatever the specific force."""
    return per_axis(np.repeat(covariate[:, None], 3, axis=1))


def signs(values: Floats, s: Floats, certain: float) -> Floats:
    """(n,3) of values (n,3) beside the specific force s (n,3): ±1, and in a
    straight line through zero up to where they are ``certain``, in parts of the
    specific force's order of magnitude."""
    # In powers of ten, so that it is the same in every pose: the reference may
    # be 1 g, 50 µT or 5e-5 T.
    length = np.maximum(np.linalg.norm(s, axis=1, keepdims=True), 1e-100)
    return np.asarray(np.clip(values / (certain * 10.0 ** np.rint(np.log10(length))), -1.0, 1.0))


def no_slope(s: Floats, coefficients: int = 3) -> Floats:
    """(n,3,3,p) of an effect that does not depend on the specific force."""
    return np.zeros((len(s), 3, 3, coefficients))


def xyz(unit: str, name: str = "{}") -> tuple[Coefficient, ...]:
    return tuple(Coefficient(name.format(axis), unit, axis) for axis in "xyz")


def span_of(t_s: Floats) -> tuple[float, float]:
    """Of poses at times (n,), in seconds: the shortest time constant that a few
    of them show, and how long they take."""
    whole = float(np.ptp(t_s))
    return 1.5 * whole / max(len(t_s) - 1, 1), whole


def steady_within(remedy: str, largest: float, floor: float, unit: str) -> str:
    """A remedy that says how steady is steady enough, for an effect that goes
    with a covariate in ``unit``."""
    if not 0 < floor < np.inf or not largest:
        return remedy
    return f"{remedy} Within ±{plain(floor / abs(largest), 2)} {unit} what it does is below the noise floor."


def reshaped(effect: Effect, name: str, value: float) -> Effect:
    """The effect with another value of one of its shapes."""
    return effect.shaped({n: v for n, (v, _) in effect.shape.items()} | {name: value})
