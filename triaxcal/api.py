"""The functions of the package, from samples to a calibration: `import triaxcal as
tc`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from triaxcal import text, uncertainty
from triaxcal.arrays import Floats, rms
from triaxcal.diagnosis import Candidate, Finding, Recommendation
from triaxcal.diagnosis import diagnose as diagnosed
from triaxcal.documents import Calibration, earlier_of, learned_odds_in
from triaxcal.effects import effect_named
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate import pose_fit
from triaxcal.estimate.creep import with_unexplained_creep
from triaxcal.estimate.hold_out import HoldOut, magnitude_errors
from triaxcal.estimate.pose_fit import poses_of_means
from triaxcal.evidence.partial_residuals import Trace
from triaxcal.evidence.posterior import Unexplained
from triaxcal.inputs.bias_update import updated_biases
from triaxcal.interchange import tables
from triaxcal.model.directions import FULL, closed, directions
from triaxcal.model.samples import Moment, Samples
from triaxcal.number_format import number_of
from triaxcal.poses.finder import PoseFinder
from triaxcal.poses.pose import Pose
from triaxcal.poses.quality import disturbances
from triaxcal.text import diagnosis
from triaxcal.uncertainty.combined import NextRecording, next_recording
from triaxcal.units import ErrorUnit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PlannedPose(NamedTuple):
    """A pose of a plan. ``label`` names the axes that point up ("+X-Y"); ``up`` (3,) is
    that direction in the sensor's frame."""

    label: str
    up: tuple[float, float, float]


class Poses(tuple[Pose, ...]):
    """Still poses, in order of time. ``data_quality`` has a line for each fault of the
    raw stream; ``output_unit`` is the argument of `find_poses`."""

    data_quality: tuple[str, ...] = ()
    output_unit: str = ""

    def __repr__(self) -> str:
        return text.poses(self, self.data_quality)

    @classmethod
    def of_means(
        cls,
        u: Any,
        *,
        t: Any = None,
        standard_errors: Any = None,
        channels: Mapping[str, Any] | None = None,
        time_unit: str | None = None,
    ) -> Poses:
        """Poses from means alone, one pose a row: ``u`` (n,3) in output units, their
        ``standard_errors`` (n,3), ``t`` (n,) as in `find_poses`, ``channels`` (n,)
        each. Without standard errors the residuals of the linear model give the noise,
        so no lack of fit can show. Raises Refused, InvalidData."""
        readings = tables.readings_of(u)
        if readings.ndim != 2:
            raise InvalidData(f"u: expected shape (n, 3), one row a pose, not {readings.shape}")
        errors = None if standard_errors is None else tables.readings_of(standard_errors)
        if errors is not None and errors.shape != readings.shape:
            raise InvalidData(f"standard_errors: expected shape {readings.shape}, not {errors.shape}")
        seconds = None if t is None else tables.seconds(t, time_unit)
        if seconds is not None and len(seconds) != len(readings):
            raise InvalidData(f"t has {len(seconds)} times, and u has {len(readings)} poses")
        values = {n: tables.channel_of_samples(n, v, len(readings)) for n, v in (channels or {}).items()}
        return cls(poses_of_means(readings, seconds, errors, values))


@dataclass(frozen=True)
class Diagnosis:
    """The linear calibration ``before``, and ``calibration``, the one to use, with
    the effects that were found.

    ``call`` is the verdict. ``findings`` act for certain, ``candidates`` more
    likely than not; ``probabilities`` has every effect of the search, None if its
    probability is not calibrated. ``unexplained`` is the unmodelled part,
    ``held_out`` the error in poses that no fit saw, ``advice`` a list of actions,
    ``notes`` further notes. ``traces`` are the partial residuals of each finding
    and each candidate, which `plot` draws."""

    before: Calibration
    calibration: Calibration
    call: Recommendation
    findings: tuple[Finding, ...]
    candidates: tuple[Candidate, ...]
    probabilities: Mapping[str, float | None]
    unexplained: Unexplained
    next_recording: NextRecording
    held_out: HoldOut | None
    advice: tuple[str, ...]
    notes: tuple[str, ...] = ()
    traces: tuple[Trace, ...] = field(repr=False, default=())
    _lines: tuple[str, ...] = field(repr=False, default=())

    def summary(self) -> str:
        """The verdict, the cause, the error before and after, and the next
        step, a line each."""
        return "\n".join(["Diagnosis", *(f"  {line}" for line in self._lines)])

    def plot(self) -> Figure:
        """The partial residual of each finding, each candidate and an unmodelled
        part against its driving variable, with the fitted curve and its 95 % band;
        without findings the residuals. Raises ModuleNotFoundError without
        matplotlib."""
        from triaxcal.pictures import traces_figure  # matplotlib, which nothing else needs

        c = self.calibration
        return traces_figure(self.traces, ErrorUnit.of(c.reference_unit, c.fitted.reference))

    def __repr__(self) -> str:
        return self.summary()


@dataclass(frozen=True)
class Verification:
    """Errors |a| − reference (n,) of ``poses`` under a calibration, in the unit of the
    reference, with their standard errors from noise (n,), and the standard uncertainty
    of |a| from the calibration (n,)."""

    poses: tuple[Pose, ...]
    error: Floats
    standard_error: Floats
    uncertainty: Floats
    reference: tuple[str, float] = ("g", 1.0)
    """Its unit and magnitude."""

    @property
    def rms(self) -> float:
        return rms(self.error)

    @property
    def noise_floor(self) -> float:
        return rms(self.standard_error)

    @property
    def expected(self) -> float:
        """The rms error that noise and the uncertainty of the calibration predict."""
        return float(np.sqrt(np.mean(self.standard_error**2 + self.uncertainty**2)))

    def summary(self) -> str:
        verified = number_of(len(self.poses), "pose")
        return text.verification(verified, self.rms, self.noise_floor, self.expected, self.reference)

    def __repr__(self) -> str:
        return self.summary()


def find_poses(
    t: Any,
    u: Any = None,
    *,
    channels: Mapping[str, Any] | None = None,
    time_unit: str | None = None,
    columns: Mapping[str, str] | None = None,
    output_unit: str = "",
) -> Poses:
    """The still spans of a recording, without a threshold.

    ``t`` (n,) has floats in seconds, datetimes, or integers with ``time_unit`` (s, ms,
    us, ns); ``u`` (n,3) is in output units; ``channels`` (n,) each by name. Or ``t`` is
    a DataFrame with the columns t_s, ux, uy, uz and any further channels. ``columns``
    gives other names of columns, also of channels: {"t": "time", "ux": "ax", …,
    "temp_c": "Temperatur"}. The caller reads a file into a DataFrame. Raises
    InvalidData.
    """
    samples = _samples(t, u, channels, time_unit, columns)
    finder = PoseFinder()
    finder.feed(samples.time_ns, samples.readings, samples.channels)
    finder.finish()
    if finder.windows is None and (too_short := finder.too_short()) is not None:
        raise too_short
    found = Poses(finder.poses())
    found.data_quality = tuple(text.quality_line(f, output_unit) for f in (*finder.findings(), *disturbances(found)))
    found.output_unit = output_unit
    return found


def calibrate(
    poses: Any,
    u: Any = None,
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    effects: Sequence[str] = (),
    channels: Mapping[str, Any] | None = None,
    time_unit: str | None = None,
    columns: Mapping[str, str] | None = None,
    output_unit: str = "",
    reference_unit: str = "g",
    stated: uncertainty.Stated | None = None,
) -> Calibration:
    """Fit the linear model, and the ``effects`` named, to still poses.

    ``poses`` come from `find_poses`, or are its arguments. ``signs`` (3,) are those of
    the scale factors, which |a| does not show. ``reference`` is the magnitude of the
    reference vector in ``reference_unit``. Raises Refused if the poses do not
    determine the parameters, InvalidData.
    """
    found = _poses(poses, u, channels, time_unit, columns, output_unit)
    names = [effects] if isinstance(effects, str) else list(effects)
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InvalidData(f"effects: {twice} is asked for twice")
    try:
        model = [effect_named(name) for name in names]
    except KeyError as e:
        raise InvalidData(f"no effect of the name {e.args[0]} is known") from None
    fitted = pose_fit.fit(found, signs=_signs(signs), reference=_positive(reference), effects=model)
    output_unit = output_unit or _unit_of(poses)
    return Calibration(fitted, output_unit=output_unit, reference_unit=reference_unit, stated=stated)


def diagnose(
    poses: Any,
    u: Any = None,
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    check: Any = None,
    at: str | float = "end",
    odds: Any = None,
    channels: Mapping[str, Any] | None = None,
    time_unit: str | None = None,
    columns: Mapping[str, str] | None = None,
    output_unit: str = "",
    reference_unit: str = "g",
    stated: uncertainty.Stated | None = None,
) -> Diagnosis:
    """Find the effects that the poses show beyond the linear model, and correct them.

    The arguments are those of `calibrate`. ``check`` has poses of another recording,
    or a table of its samples, for the hold-out error. ``at`` is the moment for which
    effects of time hold elsewhere: "end", "mean", or seconds from the first sample.
    ``odds`` are those that `triaxcal.population.learned_odds` learned, or their
    document (`triaxcal.odds/1`), or its file: they replace the odds of the catalogue.
    """
    found = _poses(poses, u, channels, time_unit, columns, output_unit)
    try:
        moment = Moment(at) if isinstance(at, str) else float(at)
    except (TypeError, ValueError):
        raise InvalidData(f"at: expected 'end', 'mean' or seconds, not '{at}'") from None
    if moment is Moment.SECONDS:
        raise InvalidData("at: expected 'end', 'mean' or a number of seconds")
    others = None if check is None else _poses(check)
    output_unit = output_unit or _unit_of(poses)
    loop = diagnosed(
        found,
        signs=_signs(signs),
        reference=_positive(reference),
        check=others,
        at=moment,
        odds=None if odds is None else learned_odds_in(odds).prior,
    )
    before, after = (
        Calibration(c, output_unit=output_unit, reference_unit=reference_unit, stated=stated)
        for c in (loop.before, loop.after)
    )
    small = ErrorUnit.of(reference_unit, loop.after.reference)
    following = next_recording(loop.after, uncertainty.budget(loop.after, stated))
    return Diagnosis(
        before,
        after,
        loop.call,
        loop.findings,
        loop.candidates,
        loop.stated,
        loop.found.unexplained,
        following,
        loop.held_out,
        tuple(diagnosis.advice(loop, small)),
        tuple(diagnosis.notes(loop, small)),
        loop.traces,
        diagnosis.lines(loop, small, following, stated),
    )


def verify(calibration: Calibration, poses: Any, u: Any = None, **how: Any) -> Verification:
    """The errors of the magnitude in still poses of another recording. ``poses`` come
    from `find_poses`, or are its arguments.

    Poses with faulty samples are excluded. Raises Refused if none is left,
    InvalidData.
    """
    found = [p for p in _poses(poses, u, **how) if not p.fault]
    if not found:
        raise Refused("no still pose to verify by")
    c = calibration.fitted
    error, noise = magnitude_errors(
        c.sensor,
        with_unexplained_creep(found, c, elsewhere=True),
        channel_reference=c.channel_reference,
        reference=c.reference,
        moment=c.moment,
    )
    reference = (calibration.reference_unit, c.reference)
    return Verification(tuple(found), error, noise, calibration.uncertainty_in(found), reference)


def rezero(calibration: Calibration, poses: Any, u: Any = None, *, first: int | None = None, **how: Any) -> Calibration:
    """The calibration with three new biases from still poses of a later recording.
    Scale factors, misalignments and effects are kept.

    ``poses`` come from `find_poses`, or are its arguments. ``first`` limits them to
    the first so many that are 45° apart (10° if there are fewer). The uncertainty
    contains that of the calibration, the change from recording to recording, and that
    of the poses. Raises Refused if these do not determine three biases, or if the
    kept parameters no longer fit; InvalidData.
    """
    if first is not None and (isinstance(first, bool) or not isinstance(first, int) or first < 1):
        raise InvalidData(f"first: expected a whole number of at least 1, not {first!r}")
    found = updated_biases(_poses(poses, u, **how), earlier_of(calibration), first=first)
    return Calibration(
        found,
        output_unit=calibration.output_unit,
        reference_unit=calibration.reference_unit,
        stated=calibration.stated,
    )


def plan(poses: int = FULL) -> tuple[PlannedPose, ...]:
    """Directions for the unit, in an order that separates attitude from time. The first
    pose comes again at the end. Raises InvalidData for fewer than 9."""
    return tuple(PlannedPose(label, (float(x), float(y), float(z))) for label, (x, y, z) in closed(directions(poses)))


def budget(calibration: Calibration, stated: uncertainty.Stated | None = None) -> uncertainty.Budget:
    """The uncertainty budget by the GUM (JCGM 100). ``stated`` has values that no
    recording shows, by default those of the calibration. Raises InvalidData without
    still poses, and after `load`: the document has the budget."""
    stated = calibration.stated if stated is None else stated
    if not calibration.poses:
        raise InvalidData(
            "no poses to evaluate: of a calibration that was loaded, to_dict()['uncertainty'] is the budget"
        )
    return uncertainty.budget(calibration.fitted, stated)


def _unit_of(poses: Any) -> str:
    """The output unit of poses from `find_poses`, else empty."""
    return poses.output_unit if isinstance(poses, Poses) else ""


def _samples(
    t: Any, u: Any, channels: Mapping[str, Any] | None, time_unit: str | None, columns: Mapping[str, str] | None
) -> Samples:
    if tables.is_table(t):
        if u is not None or channels:
            raise InvalidData("a table holds its readings and channels itself; columns says how they are called")
        return tables.samples_of_table(t, columns, time_unit)
    if u is None:
        raise InvalidData("expected t (n,) and u (n,3), or a table with the columns t_s, ux, uy, uz")
    return tables.samples_of(t, u, channels, time_unit)


def _signs(signs: Any) -> tuple[float, float, float]:
    try:
        x, y, z = (float(s) for s in signs)
    except (TypeError, ValueError):
        raise InvalidData(f"signs: expected three of 1 and -1, not {signs!r}") from None
    return x, y, z


def _positive(reference: Any) -> float:
    known = isinstance(reference, int | float | np.floating | np.integer) and not isinstance(reference, bool)
    if not known or not 0 < reference < np.inf:
        raise InvalidData(f"reference: expected a positive number, not {reference!r}")
    return float(reference)


def _poses(
    poses: Any,
    u: Any = None,
    channels: Mapping[str, Any] | None = None,
    time_unit: str | None = None,
    columns: Mapping[str, str] | None = None,
    output_unit: str = "",
) -> Sequence[Pose]:
    if u is None and isinstance(poses, Sequence) and all(isinstance(p, Pose) for p in poses):
        arguments = {"channels": channels, "time_unit": time_unit, "columns": columns}
        if needless := next((name for name, value in arguments.items() if value is not None), None):
            raise InvalidData(f"{needless}: the poses are found already; give it to find_poses")
        return list(poses)
    return find_poses(poses, u, channels=channels, time_unit=time_unit, columns=columns, output_unit=output_unit)
