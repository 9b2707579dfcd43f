"""A calibration as callers have it: applied, shown, and kept as the JSON
document that others script against.

The one file of the metrology that opens files.
"""

from __future__ import annotations

import copy
import errno
import hashlib
import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from triaxcal import text
from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, channel_of, covariate_of, is_derived
from triaxcal.errors import InvalidData, MissingChannel, Refused
from triaxcal.estimate.calibration import Calibration as Fitted
from triaxcal.estimate.calibration import Origin, PoseResult, ReferenceEpoch, Residual
from triaxcal.inputs.bias_update import Earlier
from triaxcal.interchange import tables
from triaxcal.interchange.calibration_document import Document, calibration_document
from triaxcal.interchange.calibration_reading import (
    calibration_of,
    calibration_part,
    earlier_in,
    uncertainty_over_error,
)
from triaxcal.poses.covariates import InStream, covariates_elsewhere, followed
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import Stated
from triaxcal.uncertainty.propagation import uncertainty_of_magnitude, uncertainty_of_readings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from triaxcal.population.odds import LearnedOdds

RETURNS = 1e-6
"""How far a reading may be off, relative to its size, that is made from its own
specific force."""
BESIDE, BESIDE_S = 1.2, 60.0
"""A recording ends after its last pose: by a fifth of its length and a minute
at most."""
HOLD_S = 1.0
"""By so much a recording may end before its last pose seemed to."""
DURATION_S = 5.0
"""As long as a person holds a pose, where a document does not say."""
OUT = ("ax", "ay", "az")
UNCERTAINTY = ("u_ax", "u_ay", "u_az")


class Calibration:
    """Scale factors, misalignments, biases and effects of one unit.

    From `triaxcal.calibrate`, `triaxcal.diagnose`, or a file (`load`); of a
    file, what only a fit knows is NaN. `apply` takes readings in output units
    and gives the specific force in the unit of the reference vector, in the
    sensor's own orthogonal frame: ``a = A (u − c)`` for a linear one, with the
    matrix A (3,3) and the centre c (3,) (paper, eq. 4).
    """

    def __init__(
        self,
        fitted: Fitted,
        *,
        output_unit: str = "",
        reference_unit: str = "g",
        stated: Stated | None = None,
        document: Mapping[str, Any] | None = None,
    ) -> None:
        self._fitted, self._stated = fitted, stated
        self._document = None if document is None else copy.deepcopy(dict(document))
        self._units = output_unit, reference_unit

    @property
    def output_unit(self) -> str:
        return self._units[0]

    @property
    def reference_unit(self) -> str:
        return self._units[1]

    @property
    def stated(self) -> Stated | None:
        """Stated values that no recording shows; None after `load`."""
        return self._stated

    @property
    def fitted(self) -> Fitted:
        """The fit's own value, with its covariance."""
        return self._fitted

    @property
    def terms(self) -> tuple[str, ...]:
        """ "linear", then the effects in the model."""
        return self._fitted.terms

    @property
    def scale_factor(self) -> Floats:
        """(3,) output per reference unit, signed."""
        return self._fitted.sensor.scale_factor.copy()

    @property
    def misalignment(self) -> Floats:
        """(3,) rad."""
        return self._fitted.sensor.misalignment.copy()

    @property
    def bias(self) -> Floats:
        """(3,) in the unit of the reference vector."""
        return self._fitted.sensor.bias.copy()

    @property
    def matrix(self) -> Floats:
        """A (3,3). With effects it is no calibration alone: see `linear_only`."""
        return self._fitted.sensor.matrix

    @property
    def centre(self) -> Floats:
        """c (3,) output units."""
        return self._fitted.sensor.centre

    @property
    def effects(self) -> dict[str, dict[str, tuple[float, float | None, str]]]:
        """name → coefficient → (value, standard error, unit)."""
        return {e.name: self._fitted.coefficients_of(e.name) for e, _ in self._fitted.sensor.effects}

    @property
    def standard_errors(self) -> dict[str, float]:
        """By parameter ("bias.x", "temperature_bias.x"), in its unit; NaN if
        unknown."""
        return dict(zip(self._fitted.parameters, map(float, self._fitted.standard_errors), strict=True))

    @property
    def residual(self) -> Residual:
        return self._fitted.residual

    @property
    def poses(self) -> tuple[PoseResult, ...]:
        """The poses of the fit; none after `load` (`to_dict` has them)."""
        return self._fitted.poses

    @property
    def warnings(self) -> tuple[str, ...]:
        """Every reason not to trust it in full."""
        if self._document is not None:
            part = calibration_part(self._document, where="document")
            kept = part.get("warnings")
            return tuple(map(str, kept)) if isinstance(kept, list) else ()
        return tuple(map(text.caution, self._fitted.cautions))

    @property
    def expanded_uncertainty(self) -> dict[str, float]:
        """Expanded uncertainty of |a|, 95 %, in the unit of the reference vector:
        `this_fit` of the calibration, `this_sessions_poses` of one more pose of
        its recording, `another_day` of the next recording. Empty without a
        budget."""
        known = calibration_part(self.to_dict(), where="document").get("expanded_uncertainty_g")
        return {k: float(v) for k, v in known.items() if v is not None} if isinstance(known, Mapping) else {}

    @property
    def holds_at(self) -> ReferenceEpoch | None:
        """The moment of its recording for which effects of time hold elsewhere."""
        return self._fitted.holds_at

    @property
    def linear_only(self) -> Calibration:
        """The linear calibration fitted by itself; this one if it has no effects.
        Raises InvalidData if the document lacks it."""
        if not self._fitted.sensor.effects:
            return self
        if self._fitted.linear_only is not None:
            return Calibration(
                self._fitted.linear_only,
                output_unit=self.output_unit,
                reference_unit=self.reference_unit,
                stated=self._stated,
            )
        part = calibration_part(self.to_dict(), where="document")
        if not isinstance(part.get("linear_only"), Mapping):
            raise InvalidData("this calibration has effects, and no linear one was fitted beside it: diagnose fits one")
        return Calibration.from_dict(part["linear_only"])

    def apply(
        self,
        u: Any,
        *,
        t: Any = None,
        channels: Mapping[str, Any] | None = None,
        own_recording: bool = False,
        uncertainty: bool = False,
        time_unit: str | None = None,
        columns: Mapping[str, str] | None = None,
    ) -> Any:
        """Calibrated readings.

        ``u`` (3,) or (n,3) in output units, or a DataFrame with the columns ux,
        uy, uz, whose other columns serve as channels (``columns`` as in
        `find_poses`): then a DataFrame of the same library with ax, ay, az.
        ``channels`` are named as in ``channel_reference`` of the document
        (temp_c, temp_c.rate, before_x, …), one number or (n,) each; a missing
        one counts as at its reference, with a `MissingChannel` warning. Effects
        of time hold at `holds_at`, or with ``own_recording`` at the times ``t``
        (n,) from the first sample of the fitted recording. ``uncertainty``:
        also the standard uncertainties that the calibration leaves, in the same
        shape, without the noise of the readings. Raises InvalidData; Refused if
        the model has no inverse.
        """
        table = u if tables.is_table(u) else None
        if table is None and columns is not None:
            raise InvalidData("columns: for a DataFrame; channels names channels of arrays")
        if table is not None:
            by_ours = tables.called(columns)
            u = np.stack([tables.column(table, by_ours[name]) for name in tables.OUTPUTS], axis=1)
            known = self._channels_in(table, by_ours) | dict(channels or {})
            channels = self._in_stream(table, by_ours, time_unit) | known
            if own_recording and t is None and by_ours[tables.TIME_COLUMN] in tables.names_of(table):
                t = tables.seconds(tables.column(table, by_ours[tables.TIME_COLUMN]), time_unit)
                t, time_unit = t - t[:1], None
                self.require_whole(t)
        readings = tables.readings_of(u)
        rows = np.atleast_2d(readings)
        times = self._times(t, own_recording, time_unit, len(rows))
        covariates = self._covariates(len(rows), channels or {}, times)
        sensor = self._fitted.sensor
        a = sensor.specific_force(rows, covariates) if sensor.effects else (rows - sensor.centre) @ sensor.matrix.T
        if sensor.effects:
            self._require_inverse(rows, a, covariates)
        a = a.reshape(readings.shape)
        errors = (
            uncertainty_of_readings(sensor, self._covariance(), rows, covariates, self._fitted.unmodelled).reshape(
                readings.shape
            )
            if uncertainty
            else None
        )
        if table is None:
            return a if errors is None else (a, errors)
        out = dict(zip(OUT, a.T, strict=True))
        return tables.like(table, out if errors is None else out | dict(zip(UNCERTAINTY, errors.T, strict=True)))

    def needs_recording(self) -> tuple[str, ...]:
        """Rates and lags of channels that the effects need, which only a
        recording shows."""
        needs = dict.fromkeys(name for effect, _ in self._fitted.sensor.effects for name in effect.needs)
        return tuple(name for name in needs if followed(name))

    @property
    def duration_s(self) -> float:
        """Median duration of the poses of the fit, over which rates of channels
        are taken."""
        durations = [p.pose.end_s - p.pose.start_s for p in self._fitted.poses]
        return float(np.median(durations)) if durations else DURATION_S

    held_s = duration_s  # its older name

    def _channels_in(self, table: Any, by_ours: Mapping[str, str]) -> dict[str, Any]:
        """Of those that the model needs: under their own names, and under those
        that they are called by."""
        needed = self._needed()
        found = {name: tables.column(table, name) for name in tables.names_of(table) if name in needed}
        return found | {name: tables.column(table, theirs) for name, theirs in by_ours.items() if name in needed}

    def _in_stream(self, table: Any, by_ours: Mapping[str, str], time_unit: str | None) -> dict[str, Floats]:
        """Rates and lags that the effects need, where the rows have times that
        are known: those of a recording."""
        needed, names, time = self.needs_recording(), tables.names_of(table), by_ours[tables.TIME_COLUMN]
        if not needed or time not in names:
            return {}
        times = tables.column(table, time)
        if times.dtype.kind in "iu" and time_unit is None:
            return {}
        t_s = tables.seconds(times, time_unit)
        if len(t_s) < 2 or not (np.diff(t_s) > 0).all():
            return {}
        columns = {channel: by_ours.get(channel, channel) for channel in map(followed, needed)}
        values = {
            channel: tables.channel_of_samples(channel, tables.column(table, name), len(t_s))
            for channel, name in columns.items()
            if name in names
        }
        whole = {channel: v for channel, v in values.items() if np.isfinite(v).all()}
        return InStream.of([(t_s, whole)], needed, self.duration_s).at(t_s)

    def _needed(self) -> set[str]:
        return {name if is_derived(name) else channel_of(name) for name in self._fitted.channel_reference} - {TIME}

    def _times(self, t: Any, own_recording: bool, time_unit: str | None, n: int) -> Floats | None:
        if not own_recording:
            return None
        if t is None:
            raise InvalidData("own_recording: say by t when the readings were taken, from the recording's first sample")
        times = tables.seconds(t, time_unit)
        if len(times) != n:
            raise InvalidData(f"t has {len(times)} times, and u has {n} samples")
        end_s = self._end_s()
        most = np.inf if end_s is None else BESIDE * end_s + BESIDE_S
        if n and not (times.min() >= -BESIDE_S and times.max() <= most):
            raise InvalidData(
                f"t goes from {times.min():.6g} to {times.max():.6g} s, and the recording that was fitted from 0 to "
                f"{end_s:.6g} s: count from its first sample"
            )
        return times

    def require_whole(self, t: Floats) -> None:
        """Raises InvalidData where times from a table's own first row cannot be
        those of the whole recording."""
        end_s = self._end_s()
        if end_s is not None and len(t) and t[-1] < end_s - HOLD_S:
            raise InvalidData(
                f"the table spans {t[-1]:.6g} s, and the recording that was fitted {end_s:.6g} s: give t, counted from "
                "that recording's first sample"
            )

    def _end_s(self) -> float | None:
        """When the last pose of the recording that was fitted ended; None where
        that is not known."""
        poses = calibration_part(self.to_dict(), where="document").get("poses")
        ends = [p.get("end_s") for p in poses if isinstance(p, Mapping)] if isinstance(poses, list) else []
        known = [float(e) for e in ends if isinstance(e, int | float)]
        return max(known) if known else None

    def _require_inverse(self, u: Floats, a: Floats, covariates: Mapping[str, Floats]) -> None:
        """Raises Refused where the readings do not come out of what they were
        made into."""
        with np.errstate(all="ignore"):
            back = self._fitted.sensor.output(a, covariates)
            wrong = ~(np.abs(back - u).max(axis=1) <= RETURNS * (1 + np.abs(u).max(axis=1)))
        wrong &= np.isfinite(u).all(axis=1)
        for name in {n for e, _ in self._fitted.sensor.effects for n in e.needs} & covariates.keys():
            wrong &= ~np.isnan(covariates[name])
        if wrong.any():
            raise Refused(
                f"the model has no inverse at reading {int(np.flatnonzero(wrong)[0])}: it lies far beyond what the "
                "effects hold for, or is in another unit"
            )

    def _covariates(self, n: int, channels: Mapping[str, Any], times: Floats | None) -> dict[str, Floats]:
        if not isinstance(channels, Mapping):
            raise InvalidData("channels: expected values by name, as in {'temp_c': 25.0}")
        given = {name: tables.channel_of_samples(name, v, n) for name, v in channels.items()}
        covariates, missing = self._fitted.covariates_of_readings(n, given, times)
        missing = tuple(channel_of(name) if not is_derived(name) else name for name in missing)
        if missing:
            effects = [e.name for e, _ in self._fitted.sensor.effects if set(e.needs) & set(missing)]
            known = {name: self._fitted.channel_reference.get(covariate_of(name), 0.0) for name in missing}
            at = ", ".join(f"{value:g}" for value in known.values()) if any(known.values()) else ""
            warnings.warn(
                f"{', '.join(missing)} not given, which {', '.join(effects)} goes with: taken at the reference"
                + (f" ({at})" if at else ""),
                MissingChannel,
                stacklevel=3,
            )
        return covariates

    def uncertainty_in(self, poses: Sequence[Pose]) -> Floats:
        """(n,) standard uncertainty of |a| that the calibration leaves in poses
        of another recording, without their noise. Raises InvalidData if a
        channel that the effects need is missing."""
        c = self._fitted
        u = np.array([p.mean for p in poses])
        covariates = covariates_elsewhere(poses, c.channel_reference, self.scale_factor, self.bias, c.moment)
        return uncertainty_of_magnitude(c.sensor, self._covariance(), u, covariates, c.unmodelled)

    def _covariance(self) -> Floats:
        """(p,p) of the parameters, with what the budget has beside the fit."""
        budget = calibration_part(self.to_dict(), where="document").get("uncertainty") or {}
        return self._fitted.covariance * np.outer(*[uncertainty_over_error(budget, self._fitted)] * 2)

    def to_dict(self) -> Document:
        """The `triaxcal.calibration/1` document; as it was loaded, where it
        was."""
        if self._document is None:
            self._document = calibration_document(
                self._fitted,
                output_unit=self.output_unit,
                reference_unit=self.reference_unit,
                stated=self._stated,
                budgeted=bool(self._fitted.poses),
            )
        return copy.deepcopy(self._document)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], *, where: str = "document") -> Calibration:
        """From a calibration, loop or certificate document. Raises InvalidData,
        which begins with ``where``."""
        part = calibration_part(document, where=where)
        units = part.get("units")
        named = units if isinstance(units, Mapping) else {}
        return cls(
            calibration_of(document, where=where),
            output_unit=str(named.get("output") or ""),
            reference_unit=str(named.get("reference") or "g"),
            document=part,
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Whole or not at all. Raises OSError; InvalidData where the document
        cannot be written as JSON."""
        if not Path(path).parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, "there is no folder", str(Path(path).parent))
        try:
            content = to_text(self.to_dict()).encode()
        except ValueError as e:
            raise InvalidData(f"{path}: the document cannot be written: {e}") from None
        write_bytes(Path(path), content)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Raises InvalidData, which names the file, and OSError."""
        return cls.from_dict(read_document(Path(path)), where=str(path))

    def summary(self) -> str:
        """A few lines: the coefficients with their standard errors, the
        residual, and the warnings."""
        return text.summary(self._fitted, self.output_unit, self.reference_unit, self.warnings)

    def plot(self) -> Figure:
        """The residuals of the poses, in order and on the sphere, also after
        `load`. Raises InvalidData if there are none; ModuleNotFoundError without
        matplotlib."""
        from triaxcal.pictures import residuals_figure  # matplotlib, which nothing else needs

        return residuals_figure(calibration_part(self.to_dict(), where="document"))

    def __repr__(self) -> str:
        return text.short(self._fitted, self.output_unit, self.reference_unit)

    def _repr_html_(self) -> str:
        return text.html(self._fitted, self.output_unit, self.reference_unit, self.warnings)


def earlier_of(calibration: Calibration, name: str = "", *, sha256: str = "", recording: str = "") -> Earlier:
    """A calibration as what is known of its unit before a later ``recording``.
    ``name`` and ``sha256`` are those of its file, by default the digest of what
    `Calibration.save` writes."""
    document = calibration.to_dict()
    sha256 = sha256 or hashlib.sha256(to_text(document).encode()).hexdigest()
    return earlier_in(document, Origin(name, sha256, recording), where=name or "document")


def learned_odds_in(odds: LearnedOdds | Mapping[str, Any] | str | os.PathLike[str]) -> LearnedOdds:
    """Learned odds, as they are, from their document, or from its file. Raises
    InvalidData, OSError."""
    from triaxcal.interchange.population_documents import odds_of  # the posterior, which nothing else here needs
    from triaxcal.population.odds import LearnedOdds

    if isinstance(odds, LearnedOdds):
        return odds
    if isinstance(odds, Mapping):
        return odds_of(odds, where="odds")
    return odds_of(read_document(Path(odds)), where=str(odds))


def read_document(path: Path) -> Mapping[str, Any]:
    """A JSON object. Raises InvalidData, which names file and line, and
    OSError."""
    with path.open("rb") as file:
        data = file.read()
    try:
        found = json.loads(data)
    except json.JSONDecodeError as e:
        raise InvalidData(f"{path}: line {e.lineno}: no JSON: {e.msg}") from None
    except (ValueError, RecursionError) as e:
        raise InvalidData(f"{path}: no JSON: {e}") from None
    if not isinstance(found, Mapping):
        raise InvalidData(f"{path}: expected a JSON object")
    return found


def to_text(document: Mapping[str, Any]) -> str:
    """The document as it is written and compared: UTF-8, two spaces, one key a
    line, a newline at the end."""
    return json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def write_bytes(path: Path, content: bytes) -> None:
    beside = path.parent / f".{path.name}.{os.getpid()}"
    try:
        beside.write_bytes(content)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)
