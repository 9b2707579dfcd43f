"""Audits of many recordings, of which none hides another: a row each."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Final

import triaxcal_drivers as td
from triaxcald.audit import text
from triaxcald.audit.beside import NAMES
from triaxcald.audit.conduct import Audit, audit
from triaxcald.audit.signature import Policy
from triaxcald.errors import DONE, OUTSIDE, DaemonError
from triaxcald.many import COMMON_AFTER, COMMON_BEFORE, Column, Finding, Found, beside
from triaxcald.many.sources import LIST
from triaxcald.schema.columns import Kind
from triaxcald.signing.chain import NAME as CHAIN
from triaxcald.signing.trust import Trust, load_trust, nearest
from triaxcald.stores import is_url

ENDINGS: Final = (".mcap",)
"""Ends of names of recordings in a folder."""
MANIFESTS: Final = (*LIST, ".txt")
"""Ends of names of manifests: no text is a recording that could be audited."""

LINE_MOST: Final = 2**24
"""Bytes of a chain's first line that count: it lists the recordings from before."""

COLUMNS: Final[tuple[Column[Audit], ...]] = (
    *COMMON_BEFORE,
    Column("result", Kind.TEXT, "`same_bytes`, `same_figures`, `within` or `differs`", lambda a: a.result.value),
    Column("verdict", Kind.TEXT, "[verdict](outcome.md#verdict-and-code) of the run", lambda a: a.verdict),
    Column("serial", Kind.TEXT, "serial number of the unit", lambda a: a.serial),
    Column("run", Kind.TEXT, "id of the run", lambda a: a.run),
    Column("made_by", Kind.TEXT, "version that made the recording, if it is another one", lambda a: a.made_by),
    Column(
        "signature", Kind.TEXT, "`unsigned`, `trusted`, `untrusted`, `revoked` or `invalid`",
        lambda a: a.signature.state.value,
    ),
    Column("signed_by", Kind.TEXT, "name of the key", lambda a: a.signature.name),
    Column("signed_at", Kind.TEXT, "when, by the signature itself", lambda a: a.signature.signed),
    Column("differences", Kind.WHOLE, "number of differences", lambda a: len(a.differences)),
    Column(
        "first_difference", Kind.TEXT, "the first of them",
        lambda a: text.difference(a.differences[0]) if a.differences else None,
    ),
    Column(
        "of_uncertainty", Kind.NUMBER, "of `same_figures`: the largest difference of a figure in its uncertainty",
        lambda a: a.agreement.of_uncertainty if a.agreement.figures else None,
    ),
    *COMMON_AFTER,
)  # fmt: skip


def trust_digests(found: Iterable[Found], policy: Policy) -> list[tuple[str, str]]:
    """The trust files of recordings, with their SHA-256: a row that was stored under
    another one is done again. One that lies above a recording and cannot be used is an
    error of that recording alone. Raises InputError, ProfileError for the file that was
    given."""
    if policy.given is not None:
        trust = policy.trust_of(policy.given)
        assert trust is not None
        return [("", _trust_digest(trust))]  # wherever it lies
    paths = {path.parent: path for of in found if not is_url(of.name) for path in (Path(of.name),)}
    files = {file for path in paths.values() if (file := policy.file_of(path)) is not None}
    digests = []
    for file in sorted(files):
        try:
            digests.append((str(file), _trust_digest(load_trust(file))))
        except (DaemonError, td.ProfileError) as e:
            digests.append((str(file), f"unusable: {e}"))
    return digests


def _trust_digest(trust: Trust) -> str:
    return sha256(trust.file.model_dump_json().encode()).hexdigest()


def with_files_beside(found: Iterable[Found]) -> list[Found]:
    """Recordings whose stamps change with the files beside them, and with the start of
    the chain, which an audit compares with them."""

    @lru_cache(maxsize=1024)
    def start_of(folder: Path) -> str:
        at = nearest(folder, CHAIN)
        if at is None:
            return ""
        try:
            with at.open("rb") as file:
                return sha256(file.readline(LINE_MOST)).hexdigest()
        except OSError as e:
            return f"unreadable: {e.strerror}"

    return beside.with_files_beside(
        found,
        lambda path: [path.with_suffix(f".{name}") for name in NAMES],
        lambda path: start_of(path.parent) if isinstance(path, Path) else "",
    )


def audited(
    path: td.files.AnyPath,
    *,
    within: float | None = None,
    policy: Policy = Policy(),  # noqa: B008 - frozen
) -> Finding:
    """Raises what `audit` does; ``within`` and ``policy`` as there."""
    found = audit(path, within=within, policy=policy)
    return Finding(
        {column.name: column.value(found) for column in COLUMNS if column not in (*COMMON_BEFORE, *COMMON_AFTER)},
        OUTSIDE if found.differences else DONE,
        tuple(text.lines(found)),
        text.document(str(path), found),
    )
