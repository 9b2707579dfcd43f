"""batch: poses, fit, diagnose, verify and apply at many recordings, a row each.

The work of each is that of the command, without its console. A worker calls it with
everything that it needs, but for the recording.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import secrets
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.cli.console import say, show, silent
from triaxcald.cli.fitting import chosen_way, diagnosed, still_poses
from triaxcald.cli.many import Job, own_files, run_job, said_options
from triaxcald.cli.measuring import applied_as, found_poses, require_own_times, verified_by, written
from triaxcald.cli.showing import judge
from triaxcald.errors import DONE, OUTSIDE, DiskError, InputError
from triaxcald.files import is_of_the_disk, synchronise_file
from triaxcald.inputs import DOCUMENT_MOST, Measured, document_bytes, parse_document
from triaxcald.many import COMMON_AFTER, COMMON_BEFORE, Column, Done, Finding, Found, Source, Unusable, sources_of
from triaxcald.many.beside import with_files_beside
from triaxcald.many.sources import MANIFEST
from triaxcald.many.work import Cell, Row
from triaxcald.schema.columns import Kind
from triaxcald.stores import is_url

ENDINGS: Final = (".mcap", MANIFEST, ".csv", ".csv.gz", ".parquet")
"""Ends of names of recordings in a folder. Other tables are named one by one."""
STEM: Final = re.compile(r"(.+?)(?:\.mcap|\.segments\.json|\.csv|\.csv\.gz|\.txt|\.txt\.gz|\.parquet|\.pq)?")
BESIDE: Final = "beside"
PART: Final = ".part"
"""End of the name of a file that is being written."""
_PART: Final = re.compile(rf"\.(.+)\.[0-9a-f]{{8}}{re.escape(PART)}")
BESIDE_ENDINGS: Final = (".cal.json", ".calibration.json", ".certificate.json")
"""Ends of names of a calibration beside a recording; the first that is there counts."""
FILES: Final = ("attitudes", "datasheet", "odds")
"""Options that name a file, which goes to the workers."""
NOT_OF_THE_WORK: Final = (
    "command", "part", "run", "computes", "recordings", "output", "resume", "jobs", "scheduler", "memory", "to",
)  # fmt: skip


@dataclass(frozen=True)
class Result:
    """What the work at one recording gives. ``document`` is that of the command."""

    document: Mapping[str, Any]
    measured: Measured | None = None
    fitted: tc.estimate.Calibration | None = None
    calibration: Calibration | None = None
    samples: int | None = None
    written: str | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """The document under which recordings are verified or applied."""

    name: str
    data: bytes

    @classmethod
    def read(cls, name: str) -> Calibration:
        """Raises InputError, InvalidData: not a calibration."""
        found = cls(name, document_bytes(name))
        found.calibration()
        return found

    @classmethod
    def beside(cls, path: td.files.AnyPath) -> Calibration:
        """Of a recording: raises InputError where none is beside it."""
        files = _calibrations_beside(path)
        for file in files:
            try:
                return cls(str(file), td.files.read_whole(file, DOCUMENT_MOST))
            except FileNotFoundError:
                continue
            except OSError as e:
                raise InputError(f"{file}: cannot be read: {e.strerror or e}") from e
        names = ", ".join(file.name for file in files)
        raise InputError(f"{path}: no calibration is beside it, expected one of {names}")

    def document(self) -> Mapping[str, Any]:
        return parse_document(self.data, where=self.name)

    def calibration(self) -> tc.Calibration:
        return tc.Calibration.from_dict(self.document(), where=self.name)


def stem_of(name: str) -> str:
    match = STEM.fullmatch(name)
    return match[1] if match else name


# Columns.


def _codes(lines: Sequence[str]) -> str | None:
    """ "missing_samples; saturation" of lines that begin with a code."""
    return "; ".join(dict.fromkeys(line.partition(":")[0] for line in lines)) or None


def _cautions(of: Result) -> str | None:
    names = (type(caution).__name__ for caution in (of.fitted.cautions if of.fitted else ()))
    return "; ".join(dict.fromkeys(re.sub(r"(?<=.)(?=[A-Z])", "_", name).lower() for name in names)) or None


def _measured(of: Result) -> Measured:
    assert of.measured is not None
    return of.measured


def _json(value: Any) -> str | None:
    return json.dumps(value, ensure_ascii=False) if value else None


def _noise(axis: int) -> Callable[[Result], Cell]:
    def rms(of: Result) -> Cell:
        errors = [p.standard_error[axis] for p in _measured(of).poses if not p.fault]
        return tc.rounding.uncertainty(float(np.sqrt(np.mean(np.square(errors))))) if errors else None

    return rms


def _at(*key: str | int) -> Callable[[Result], Cell]:
    """A cell out of the document; empty where it lacks it."""

    def value(of: Result) -> Cell:
        held: Any = of.document
        for k in key:
            if isinstance(held, list) and isinstance(k, int) and k < len(held):
                held = held[k]
            elif isinstance(held, Mapping):
                held = held.get(k)
            else:
                return None
        return held if isinstance(held, str | int | float) else None

    return value


_Columns = tuple[Column[Result], ...]
_UNIT: Final[_Columns] = (
    Column(
        "serial",
        Kind.TEXT,
        "serial number of the unit, if the recording has it",
        lambda of: (_measured(of).unit or {}).get("serial"),
    ),
    Column("poses", Kind.WHOLE, "number of still poses", lambda of: len(_measured(of).poses)),
    Column(
        "excluded",
        Kind.WHOLE,
        "those of them that cannot be trusted",
        lambda of: sum(bool(p.fault) for p in _measured(of).poses),
    ),
)
_QUALITY: Final[_Columns] = (
    Column(
        "data_quality",
        Kind.TEXT,
        "codes of [data quality](../explanation/data-quality.md), separated by `; `",
        lambda of: _codes(_measured(of).data_quality),
    ),
    Column("remarks", Kind.TEXT, "how a table was read", lambda of: "; ".join(_measured(of).remarks) or None),
)


def _coefficients(*place: str) -> Iterator[Column[Result]]:
    for name, unit in (("scale_factor", "output/g"), ("misalignment", "rad"), ("bias", "g")):
        for i, axis in enumerate("xyz"):
            column = f"{name}_{axis}"
            yield Column(column, Kind.NUMBER, f"coefficient [{unit}]", _at(*place, name, i))
            error = _at(*place, "standard_error", name, i)
            yield Column(f"{column}_standard_error", Kind.NUMBER, f"standard error of `{column}`", error)


def _residual(suffix: str, what: str, *place: str) -> Iterator[Column[Result]]:
    for name, meaning in (("rms", "rms residual"), ("cross_validated_rms", "cross-validated rms")):
        yield Column(f"{name}{suffix}_g", Kind.NUMBER, f"{meaning}{what} [g]", _at(*place, f"{name}_g"))


_FIT: Final[_Columns] = (
    *_UNIT,
    *_coefficients(),
    *_residual("", "", "residual"),
    Column(
        "noise_floor_g",
        Kind.NUMBER,
        "noise of the pose means along the measured vector [g]",
        _at("residual", "noise_floor_g"),
    ),
    Column(
        "lack_of_fit_p",
        Kind.NUMBER,
        "probability of such residuals under a complete model",
        _at("residual", "lack_of_fit_p"),
    ),
    Column("warnings", Kind.TEXT, "codes of the fit's warnings, separated by `; `", _cautions),
    *_QUALITY,
)
_DIAGNOSE: Final[_Columns] = (
    *_UNIT,
    Column("call", Kind.TEXT, "`usable`, `record_more` or `investigate`", _at("call")),
    *_coefficients("calibration"),
    *_residual("_before", " of the linear model", "before"),
    *_residual("", " of the final calibration", "after"),
    Column(
        "noise_floor_g",
        Kind.NUMBER,
        "noise of the pose means along the measured vector [g]",
        _at("after", "noise_floor_g"),
    ),
    Column(
        "effects",
        Kind.TEXT,
        "probability of each effect, a JSON object; `null`: not calibrated",
        lambda of: _json(of.document["probabilities"]),
    ),
    Column(
        "effect_coefficients",
        Kind.TEXT,
        "effects of the final calibration with coefficients and standard errors, a JSON object",
        lambda of: _json(of.document["calibration"].get("effects")),
    ),
    Column(
        "nothing_probability",
        Kind.NUMBER,
        "probability that nothing but the linear model acts",
        _at("nothing_probability"),
    ),
    Column(
        "unexplained_probability", Kind.NUMBER, "probability of an unmodelled part", _at("unexplained", "probability")
    ),
    Column("unexplained_kind", Kind.TEXT, "its likeliest kind", _at("unexplained", "kind")),
    Column("unexplained_rms_g", Kind.NUMBER, "its size in that case [g]", _at("unexplained", "rms_g")),
    Column("warnings", Kind.TEXT, "codes of the fit's warnings, separated by `; `", _cautions),
    *_QUALITY,
)
_CALIBRATION: Final[_Columns] = (
    Column(
        "calibration", Kind.TEXT, "the calibration document", lambda of: of.calibration.name if of.calibration else None
    ),
    Column(
        "calibration_sha256",
        Kind.TEXT,
        "SHA-256 of its bytes",
        lambda of: sha256(of.calibration.data).hexdigest() if of.calibration else None,
    ),
)
_WARNINGS = Column[Result](
    "warnings", Kind.TEXT, "sentences, separated by `; `", lambda of: "; ".join(of.warnings) or None
)
COLUMNS: Final[Mapping[str, _Columns]] = {
    "poses": (
        *_UNIT,
        Column("start_s", Kind.NUMBER, "start of the first pose [s from the first sample]", _at("poses", 0, "start_s")),
        Column(
            "end_s",
            Kind.NUMBER,
            "end of the last pose",
            lambda of: of.document["poses"][-1]["end_s"] if of.document["poses"] else None,
        ),
        *(
            Column(f"noise_{axis}", Kind.NUMBER, "rms standard error of the pose means [output]", _noise(i))
            for i, axis in enumerate("xyz")
        ),
        *_QUALITY,
    ),
    "fit": _FIT,
    "diagnose": _DIAGNOSE,
    "verify": (
        *_UNIT,
        *_CALIBRATION,
        *(
            Column(f"{name}_g", Kind.NUMBER, meaning, _at(f"{name}_g"))
            for name, meaning in (
                ("rms", "rms error of \\|a\\| [g]"),
                ("max_abs", "largest error [g]"),
                ("noise_floor", "of which noise makes [g]"),
                ("expected_rms", "rms error that noise and the calibration's uncertainty explain [g]"),
            )
        ),
        _WARNINGS,
        *_QUALITY,
    ),
    "apply": (
        *_CALIBRATION,
        Column("samples", Kind.WHOLE, "number of samples", lambda of: of.samples),
        Column("output", Kind.TEXT, "file with the calibrated readings", lambda of: of.written),
        _WARNINGS,
    ),
}
"""The columns of each command, between those of all tables."""


# The work at one recording.


@dataclass(frozen=True)
class Task:
    """A command with its options. ``files`` are those that options name, by option;
    ``calibration`` is None where it is beside each recording, or not needed."""

    command: str
    options: Mapping[str, Any]
    files: Mapping[str, tuple[str, bytes]]
    calibration: Calibration | None = None
    to: str | None = None
    ending: str = ".csv"

    def __call__(self, path: td.files.AnyPath) -> Finding:
        """Raises the errors of the command."""
        with silent(), self._arguments(path) as a:
            result, exit_code, temporary = _WORK[self.command](self, a, path)
        cells = {column.name: column.value(result) for column in COLUMNS[self.command]}
        return Finding(cells, exit_code, written=temporary)

    @contextmanager
    def _arguments(self, path: td.files.AnyPath) -> Iterator[argparse.Namespace]:
        """Those of the command for one recording; files are written for as long."""
        a = argparse.Namespace(**self.options, recording=str(path), json=False, output=None, report=None)
        with tempfile.TemporaryDirectory(prefix="triaxcal-") if self.files else _no_folder() as folder:
            for option, (name, data) in self.files.items():
                file = Path(folder) / name
                file.write_bytes(data)
                setattr(a, option, str(file))
            yield a

    def calibration_of(self, path: td.files.AnyPath) -> Calibration:
        return self.calibration or Calibration.beside(path)

    def final(self, name: str) -> Path:
        """The file that `apply` writes of a recording."""
        return Path(self.to or ".") / f"{stem_of(name.rpartition('/')[2])}{self.ending}"


@contextmanager
def _no_folder() -> Iterator[str]:
    yield ""


_Worked = tuple[Result, int, tuple[str, str] | None]


def _poses(task: Task, a: argparse.Namespace, path: td.files.AnyPath) -> _Worked:
    measured, document = found_poses(a)
    return Result(document, measured), DONE, None


def _fit(task: Task, a: argparse.Namespace, path: td.files.AnyPath) -> _Worked:
    measured, document, calibration, _ = (chosen_way(a) or still_poses)(a)
    exit_code = judge(a.limit, calibration.residual.rms_g, calibration.reference)
    return Result(document, measured, calibration), exit_code, None


def _diagnose(task: Task, a: argparse.Namespace, path: td.files.AnyPath) -> _Worked:
    measured, loop, document = diagnosed(a)
    exit_code = judge(a.limit, loop.after.residual.rms_g, loop.after.reference)
    return Result(document, measured, loop.after), exit_code, None


def _verify(task: Task, a: argparse.Namespace, path: td.files.AnyPath) -> _Worked:
    calibration = task.calibration_of(path)
    a.calibration = calibration.name
    found = verified_by(a, calibration.document())
    assert found.found.rms_g is not None
    exit_code = judge(a.limit, found.found.rms_g, found.calibration.fitted.reference)
    warnings = tuple(found.result["warnings"])
    return Result(found.result, found.measured, calibration=calibration, warnings=warnings), exit_code, None


def _apply(task: Task, a: argparse.Namespace, path: td.files.AnyPath) -> _Worked:
    calibration = task.calibration_of(path)
    found = applied_as(a, calibration.calibration())
    final = task.final(str(path))
    temporary = final.with_name(f".{final.name}.{secrets.token_hex(4)}{PART}")  # a worker that seemed dead has another
    try:
        samples = written(found, temporary, final.name)
        synchronise_file(temporary)
    except OSError as e:
        temporary.unlink(missing_ok=True)
        kind = DiskError if is_of_the_disk(e) else InputError
        raise kind(f"{final}: cannot be written: {e.strerror}") from e
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    warnings = (*found.remarks, *found.cautions)
    result = Result({}, calibration=calibration, samples=samples, written=str(final), warnings=warnings)
    return result, DONE, (str(temporary), str(final))


_WORK: Final[Mapping[str, Callable[[Task, argparse.Namespace, td.files.AnyPath], _Worked]]] = {
    "poses": _poses, "fit": _fit, "diagnose": _diagnose, "verify": _verify, "apply": _apply,
}  # fmt: skip


# The command.


def batch_command(a: argparse.Namespace) -> int:
    task = _task(a)
    found = sources_of(a.recordings, ENDINGS, without=own_files(a), absolute=a.scheduler is not None)
    found = _without_outputs(found, task, a.recordings)
    if task.calibration is None and getattr(a, "calibration", None) == BESIDE:
        found = with_files_beside(found, _calibrations_beside)
    if task.command == "apply":
        _require_apart(found, task)
    counts: Counter[str] = Counter()

    def each(done: Done) -> None:
        counts["failed" if done.error else "outside the limit" if done.exit_code == OUTSIDE else "done"] += 1
        if done.error is not None:
            say(f"triaxcal: {done.error}")

    columns = (*COMMON_BEFORE, *COLUMNS[task.command], *COMMON_AFTER)
    job = Job(
        f"batch {task.command}", f"{task.command} of many", task, columns, _said(task), found, each,
        lambda: f"{counts.total()} of {tc.number_format.number_of(len(found), 'recording')}{_told(counts)}",
        partial(_is_whole, task), partial(_refusal, task),
    )  # fmt: skip
    code = run_job(job, a)
    if task.command == "apply":
        _remove_parts(found, task)
    show(f"{tc.number_format.number_of(len(found), 'recording')}{_told(counts)}")
    return code


def _told(counts: Counter[str]) -> str:
    """ ": 11 done, 1 failed"."""
    told = ", ".join(f"{counts[name]} {name}" for name in ("done", "outside the limit", "failed") if counts[name])
    return f": {told}" if told else ""


def _task(a: argparse.Namespace) -> Task:
    """The options are checked once, before the first recording. Raises InputError."""
    options = {name: value for name, value in vars(a).items() if name not in NOT_OF_THE_WORK}
    calibration = None
    files = {}
    if "calibration" in options and options.pop("calibration") != BESIDE:
        calibration = Calibration.read(a.calibration)
    if a.part == "fit":
        chosen_way(argparse.Namespace(**options))
    for option in FILES:
        if options.get(option):
            files[option] = Path(options[option]).name, document_bytes(options[option])
    if a.part == "apply":
        require_own_times(a)
        try:
            a.to.mkdir(exist_ok=True)
        except OSError as e:
            raise InputError(f"--to {a.to}: no folder, and none can be made: {e.strerror}") from e
        options.pop("kind")
        return Task(a.part, options, files, calibration, str(a.to.absolute()), f".{a.kind}")
    return Task(a.part, options, files, calibration)


def _said(task: Task) -> str:
    """What the rows depend on, but for the recordings."""
    digests = {f"{option} (SHA-256)": sha256(data).hexdigest() for option, (_, data) in task.files.items()}
    calibration = sha256(task.calibration.data).hexdigest() if task.calibration else BESIDE
    plain = {name: value for name, value in task.options.items() if name not in task.files}
    return said_options({**plain, **digests, "calibration": calibration, "to": task.to, "ending": task.ending})


def _calibrations_beside(path: td.files.AnyPath) -> list[td.files.AnyPath]:
    """Files that `Calibration.beside` looks for."""
    return [path.with_name(stem_of(path.name) + ending) for ending in BESIDE_ENDINGS]


def _without_outputs(found: Sequence[Found], task: Task, asked: Sequence[str]) -> list[Found]:
    """Files in the folder that the work writes to are no recordings, where that folder
    lies below one that was asked for. Raises InputError for any other recording in
    it."""
    if task.to is None:
        return list(found)
    to = Path(task.to)
    below = any(Path(given).absolute() in to.parents for given in asked if not is_url(given))
    left = []
    for of in found:
        if is_url(of.name) or isinstance(of, Unusable) or Path(of.name).absolute().parent != to:
            left.append(of)
        elif not below or of.name in asked:
            raise InputError(f"{of.name}: lies in --to {to}; write to another folder")
    return left


def _remove_parts(found: Sequence[Found], task: Task) -> None:
    """What workers that were killed have left of the files of these recordings."""
    names = {task.final(of.name).name for of in found if isinstance(of, Source)}
    with suppress(OSError), os.scandir(str(task.to)) as entries:
        for entry in entries:
            if (match := _PART.fullmatch(entry.name)) and match[1] in names:
                with suppress(OSError):
                    os.unlink(entry.path)


def _require_apart(found: Sequence[Found], task: Task) -> None:
    """Raises InputError where two recordings would be written to one file."""
    names: dict[Path, str] = {}
    for of in found:
        if isinstance(of, Unusable):
            continue
        final = task.final(of.name)
        if final in names:
            raise InputError(f"{of.name}: would be written to {final}, as {names[final]} is; apply them apart")
        names[final] = of.name


def _is_whole(task: Task, row: Row) -> bool:
    """Whether what the stored row tells of is there."""
    return task.command != "apply" or (row.get("output") is not None and os.path.lexists(str(row["output"])))


def _refusal(task: Task, of: Source, row: Row | None) -> str | None:
    """Why a recording is not worked at: its file is there, and not by this table."""
    if task.command != "apply" or not os.path.lexists(final := task.final(of.name)):
        return None
    if row is not None and row.get("output") == str(final):
        return None
    return f"{final}: exists already; {of.name} is not applied"
