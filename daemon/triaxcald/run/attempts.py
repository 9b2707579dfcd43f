"""Every attempt at a unit leaves an outcome, also that of a killed process.

A file in the station's folder stands for each attempt that is under way. It says what
an outcome needs, and is removed once the outcome is on the disk. The process holds a
lock on a file of its tray. The next start in the folder takes each attempt whose tray
nobody holds for one that was killed, repairs its recording and writes its outcome.
So it does where the disk failed: the file then has the outcome that the run ended with.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import triaxcal as tc
from triaxcald import text
from triaxcald.documents import to_text
from triaxcald.errors import DiskError, InputError, RecordingError
from triaxcald.files import is_of_the_disk, overwrite, synchronise, write_durably, write_new, write_text
from triaxcald.outcome import (
    ATTACHMENT,
    CERTIFICATE,
    REPORT,
    RUN_RECORD,
    SUFFIX,
    Code,
    Ending,
    Papers,
    outcome_document,
)
from triaxcald.provision.journal import FOLDER as JOURNALS
from triaxcald.provision.journal import parse
from triaxcald.provision.state import DeviceState, Evidence, Held, Observation
from triaxcald.recording.manifest import SealedContents, SignatureMade
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import Sealed, recover
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.recording.survey import survey
from triaxcald.signing.station import signing_of
from triaxcald.software import software
from triaxcald.station.config import Limits, Station
from triaxcald.station.lock import fcntl
from triaxcald.store import History
from triaxcald.utc import file_stamp, iso_time
from triaxcald.work import Attempt, Work, wrong

FOLDER: Final = "running"
FORMAT: Final = "triaxcal.attempt/1"
DAMAGED: Final = ".mcap.damaged"
"""Suffix of what a killed process left, where mending it loses something."""
ROOM: Final = 16384
"""Bytes of an attempt's file: one line for the attempt, and room for its outcome, which
an outcome without figures fills to a fifth."""
PAPERS: Final = (CERTIFICATE, REPORT)
"""Attachments that state an ending, which a killed run did not reach."""


@dataclass
class AttemptFile:
    """The file of an attempt under way, at a station with these ``limits``. ``serial``
    is the number that the unit itself has told, ``journal`` the path of a journal that
    an earlier run has left, ``held`` the state of the device once a provisioning is
    settled. ``outcome`` is what the run ended with, where its recording has no end."""

    path: Path
    tray: str
    station: str
    limits: Mapping[str, float | None]
    attempt: Attempt
    serial: str | None = None
    journal: str | None = None
    held: Held | None = None
    outcome: Mapping[str, Any] | None = None

    def write(self) -> None:
        """Write the file, and return once it is on the disk. Raises DiskError."""
        held = self.held
        document = {
            "format": FORMAT,
            "tray": self.tray,
            "station": self.station,
            "limits": dict(self.limits),
            "run": self.attempt.run,
            "started": self.attempt.started,
            "recording": self.attempt.recording,
            "work": self.attempt.work.document(),
            "serial": self.serial,
            "journal": self.journal,
            "held": None
            if held is None
            else {"state": held.state, "evidence": held.evidence, "observed": held.observations},
        }
        try:
            write_durably(self.path, (json.dumps(document) + "\n").ljust(ROOM - 1) + "\n")
        except OSError as e:
            raise DiskError(f"{self.path}: cannot be written: {e.strerror}") from e

    def keep(self, outcome: Mapping[str, Any]) -> None:
        """Put the outcome into the room that the file has for it, for the next start.
        Raises OSError."""
        line = json.dumps(outcome).encode()
        first = self.path.read_bytes().index(b"\n") + 1
        if first + len(line) >= ROOM:
            raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
        overwrite(self.path, first, line + b"\n")

    def remove(self) -> None:
        """Remove the file, since the outcome is on the disk. Raises nothing: the next
        start finds that outcome, and removes this file."""
        with suppress(OSError):
            self.path.unlink(missing_ok=True)

    @staticmethod
    def read(path: Path) -> AttemptFile | None:
        """None where the file is none of ours, or gone."""
        try:
            first, _, rest = path.read_bytes().partition(b"\n")
            held = json.loads(first)
            state, work = held["held"], Work(**held["work"])
            if any(isinstance(text, str) and wrong(text) for text in work.document().values()):
                return None
            return AttemptFile(
                path,
                str(held["tray"]),
                str(held["station"]),
                Limits.model_validate(held["limits"]).model_dump(),
                Attempt(
                    str(held["run"]),
                    str(held["started"]),
                    work,
                    held["recording"] if held["recording"] is None else Path(held["recording"]).name,
                ),
                held["serial"],
                held["journal"],
                None
                if state is None
                else Held(
                    DeviceState(state["state"]), Evidence(state["evidence"]), set(map(Observation, state["observed"]))
                ),
                _outcome_of(str(held["run"]), rest),
            )
        except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
            return None


@dataclass
class Attempts:
    """Attempts of one tray in a station's folder: of all units that are started
    together."""

    folder: Path
    tray: str
    station: str
    limits: Mapping[str, float | None] = field(default_factory=dict)
    _lock: int | None = field(default=None, init=False)

    @property
    def _within(self) -> Path:
        return self.folder / FOLDER

    @contextmanager
    def under_way(self) -> Iterator[None]:
        """Hold the tray's lock. Raises InputError if the folder cannot be made,
        DiskError if the disk takes nothing."""
        path = self._within / f"{self.tray}.lock"
        try:
            self._lock = _opened(path)
            synchronise(self.folder)
            if fcntl is not None:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as e:
            kind = DiskError if is_of_the_disk(e) else InputError
            raise kind(f"{self.folder}: no folder for recordings: {e.strerror}") from e
        try:
            yield
        finally:
            with suppress(OSError):
                if not any(self._of_tray()):
                    path.unlink(missing_ok=True)
                self._within.rmdir()  # which fails while another tray is in it
            os.close(self._lock)
            self._lock = None

    def begin(self, attempt: Attempt, journal: str | None = None) -> AttemptFile:
        """The file of an attempt that begins, on the disk. Raises DiskError."""
        path = self._within / f"{attempt.run}.json"
        file = AttemptFile(path, self.tray, self.station, self.limits, attempt, journal=journal)
        file.write()
        return file

    def _of_tray(self) -> Iterator[AttemptFile]:
        for path in self._within.glob("*.json"):
            file = AttemptFile.read(path)
            if file is not None and file.tray == self.tray:
                yield file


def _opened(path: Path) -> int:
    """A descriptor of the file, which is made with its folder. Raises OSError."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another tray has ended, and removed the empty folder
            return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)


@dataclass(frozen=True)
class Killed:
    """What was made of a killed attempt: its outcome, the path of the outcome, and a
    line for people."""

    document: Mapping[str, Any]
    path: Path
    line: str


def recordings_under_way(folder: Path) -> frozenset[str]:
    """Names of the recordings of attempts that have no outcome yet: they are under
    way, or were killed."""
    files = map(AttemptFile.read, (folder / FOLDER).glob("*.json"))
    return frozenset(file.attempt.recording for file in files if file is not None and file.attempt.recording)


def settle_killed(station: Station) -> list[Killed]:
    """Write the outcomes of all killed attempts in the station's folder, and seal the
    recordings that a failing disk has left without an end. Raises InputError,
    DiskError."""
    within = station.folder / FOLDER
    trays: dict[str, list[AttemptFile]] = {}
    for path in sorted(within.glob("*.json")):
        file = AttemptFile.read(path)
        if file is not None:
            trays.setdefault(file.tray, []).append(file)
    found = []
    for tray, files in trays.items():
        if fcntl is None:  # nobody knows whether its process is alive
            break
        try:
            with _abandoned(within / f"{tray}.lock") as abandoned:
                if abandoned:
                    found += [killed for file in files if file.path.exists() and (killed := _settle(station, file))]
        except OSError as e:
            raise DiskError(f"{e.filename or within}: {e.strerror}; a killed run has no outcome yet") from e
        except InputError as e:
            if isinstance(e.__cause__, OSError) and is_of_the_disk(e.__cause__) and not isinstance(e, DiskError):
                raise DiskError(f"{e}; a killed run has no outcome yet") from e.__cause__
            raise
    return found


@contextmanager
def _abandoned(path: Path) -> Iterator[bool]:
    """Whether no process holds the lock of the tray; it is held meanwhile, and its
    file removed at the end."""
    descriptor = _opened(path)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
            return
        yield True
        path.unlink(missing_ok=True)
        with suppress(OSError):
            path.parent.rmdir()
    finally:
        os.close(descriptor)


def _settle(station: Station, file: AttemptFile) -> Killed | None:
    """The outcome of a killed attempt; None if the attempt has one already."""
    name = file.attempt.recording
    recording = None if name is None else station.folder / name
    if recording is not None and not (recording.exists() and _run_of(recording) in (file.attempt.run, None)):
        recording = None  # it was not made, or is that of another run
    if _has_outcome(station.folder, file, recording):
        file.remove()
        return None
    attempt = replace(file.attempt, recording=None if recording is None else recording.name)
    document = None
    if recording is not None:
        try:
            document = _mended(station, file, attempt, recording)
            if document is None and _has_outcome(station.folder, file, recording):
                file.remove()
                return None
        except DiskError:
            raise
        except (RecordingError, tc.Refused):  # nothing in it can be read: it is kept, and is no recording
            os.replace(recording, recording.with_suffix(DAMAGED))
            attempt = replace(attempt, recording=None)
    beside = None if recording is None else recording.with_suffix(f".{ATTACHMENT}")
    mended, document = document is not None, document or _document(station, file, attempt, None)
    if beside is not None and (mended or _run_in(beside) == attempt.run):
        path = write_text(beside, to_text(document))
    else:
        stem = f"{attempt.work.slot}-{file.serial or 'unknown'}-{_stamp(attempt.started)}"
        path = write_new(station.folder, stem, SUFFIX, to_text(document))
    file.remove()
    told = text.killed(attempt.work.slot, attempt.started, path, document, station.path)
    return Killed(document, path, told)


def _has_outcome(folder: Path, file: AttemptFile, recording: Path | None) -> bool:
    """Whether the process had stored its outcome, and reported no other one. The
    documents beside a finished recording are completed from its attachments."""
    if recording is None:
        slot = file.attempt.work.slot
        return any(_run_in(path) == file.attempt.run for path in folder.glob(f"{slot}-*{SUFFIX}"))
    try:
        with Recording.open(recording) as finished:
            names = (*PAPERS, SIGNATURE_FILE, ATTACHMENT)
            held = {name: finished.attachments[name] for name in names if name in finished.attachments}
    except (RecordingError, InputError):
        return False
    if not _is_final(file, held.get(ATTACHMENT)):
        return False
    for name, data in held.items():
        path = recording.with_suffix(f".{name}")
        if not path.exists() or (name != CERTIFICATE and name != REPORT and file.outcome is not None):
            write_text(path, data.decode())
    return True


def _is_final(file: AttemptFile, stored: bytes | None) -> bool:
    """Whether a recording ends with the outcome of the attempt. A disk that fails at
    the very end may leave one that the run could not rely on, and did not report."""
    if stored is None or _run(stored) != file.attempt.run:
        return False
    return file.outcome is None or {**json.loads(stored), "contents": None} == {**file.outcome, "contents": None}


def _run_of(recording: Path) -> str | None:
    """The run of a recording by its metadata; None if it cannot be read."""
    try:
        with Recording.open(recording, unfinished=True) as found:
            return found.metadata.get(RUN_RECORD, {}).get("run")
    except (RecordingError, InputError):
        return None


def _run_in(path: Path) -> str | None:
    try:
        return _run(path.read_bytes())
    except OSError:
        return None


def _outcome_of(run: str, text: bytes) -> Mapping[str, Any] | None:
    """The outcome that the run ended with; None where nothing of it, or a part only,
    came to the disk."""
    return json.loads(text) if text.strip() and _run(text) == run else None


def _run(outcome: bytes) -> str | None:
    """The run of an outcome; None of what is none."""
    try:
        return str(json.loads(outcome)["run"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return None


def _mended(station: Station, file: AttemptFile, attempt: Attempt, recording: Path) -> dict[str, Any] | None:
    """Mend the recording, with the outcome as its last attachment; None if the killed
    process had stored its outcome there, which is final. Raises RecordingError,
    Refused, InputError."""
    draft, mended = (recording.with_suffix(f".mcap.{kind}") for kind in ("draft", "mended"))
    for path in (draft, mended):
        path.unlink(missing_ok=True)  # of a start that was killed itself
    document: dict[str, Any] | None = None
    without: tuple[str, ...]
    try:
        recover(recording, draft)
        with Recording.open(draft) as found:
            stored = found.attachments.get(ATTACHMENT)
        if stored is not None and _is_final(file, stored):
            outcome, without = stored, (ATTACHMENT,)
        else:
            # Once without the outcome, which lists what is in the file before it.
            draft.unlink()
            without = (ATTACHMENT, *PAPERS)
            recover(recording, draft, without=without)
            with Recording.open(draft) as found:
                contents = survey(found, ATTACHMENT).inventory.document()
            document = _document(station, file, attempt, contents)
            outcome = to_text(document).encode()
        signing = signing_of(station)
        with ExitStack() as until_there:
            signed: list[SignatureMade] = []

            def sign(contents: SealedContents) -> SignatureMade:
                assert signing is not None
                signed.append(until_there.enter_context(signing.sign(contents)))
                return signed[0]

            later = document is not None
            sealed = Sealed(
                ATTACHMENT, "application/json", _ended_ns(file), outcome, later, None if signing is None else sign
            )
            recovery = recover(recording, mended, without=without, sealed=sealed)
            if not recovery.lossless:  # what could not be read may be read by somebody else
                _keep(recording)
            os.replace(mended, recording)
            synchronise(recording.parent)
        for made in signed:
            write_text(recording.with_suffix(f".{made.name}"), made.data.decode())
    except OSError as e:
        raise DiskError(f"{recording}: cannot be mended: {e.strerror}") from e
    finally:
        for path in (draft, mended):
            path.unlink(missing_ok=True)
    return document


def _keep(recording: Path) -> None:
    """A second name for the file, so that at no moment the recording is missing.
    Raises OSError."""
    kept = recording.with_suffix(DAMAGED)
    kept.unlink(missing_ok=True)
    try:
        os.link(recording, kept)
    except OSError:  # a file system without links
        shutil.copyfile(recording, kept)


def _document(
    station: Station, file: AttemptFile, attempt: Attempt, contents: tc.interchange.Document | None
) -> dict[str, Any]:
    """The outcome that the run ended with, else that of a killed one."""
    if file.outcome is not None:
        return {**file.outcome, "recording": attempt.recording, "contents": contents}
    held, journal = _held(station, file)
    return dict(
        outcome_document(
            Ending(Code.KILLED.verdict, text.KILLED, -1, Code.KILLED),
            held,
            Papers(limits=file.limits, contents=contents),
            unit=attempt.work.slot,
            serial=file.serial,
            station=file.station,
            ended=iso_time(_ended_ns(file)),
            software=software(),
            supersedes=History.of(station.folder, file.serial).latest,
            journal=None if journal is None else str(journal),
            attempt=attempt,
        )
    )


def _held(station: Station, file: AttemptFile) -> tuple[Held, Path | None]:
    """State of the device, and the journal that is needed to settle it.

    The journal is on the disk before the first write. It is removed after the file of
    the attempt has the state of the settled device.
    """
    journal = _journal(station.folder, file)
    if journal is not None:
        return Held(DeviceState.UNKNOWN, Evidence.NO_ANSWER), journal
    return file.held or Held(), None


def _journal(folder: Path, file: AttemptFile) -> Path | None:
    """The journal of this run, or that of an earlier one which the run has found,
    whatever the station file names by now."""
    if file.journal is not None and Path(file.journal).exists():
        return Path(file.journal)
    for path in sorted((folder / JOURNALS).glob("*.json")):
        try:
            if parse(path.read_bytes(), where=str(path)).run == file.attempt.run:
                return path
        except (OSError, InputError):  # it may be of this run
            return path
    return None


def _ended_ns(file: AttemptFile) -> int:
    """The last sign of life: of the attempt's file or of its recording."""
    times = [file.path.stat().st_mtime_ns]
    if file.attempt.recording is not None:
        with suppress(OSError):
            times.append((file.path.parent.parent / file.attempt.recording).stat().st_mtime_ns)
    return max(times)


def _stamp(started: str) -> str:
    """For the name of a file, of a time in ISO 8601."""
    try:
        return file_stamp(int(datetime.fromisoformat(started).timestamp()) * 1_000_000_000)
    except ValueError:
        return "killed"
