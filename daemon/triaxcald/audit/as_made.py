"""Audits under the versions that made a recording.

An environment of these versions is built of a folder of wheels and kept in the user's
cache; `triaxcal audit` runs in it. Nothing is downloaded: pip gets no index, no
configuration, and the wheels alone. What a recording says of its software is checked
before a command is made of it. Wheels are code that runs: whoever names the folder
trusts it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import packaging
from packaging.requirements import Requirement
from packaging.utils import InvalidName, canonicalize_name
from packaging.version import InvalidVersion, Version

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.abort import AbortNotice, at_abort
from triaxcald.audit import text
from triaxcald.audit.signature import Policy
from triaxcald.audit.signature import check as check_signature
from triaxcald.audit.wheels import Target, Wheels
from triaxcald.computer import KEYS
from triaxcald.errors import (
    DONE,
    INTERRUPTED,
    OUTSIDE,
    SEVEREST,
    DaemonError,
    InputError,
    RecordingError,
    exit_code_of,
    severest,
)
from triaxcald.many.sources import Unusable
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording.manifest import is_manifest
from triaxcald.recording.reader import Recording
from triaxcald.recording.survey import survey

SELF = "triaxcal"
SIGNED = "triaxcal[sign]"
PYTHON = "python"
NO_PACKAGES = (PYTHON, *KEYS)
"""Of what a recording says of its software: no package has these names."""
MINOR = re.compile(r"[0-9]{1,2}\.[0-9]{1,3}(?=\.|$)", re.ASCII)
RECORDINGS_MOST = 1000
"""Of one command in an environment: so many names fit on a command line."""
ABANDONED_S = 86_400.0
"""After a day, nobody builds on what was begun."""
_PROBE = """
import json, sys
sys.path.append(sys.argv[1])
from packaging.markers import default_environment
from packaging.tags import sys_tags
print(json.dumps({"tags": [str(tag) for tag in sys_tags()], "markers": default_environment()}))
"""
_ENTRY = """
import sys
from importlib.metadata import entry_points
sys.argv[0] = "triaxcal"
next(iter(entry_points(group="console_scripts", name="triaxcal"))).load()()
"""


@dataclass(frozen=True)
class Software:
    """Packages and their versions, by name, and the minor version of Python, where it
    is known, that made a recording."""

    packages: tuple[tuple[str, str], ...]
    python: str | None

    def __str__(self) -> str:
        python = f", Python {self.python}" if self.python else ""
        return ", ".join(f"{name} {version}" for name, version in self.packages) + python

    def requirements(self, *, signed: bool = False) -> list[Requirement]:
        """``signed``: with what verifies signatures."""
        names = {SELF: SIGNED} if signed else {}
        return [Requirement(f"{names.get(name, name)}=={version}") for name, version in self.packages]


def made_with(path: Path) -> Software:
    """Raises RecordingError where a recording does not say which software made it."""
    if is_manifest(path):
        raise RecordingError(f"{path}: a recording in segments, which holds no result to audit")
    with Recording.open(path) as recording:
        named = recording.metadata.get("software", {})
    if SELF not in named:
        raise RecordingError(f"{path}: metadata software: does not say which triaxcal made it")
    packages: dict[str, str] = {}
    for name, version in named.items():
        if name not in NO_PACKAGES:
            try:
                packages[canonicalize_name(name, validate=True)] = str(Version(version))
            except (InvalidName, InvalidVersion) as e:
                raise RecordingError(f"{path}: metadata software: {e}") from e
    others = sorted((name, version) for name, version in packages.items() if name != SELF)
    python = MINOR.match(named.get(PYTHON, ""))
    return Software(((SELF, packages[SELF]), *others), python[0] if python else None)


# The Python that runs them.


@dataclass(frozen=True)
class Interpreter:
    """``note`` where it is another than the recording names."""

    path: Path
    target: Target
    note: str = ""


def interpreter_for(python: str | None) -> Interpreter:
    """That of the minor version, where it is on the PATH, else this one."""
    here = Path(sys.executable)
    if python is None or python == _minor_of(sys.version_info[:2]):
        return Interpreter(here, _target(here))
    found = shutil.which(f"python{python}")
    target = _probed(Path(found)) if found else None
    if found and target is not None and target.markers.get("python_version") == python:
        return Interpreter(Path(found), target)
    this = _minor_of(sys.version_info[:2])
    return Interpreter(here, _target(here), f"python{python} is not on the PATH; Python {this} takes its place")


def _minor_of(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def _target(python: Path) -> Target:
    target = _probed(python)
    if target is None:
        raise InputError(f"{python}: does not run, which is needed for --as-made")
    return target


def _probed(python: Path) -> Target | None:
    """Of a Python that may be no more than a name: None where it does not run."""
    library = Path(packaging.__file__).parents[1]
    try:
        done = subprocess.run(
            [python, "-I", "-c", _PROBE, library], capture_output=True, stdin=subprocess.DEVNULL, check=True
        )
        said = json.loads(done.stdout)
        return Target(frozenset(said["tags"]), said["markers"])
    except (OSError, subprocess.CalledProcessError, ValueError, LookupError):
        return None


# Environments, one for each set of versions, each built once.


def environment(software: Software, wheels: Wheels, python: Interpreter) -> Path:
    """The Python of an environment that has the software, built where the cache has
    none of it. Raises InputError with all that the wheels lack."""
    requirements, needed = required(software, wheels, python.target)
    if any(wheels.chosen(requirement, python.target) is None for requirement in requirements):
        raise InputError(f"--wheels {wheels.folder}: lacks {'; '.join(needed)}")
    folder = cache_folder() / _name_of(requirements, wheels, python)
    if not _python_in(folder).exists():
        try:
            _build(folder, requirements, wheels, python)
        except _Refused as e:
            lacks = f"lacks {'; '.join(needed)}" if needed else f"pip cannot install {software} from it: {e}"
            raise InputError(f"--wheels {wheels.folder}: {lacks}") from e
        except OSError as e:
            raise InputError(f"{folder}: cannot be built: {e.strerror or e}") from e
    return _python_in(folder)


def required(software: Software, wheels: Wheels, target: Target) -> tuple[list[Requirement], list[str]]:
    """What is to be installed, and what lacks for it. What verifies signatures is
    installed where the wheels have it."""
    plain, signed = software.requirements(), software.requirements(signed=True)
    needed = wheels.missing(plain, target)
    return (plain, needed) if needed or wheels.missing(signed, target) else (signed, [])


def cache_folder() -> Path:
    """Of the user, by the XDG Base Directory Specification."""
    said = os.environ.get("XDG_CACHE_HOME", "")
    try:
        root = Path(said) if Path(said).is_absolute() else Path.home() / ".cache"
    except RuntimeError as e:
        raise InputError("there is no home folder for the cache; XDG_CACHE_HOME names another") from e
    return root / "triaxcal" / "as-made"


def _name_of(requirements: Sequence[Requirement], wheels: Wheels, python: Interpreter) -> str:
    """By the versions, the Python and the wheels of these versions: another build makes
    another environment."""
    digest = hashlib.sha256()
    for part in (str(python.path.resolve()), python.target.markers.get("python_full_version", "")):
        digest.update(f"{part}\0".encode())
    for requirement in requirements:
        wheel = wheels.chosen(requirement, python.target)
        assert wheel is not None
        with open(wheel.path, "rb") as file:
            digest.update(f"{requirement}\0{hashlib.file_digest(file, 'sha256').hexdigest()}\0".encode())
    version = str(requirements[0].specifier).removeprefix("==")
    return f"{SELF}-{version}-python{python.target.markers.get('python_version', '')}-{digest.hexdigest()[:16]}"


def _python_in(folder: Path) -> Path:
    return folder / "Scripts" / "python.exe" if os.name == "nt" else folder / "bin" / "python"


class _Refused(Exception):
    """What pip or venv says."""


def _build(folder: Path, requirements: Iterable[Requirement], wheels: Wheels, python: Interpreter) -> None:
    """Under another name until it is whole. Raises _Refused and OSError."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    _remove_abandoned(folder.parent)
    begun = Path(tempfile.mkdtemp(prefix=".building-", dir=folder.parent))
    try:
        with at_abort(lambda _: shutil.rmtree(begun, ignore_errors=True)):
            _call(python.path, "-I", "-m", "venv", begun)
            links = begun / "wheels"
            links.mkdir()
            for wheel in (wheel for of in wheels.by_name.values() for wheel in of):
                (links / wheel.path.name).symlink_to(wheel.path.resolve())  # an index.html beside them is no wheel
            _call(
                _python_in(begun), "-I", "-m", "pip", "install", "--isolated", "--no-index", "--find-links", links,
                "--only-binary", ":all:", "--no-input", "--disable-pip-version-check", "--quiet",
                "--no-warn-script-location", *map(str, requirements),
            )  # fmt: skip
            shutil.rmtree(links)
        if folder.exists() and not _python_in(folder).exists():  # the Python that it was of is gone
            shutil.rmtree(folder)
        try:
            begun.rename(folder)
        except OSError:
            if not _python_in(folder).exists():
                raise  # else another process was faster
    finally:
        shutil.rmtree(begun, ignore_errors=True)


def _remove_abandoned(cache: Path) -> None:
    """What builds that were killed have left."""
    for begun in cache.glob(".building-*"):
        with suppress(OSError):
            if time.time() - begun.stat().st_mtime > ABANDONED_S:
                shutil.rmtree(begun, ignore_errors=True)


def _call(*command: str | Path) -> None:
    """Raises OSError, and _Refused with what the command says."""
    own = {name: value for name, value in os.environ.items() if not name.startswith("PIP_")}
    process = subprocess.Popen(
        command,
        env={**own, "PIP_CONFIG_FILE": os.devnull},  # pip then reads no configuration
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,  # ended by us, with all that it started
    )

    def end(_: float) -> AbortNotice | None:
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL) if hasattr(os, "killpg") else process.kill()
        return None

    with at_abort(end):
        said, _ = process.communicate()
    if process.returncode:
        lines = [line.strip() for line in said.splitlines() if line.strip()]
        told = [line for line in lines if line.startswith("ERROR:")] or lines[-1:]
        raise _Refused(told[0].removeprefix("ERROR:").strip() if told else f"exit code {process.returncode}")


# Audits in them.


@dataclass(frozen=True)
class Part:
    """Recordings of one software, and what `triaxcal audit` left of them: its exit code
    and, of ``--json``, its standard output. ``error`` where it could not run."""

    recordings: tuple[Path, ...]
    exit_code: int
    output: bytes = b""
    error: str | None = None


def grouped(asked: Iterable[Path]) -> tuple[dict[Software, list[Path]], list[Unusable]]:
    """Recordings by the software that made them, and those that do not say it."""
    found: dict[Software, list[Path]] = {}
    failed = []
    for path in asked:
        try:
            found.setdefault(made_with(path), []).append(path)
        except (DaemonError, td.DriverError) as e:
            failed.append(Unusable(str(path), str(e), exit_code_of(e)))
    return found, failed


def unproven(recordings: Iterable[Path], policy: Policy) -> list[Unusable]:
    """Recordings whose signatures do not pass, by this version's ``policy``."""
    found = []
    for path in recordings:
        try:
            with Recording.open(path) as recording:
                attachments = {name: data for name, data in recording.attachments.items() if "/" not in name}
                _, differences = check_signature(path, attachments, survey(recording, ATTACHMENT), policy)
            found += [Unusable(str(path), f"{path}: {text.difference(d)}", OUTSIDE) for d in differences]
        except (DaemonError, td.DriverError, td.ProfileError) as e:
            found.append(Unusable(str(path), str(e), exit_code_of(e)))
    return found


def audit_as_made(
    software: Software,
    recordings: Sequence[Path],
    wheels: Wheels,
    *,
    as_json: bool,
    policy: Policy,
    begins: Callable[[str], None],
    notes: Callable[[str], None],
) -> Iterator[Part]:
    """Audit ``recordings`` that one software made. Text goes to the standard streams as
    it comes; ``as_json`` keeps the document. ``begins`` is called before long work,
    with what it is, and with nothing before an audit, which says so itself; ``notes``
    with what the caller should know."""
    python = interpreter_for(software.python)
    if python.note:
        notes(f"note: {python.note}")
    begins(f"building an environment of {software}")
    try:
        inner = environment(software, wheels, python)
    except InputError as e:
        yield Part(tuple(recordings), exit_code_of(e), error=str(e))
        return
    finally:
        begins("")
    for i in range(0, len(recordings), RECORDINGS_MOST):
        some = tuple(recordings[i : i + RECORDINGS_MOST])
        notes(f"note: {tc.number_format.number_of(len(some), 'recording')} under {software}")
        yield _audited(inner, some, [*(["--json"] if as_json else []), *_known_there(inner, policy)], as_json=as_json)


def _known_there(python: Path, policy: Policy) -> list[str]:
    """The options of the ``policy``, as far as that version has them; one without them
    checks no signature."""
    options = [] if policy.given is None else ["--trust", str(policy.given.absolute())]
    options += ["--allow-unsigned"] if policy.allow_unsigned else []
    if not options:
        return []
    help_ = subprocess.run(
        [python, "-I", "-c", _ENTRY, "audit", "--help"], stdin=subprocess.DEVNULL, capture_output=True, check=False
    )
    return options if b"--allow-unsigned" in help_.stdout else []


def _audited(python: Path, recordings: tuple[Path, ...], options: list[str], *, as_json: bool) -> Part:
    sys.stdout.flush()
    process = subprocess.Popen(
        [python, "-I", "-c", _ENTRY, "audit", *options, "--", *recordings],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE if as_json else None,
    )

    def end(_: float) -> AbortNotice | None:
        with suppress(OSError):
            os.kill(process.pid, signal.SIGTERM)
        return None

    with at_abort(end):
        output, _ = process.communicate()
    if process.returncode < 0:
        error = f"the audit under the recorded versions was ended by signal {-process.returncode}"
        return Part(recordings, INTERRUPTED, error=error)
    return Part(recordings, process.returncode, output or b"")


def document_of(parts: Iterable[Part], failed: Iterable[Unusable], order: Iterable[str]) -> dict[str, Any]:
    """One `triaxcal.audit/1` of several, its entries in the ``order`` of recordings."""
    entries = {one.name: text.document(one.name, None, one.error) for one in failed}
    for part in parts:
        held, error = {}, part.error
        try:
            held = {entry["recording"]: entry for entry in json.loads(part.output)["audits"]} if not error else {}
        except (ValueError, LookupError, TypeError):
            error = f"the audit under the recorded versions ended with {part.exit_code} and without a document"
        for name in map(str, part.recordings):
            entries[name] = held.get(name) or text.document(name, None, error or "not audited")
    audits = [entries[name] for name in dict.fromkeys(order) if name in entries]
    told = Counter("unreadable" if a["error"] else "differ" if a["differences"] else "agree" for a in audits)
    summary = {"recordings": len(audits), **{name: told[name] for name in ("agree", "differ", "unreadable")}}
    return {"format": "triaxcal.audit/1", "audits": audits, "summary": summary}


def worst_of(codes: Iterable[int]) -> int:
    """Of exit codes; one that this version does not know counts most."""
    found = set(codes)
    unknown = found - set(SEVEREST)
    return max(unknown) if unknown else severest(found | {DONE})
