"""What the page needs of a `triaxcal.calibration/1` or `triaxcal.loop/1`, read
without trust.

Nothing in a document is required: a report on a refused or damaged result must
still come out, with a dash where a value is missing."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
from triaxcald import text
from triaxcald.caveats import is_passing
from triaxcald.report.figures import QUALITY, clean, micro_g, number
from triaxcald.schema.certificate import RegisterWord

# Values of a document, read without trust: what is missing or of the wrong kind
# counts as missing.

Vector = tuple[float, float, float]


def mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def texts(value: object) -> tuple[str, ...]:
    """A list of sentences or names; an entry with keys becomes `key: value;
    key: value`."""
    entries = value if isinstance(value, (list, tuple)) else [] if value is None else [value]
    return tuple(words(entry) for entry in entries if entry is not None)


def vector(value: object) -> Vector | None:
    """Three finite numbers, or None."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 3:
        return None
    x, y, z = (number(component) for component in value)
    return None if x is None or y is None or z is None else (x, y, z)


def numbers(value: object) -> dict[str, float | None]:
    return {str(name): number(entry) for name, entry in mapping(value).items()}


def words(entry: object) -> str:
    if isinstance(entry, Mapping):
        return "; ".join(f"{key}: {value}" for key, value in entry.items())
    return str(entry)


# The plain model, the one that is handed on, and the errors of each.


@dataclass(frozen=True)
class Stage:
    """A model: its errors and, where known, the residual of every pose in g."""

    label: str
    residual: tc.schema.Residual
    held_out_rms_g: float | None = None
    pose_residual_g: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class HoldOut:
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None
    poses: int | None
    contradicts: bool = False
    """Whether these poses contradict the calibration."""


def residual_of(value: object) -> tc.schema.Residual | None:
    return residual_in(known) if (known := mapping(value)) else None


def residual_in(known: Mapping[str, object]) -> tc.schema.Residual:
    """A figure that is missing or no number is None."""
    return tc.schema.Residual(**{name: number(known.get(name)) for name in tc.schema.Residual.model_fields})


NO_RESIDUAL = residual_in({})


def held_out_of(document: Mapping[str, object]) -> HoldOut | None:
    known = mapping(document.get("held_out"))
    if not known:
        return None
    poses = number(known.get("poses"))
    return HoldOut(
        number(known.get("before_rms_g")),
        number(known.get("after_rms_g")),
        number(known.get("noise_floor_g")),
        None if poses is None else int(poses),
        known.get("contradicts") is not None,
    )


def stages_of(
    document: Mapping[str, object],
    calibration: Mapping[str, object],
    by_pose_g: tuple[Sequence[float | None], Sequence[float | None]],
    held_out: HoldOut | None,
) -> tuple[Stage, ...]:
    """Before and after; one where they are the same. ``by_pose_g`` has the
    residuals of both."""
    before_g, after_g = by_pose_g
    after = residual_of(document.get("after")) or residual_of(calibration.get("residual"))
    before = residual_of(document.get("before"))
    if before is None and after is None:
        return ()
    held_after_g = held_out.after_rms_g if held_out else None
    if before is None or before == after:
        return (Stage("This model", after or NO_RESIDUAL, held_after_g, _series(after_g)),)
    first = Stage("Before", before, held_out.before_rms_g if held_out else None, _series(before_g))
    return (first,) if after is None else (first, Stage("After", after, held_after_g, _series(after_g)))


def _series(values: Sequence[float | None]) -> NDArray[np.float64] | None:
    """Residuals as an array with NaN for a missing one; None when all are
    missing."""
    array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return None if array.size == 0 or bool(np.isnan(array).all()) else array


# The recordings of a document that was made from several.


@dataclass(frozen=True)
class OfRecording:
    """How well the magnitude comes out in the poses of one recording, rms in
    the unit of the reference."""

    name: str
    poses: float | None
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None


def file_names(paths: Sequence[str]) -> dict[str, str]:
    """What to call recordings, by path: by their files' names where these tell
    them apart."""
    names = [PurePath(path).name or path for path in paths]
    counts = Counter(names)
    return {path: clean(name if counts[name] == 1 else path) for path, name in zip(paths, names, strict=True)}


def by_recording(value: object, names: Mapping[str, str]) -> Iterator[OfRecording]:
    for known in map(mapping, value if isinstance(value, (list, tuple)) else ()):
        name = names.get(str(known.get("recording")), "")
        keys = ("poses", "before_rms_g", "after_rms_g", "noise_floor_g")
        yield OfRecording(name, *(number(known.get(key)) for key in keys))


_OF_A_POSE = (
    "start_s", "end_s", "before_residual_g", "residual_g", "studentized", "leverage", "standard_error_g",
)  # fmt: skip


AXES = 3
EVEN = 0.5
"""Below this probability of nothing something acts, whatever that is."""
CANDIDATE = "candidate"
"""The verdict on an effect that probably acts; documents have it under
``candidates``."""
_NOT_AGAIN = (tc.estimate.Exclusion.UNKNOWN_HISTORY, tc.estimate.Exclusion.CALLER)
"""Poses that are not to be taken again, though the fit excludes them."""


@dataclass(frozen=True)
class Coefficient:
    name: str
    value: float | None
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Pose:
    """`direction` is the unit vector of up in the sensor's frame; `mean` in
    output units; `recording` that of several whose clock its times are on.
    `again`: left out of the fit, and to be taken again.
    """

    number: int
    start_s: float | None
    end_s: float | None
    mean: Vector | None
    direction: Vector | None
    before_residual_g: float | None
    residual_g: float | None
    studentized: float | None
    leverage: float | None
    used: bool
    again: bool = False
    why: str = ""
    standard_error_g: float | None = None
    recording: str = ""
    channels: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def middle_s(self) -> float | None:
        return None if self.start_s is None or self.end_s is None else 0.5 * (self.start_s + self.end_s)


@dataclass(frozen=True)
class Finding:
    effect: str
    verdict: str
    in_model: bool
    probability: float | None
    coefficients: tuple[Coefficient, ...]
    alternatives: tuple[str, ...]
    reason: str | None
    remedy: str | None
    probabilities: Mapping[str, float | None] = field(default_factory=dict)
    """Of its alternatives, by name."""
    hangs_on_one_pose: bool = False
    """As a document says that states no probability."""

    @property
    def in_question(self) -> bool:
        """Whether it need not be this effect that acts."""
        return bool(self.alternatives) or self.verdict == CANDIDATE

    @property
    def hangs_on_a_pose(self) -> bool:
        """Whether it is likely enough to be known, and is not since some one
        pose may be an outlier."""
        likely = self.probability is not None and tc.evidence.Odds().hangs_on_one_pose(self.probability)
        return self.verdict == CANDIDATE and (likely or self.hangs_on_one_pose) and not self.alternatives

    def shape(self, name: str) -> float | None:
        """The value of a coefficient, such as the moment of a step."""
        return next((c.value for c in self.coefficients if c.name == name), None)


@dataclass(frozen=True)
class Unexplained:
    significant: bool
    probability: float | None
    rms_g: float | None
    lead: str


@dataclass(frozen=True)
class Outcome:
    """Everything the page shows of a document. `stages` are the plain model and
    the final one; `findings` end with the candidates; `searched` tells a loop,
    which looked for effects, from a fit, which did not. `recordings` are their
    names where there are several.
    """

    refused: str | None
    searched: bool
    call: str
    stages: tuple[Stage, ...]
    held_out: HoldOut | None
    findings: tuple[Finding, ...]
    unexplained: Unexplained | None
    nothing_probability: float | None
    another_unit: bool
    not_corrected: str
    linear: tuple[Coefficient, ...]
    effects: tuple[tuple[str, tuple[Coefficient, ...]], ...]
    matrix: tuple[Vector, ...] | None
    centre: Vector | None
    averaged: Mapping[str, float | None]
    use: str
    output_unit: str
    reference_unit: str
    reference: float | None
    recordings: tuple[str, ...]
    by_recording: tuple[OfRecording, ...]
    poses: tuple[Pose, ...]
    condition: float | None
    blind_to: tuple[str, ...]
    warnings: tuple[str, ...]
    doubts: tuple[str, ...]
    data_quality: tuple[str, ...]
    advice: tuple[str, ...]
    notes: tuple[str, ...]
    limits: Mapping[str, float | None]
    channel_reference: Mapping[str, float | None]

    @property
    def final(self) -> tc.schema.Residual:
        return self.stages[-1].residual if self.stages else NO_RESIDUAL

    @property
    def small(self) -> tc.units.ErrorUnit:
        """The unit in which errors are told."""
        return tc.units.ErrorUnit.of(self.reference_unit, 1.0 if self.reference is None else self.reference)

    @property
    def mean_decimals(self) -> int:
        """Of the poses' means: to two digits of the smallest standard error; where
        none is known, so that the largest has eight digits."""
        scale = min((abs(c.value) for c in self.linear[:AXES] if c.value), default=0.0)
        least = scale * min((p.standard_error_g for p in self.poses if p.standard_error_g), default=0.0)
        if least > 0:
            return int(np.clip(1 - np.floor(np.log10(least)), 0, 12))
        largest = max((abs(v) for pose in self.poses if pose.mean for v in pose.mean), default=0.0)
        return int(np.clip(7 - np.floor(np.log10(largest)), 0, 12)) if largest else 0

    @property
    def poses_used(self) -> int:
        return sum(pose.used for pose in self.poses)

    @property
    def excluded(self) -> tuple[Pose, ...]:
        return tuple(pose for pose in self.poses if not pose.used)

    @property
    def something_is_left(self) -> bool:
        """Whether it is likelier than not that something acts beside the outliers
        that are excluded, or more is left than noise accounts for."""
        p, nothing = self.final.lack_of_fit_p, self.nothing_probability
        unexplained = self.unexplained is not None and self.unexplained.significant
        outliers = any(pose.again for pose in self.poses)
        something = nothing is not None and nothing < EVEN and not outliers
        return unexplained or something or (p is not None and p < tc.poses.LACK_OF_FIT)


def read_document(document: Mapping[str, object]) -> Outcome:
    """The outcome that `document` describes; whatever is missing or of the
    wrong kind counts as missing."""
    looped = str(document.get("format", "")).startswith("triaxcal.loop/")
    inside = looped or str(document.get("format", "")).startswith("triaxcal.rezero/")
    calibration = mapping(document.get("calibration")) if inside else document
    matrix, centre = _matrix(calibration.get("matrix")), vector(calibration.get("centre"))
    names = file_names(texts(document.get("recordings")))
    poses = tuple(_poses(calibration, matrix, centre, names))
    held_out = held_out_of(document)
    before_g, after_g = [pose.before_residual_g for pose in poses], [pose.residual_g for pose in poses]
    effects = mapping(calibration.get("effects"))
    terms = {*texts(calibration.get("terms")), *effects}
    units = calibration.get("units")
    return Outcome(
        refused=_refusal(document, calibration),
        searched=looped,
        call=str(document.get("call") or ""),
        stages=stages_of(document, calibration, (before_g, after_g), held_out),
        held_out=held_out,
        findings=(
            *_findings(document.get("findings"), terms),
            *_findings(document.get("candidates"), terms, verdict=CANDIDATE),
        ),
        unexplained=_unexplained(document.get("unexplained")),
        nothing_probability=number(document.get("nothing_probability")),
        another_unit=bool(mapping(document.get("another_unit"))),
        not_corrected=str(document.get("not_corrected") or ""),
        linear=tuple(_linear(calibration, units)),
        effects=tuple((name, _coefficients(values)) for name, values in effects.items()),
        matrix=matrix,
        centre=centre,
        averaged=_averaged(document, effects),
        use=str(calibration.get("use") or ""),
        output_unit=_output_unit(units),
        reference_unit=clean(mapping(units).get("reference") or "g"),
        reference=number(calibration.get("reference")),
        recordings=tuple(names.values()),
        by_recording=tuple(by_recording(document.get("by_recording"), names)),
        poses=poses,
        condition=number(calibration.get("condition")),
        blind_to=texts(calibration.get("blind_to")),
        warnings=texts(calibration.get("warnings")),
        doubts=texts(document.get("doubts")),
        data_quality=tuple(_with_names(line, names) for line in texts(document.get("data_quality"))),
        advice=texts(document.get("advice")),
        notes=texts(document.get("notes")),
        limits=numbers(document.get("limits")),
        channel_reference=numbers(calibration.get("channel_reference")),
    )


def _averaged(document: Mapping[str, object], effects: Mapping[str, object]) -> dict[str, float | None]:
    """Effects that the correction has by as much as they are probable, and that
    are neither findings nor candidates: each with its probability."""
    listed = (entry for key in ("findings", "candidates") for entry in _entries(document.get(key)))
    named = {name for entry in listed for name in (str(entry.get("effect")), *texts(entry.get("alternatives")))}
    weights = {name: mapping(values).get(tc.interchange.WEIGHT) for name, values in effects.items()}
    return {name: number(weight) for name, weight in weights.items() if name not in named and weight is not None}


def _entries(value: object) -> list[Mapping[str, object]]:
    return [mapping(entry) for entry in value] if isinstance(value, (list, tuple)) else []


def _with_names(line: str, names: Mapping[str, str]) -> str:
    """A line about one of several recordings begins with its path."""
    path = next((path for path in names if line.startswith(f"{path}: ")), "")
    return names[path] + line[len(path) :] if path else line


def _matrix(value: object) -> tuple[Vector, ...] | None:
    rows = [vector(row) for row in value] if isinstance(value, (list, tuple)) else []
    complete = tuple(row for row in rows if row is not None)
    return complete if len(rows) == len(complete) == 3 else None


def _output_unit(units: object) -> str:
    if isinstance(units, str):
        return units
    known = mapping(units)
    return str(known.get("output") or known.get("centre") or "output unit")


def _refusal(document: Mapping[str, object], calibration: Mapping[str, object]) -> str | None:
    if document.get("refused"):
        return words(document["refused"])
    if vector(calibration.get("scale_factor")) is None:
        return "The document holds no calibration."
    return None


def _unexplained(value: object) -> Unexplained | None:
    known = mapping(value)
    if not known:
        return None
    return Unexplained(
        bool(known.get("significant")),
        number(known.get("probability")),
        number(known.get("rms_g")),
        words(known.get("lead") or ""),
    )


def _findings(value: object, terms: set[str], verdict: str = "") -> Iterator[Finding]:
    """``verdict`` is that of entries which have none."""
    for known in _entries(value):
        effect = str(known.get("effect", ""))
        reason, remedy = known.get("reason"), known.get("remedy")
        yield Finding(
            effect=effect,
            verdict=str(known.get("verdict", verdict)),
            in_model=effect in terms,
            probability=number(known.get("probability")),
            coefficients=_coefficients(known.get("coefficients")),
            alternatives=texts(known.get("alternatives")),
            reason=None if reason is None else words(reason),
            remedy=None if remedy is None else words(remedy),
            probabilities=numbers(known.get("probabilities")),
            hangs_on_one_pose=known.get("hangs_on_one_pose") is True,
        )


def _coefficients(value: object) -> tuple[Coefficient, ...]:
    def one(name: str, entry: object) -> Coefficient:
        known = mapping(entry) if isinstance(entry, Mapping) else {"value": entry}
        unit = str(known.get("unit") or "")
        return Coefficient(str(name), number(known.get("value")), number(known.get("standard_error")), unit)

    return tuple(one(name, entry) for name, entry in mapping(value).items() if name != tc.interchange.WEIGHT)


def _linear(calibration: Mapping[str, object], units: object) -> Iterator[Coefficient]:
    errors, known_units = mapping(calibration.get("standard_error")), mapping(units)
    usual = {"scale_factor": f"{_output_unit(units)}/g", "misalignment": "rad", "bias": "g"}
    for name, symbol in (("scale_factor", "k"), ("misalignment", "α"), ("bias", "b")):
        values, value_errors = vector(calibration.get(name)), vector(errors.get(name))
        for i, axis in enumerate("xyz"):
            yield Coefficient(
                f"{tc.text.traces.effect_title(name)} {axis} ({symbol}{axis})",
                None if values is None else values[i],
                None if value_errors is None else value_errors[i],
                str(known_units.get(name) or usual[name]),
            )


def _poses(
    calibration: Mapping[str, object],
    matrix: tuple[Vector, ...] | None,
    centre: Vector | None,
    recordings: Mapping[str, str],
) -> Iterator[Pose]:
    entries = calibration.get("poses")
    for i, entry in enumerate(entries if isinstance(entries, (list, tuple)) else [], start=1):
        known = mapping(entry)
        mean = vector(known.get("mean"))
        yield Pose(
            number=i,
            mean=mean,
            direction=vector(known.get("direction")) or _direction(mean, matrix, centre),
            used=known.get("used") is None or bool(known["used"]),
            why="" if known.get("used") is None or known["used"] else _why(known),
            again=known.get("used") is False and (known.get("excluded") or known.get("left_out")) not in _NOT_AGAIN,
            recording=recordings.get(str(known.get("recording")), ""),
            channels=numbers(known.get("channels")),
            **{name: number(known.get(name)) for name in _OF_A_POSE},
        )


def _why(known: Mapping[str, object]) -> str:
    """Why a pose is excluded, in words."""
    return str(known.get("left_out") or known.get("excluded") or "").replace("spoiled", "outlier").replace("_", " ")


def _direction(mean: Vector | None, matrix: tuple[Vector, ...] | None, centre: Vector | None) -> Vector | None:
    if mean is None or matrix is None or centre is None:
        return None
    up = np.asarray(matrix) @ (np.asarray(mean) - np.asarray(centre))
    length = float(np.linalg.norm(up))
    return None if length == 0.0 else vector((up / length).tolist())


# What spoils poses, told apart from what is merely worth knowing about a recording.

_TAKE_AGAIN = "take again"
_NAMED = re.compile(rf"(.+?: )?({'|'.join(QUALITY)}): (.*)", re.DOTALL)
"""A fault, behind the recording's name where there are several."""


@dataclass(frozen=True)
class Fault:
    """A line of `data_quality`. ``spoils``: poses that have to be taken again."""

    title: str
    text: str
    spoils: bool


def faults_of(lines: Iterable[str]) -> tuple[Fault, ...]:
    """Those that spoil poses first."""
    found = []
    for line in lines:
        named = _NAMED.fullmatch(line)
        title, text = (QUALITY[named[2]], (named[1] or "") + named[3]) if named else ("", line)
        found.append(Fault(title, text, _TAKE_AGAIN in line))
    return tuple(sorted(found, key=lambda fault: not fault.spoils))


def left_out(poses: Sequence[Pose], unit: tc.units.ErrorUnit) -> tuple[str, ...]:
    """The poses that the fit did not use and that are to be taken again, with
    where they are and by how much they are off."""
    return tuple(
        f"Pose {pose.number}"
        + ("" if pose.start_s is None else f", at {pose.start_s:.1f} s")
        + (f" of {pose.recording}" if pose.recording else "")
        + ("" if pose.residual_g is None else f": off by {micro_g(pose.residual_g, unit)}")
        for pose in poses
        if pose.again
    )


# What a station put into the device: the registers, and what the device itself then
# measured.


@dataclass(frozen=True)
class Device:
    """Effects: ``held`` are in its registers, for ``host`` it has none,
    ``passing`` depend on how the poses were taken. ``checked`` are errors in g
    of the device's own output; ``correction`` are lines of what its registers leave and
    gain, of a device with a form of correction; ``state`` says in words what it
    holds now.
    """

    state: str
    not_written: str
    held: tuple[str, ...]
    host: tuple[str, ...]
    passing: tuple[str, ...]
    rounding_rms_g: float | None
    correction: tuple[str, ...]
    checked: tuple[tuple[str, float | None], ...]
    checked_verdict: str
    words: tuple[RegisterWord, ...]


def read_device(papers: Mapping[str, object]) -> Device | None:
    """None where the certificate tells nothing of a device."""
    known, checked = mapping(papers.get("registers")), mapping(papers.get("verification"))
    not_written = str(papers.get("not_written") or "")
    if not (known or checked or not_written):
        return None
    left = texts(known.get("left_to_host"))
    words = known.get("words")
    return Device(
        state=str(papers.get("device") or ""),
        not_written=not_written,
        held=tuple(name for name in texts(known.get("terms")) if name != "linear"),
        host=tuple(name for name in left if not passes(name)),
        passing=tuple(name for name in left if passes(name)),
        rounding_rms_g=number(known.get("rounding_rms_g")),
        correction=tuple(text.of_correction(known, number(known.get("rounding_rms_g")))) if "better" in known else (),
        checked=_checked(checked),
        checked_verdict=str(checked.get("verdict") or ""),
        words=tuple(_word(mapping(entry)) for entry in (words if isinstance(words, list) else [])),
    )


def passes(effect: str) -> bool:
    """Whether an effect of that name is the recording's rather than the unit's."""
    try:
        return is_passing(tc.effects.effect_named(effect))
    except KeyError:
        return effect in {e.name for e in tc.effects.BETWEEN_RUNS}


def _checked(known: Mapping[str, object]) -> tuple[tuple[str, float | None], ...]:
    if not known:
        return ()
    return (
        ("With the old registers, rms", number(known.get("before_rms_g"))),
        ("With the new registers, rms", number(known.get("after_rms_g"))),
        ("With the new registers, largest", number(known.get("after_max_abs_g"))),
        ("Noise floor of the check poses", number(known.get("noise_floor_g"))),
        ("Limit, rms", number(known.get("limit_rms_g"))),
    )


def _word(entry: Mapping[str, object]) -> RegisterWord:
    register, role, raw, unit = (clean(entry.get(key) or "") for key in ("register", "role", "raw", "unit"))
    wanted, held = number(entry.get("wanted")), number(entry.get("held"))
    return RegisterWord(register=register, role=role, raw=raw, wanted=wanted, held=held, unit=unit)
