"""Many recordings, of which none hides another."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.audit.conduct import Audit, audit
from triaxcald.audit.signature import Policy
from triaxcald.errors import DONE, OUTSIDE, SEVEREST, DaemonError, InputError, exit_code_of
from triaxcald.memory import out_of_memory, ran_out_of_memory

_WILD = frozenset("*?[")


@dataclass(frozen=True)
class Audited:
    """A recording and its audit, or the ``error`` for which there is none."""

    recording: str
    audit: Audit | None
    error: str | None = None
    exit_code: int = DONE


def to_audit(asked: Sequence[Path]) -> list[Path | Audited]:
    """Recordings, folders of recordings, and patterns, in the order in which they are
    given, each recording once. What names no recording is its own error."""
    found: dict[Path | str, Path | Audited] = {}
    for given in asked:
        try:
            found |= {path: path for path in _recordings_of(given) if path not in found}
        except InputError as e:
            found[str(given)] = Audited(str(given), None, str(e), exit_code_of(e))
    return list(found.values())


def audit_each(
    of: Iterable[Path | Audited],
    begins: Callable[[Path], None] = lambda path: None,
    policy: Policy = Policy(),  # noqa: B008 - frozen
) -> Iterator[Audited]:
    """Audit what `to_audit` found; ``begins`` is called before each recording, and
    ``policy`` is what is asked of signatures."""
    for one in of:
        if isinstance(one, Audited):
            yield one
        else:
            begins(one)
            yield _audited(one, policy)


def worst(of: Iterable[Audited]) -> int:
    codes = {a.exit_code for a in of}
    return next((code for code in SEVEREST if code in codes), DONE)


def _audited(path: Path, policy: Policy) -> Audited:
    try:
        found = audit(path, policy=policy)
    except (tc.TriaxcalError, td.DriverError, DaemonError) as e:
        return Audited(str(path), None, str(e), exit_code_of(e))
    except Exception as e:
        if not ran_out_of_memory(e):
            raise
        return Audited(str(path), None, f"{path}: {out_of_memory(e)}", exit_code_of(e))
    return Audited(str(path), found, exit_code=OUTSIDE if found.differences else DONE)


def _recordings_of(given: Path) -> list[Path]:
    """Raises InputError where there is none."""
    if given.is_dir():
        found = sorted(path for path in given.rglob("*.mcap") if not path.is_dir())
        if not found:
            raise InputError(f"{given}: Is a directory, without a recording (.mcap) in it")
        return found
    if not given.exists() and _WILD & set(str(given)):
        found = sorted(map(Path, glob.glob(str(given), recursive=True)))
        if not found:
            raise InputError(f"{given}: no file has a name like this")
        return [path for of in found for path in (_recordings_of(of) if of.is_dir() else [of])]
    return [given]
