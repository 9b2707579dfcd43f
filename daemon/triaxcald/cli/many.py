"""audit, and what it shares with batch: a command at many recordings."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import triaxcal_drivers as td
from triaxcald.abort import AbortNotice, at_abort
from triaxcald.cli.console import at, emit, erased, say, show
from triaxcald.errors import BAD_INPUT, DaemonError, InputError, exit_code_of, severest
from triaxcald.files import synchronise
from triaxcald.many import (
    Column,
    Done,
    Found,
    Pace,
    Row,
    Settings,
    Source,
    Table,
    Unusable,
    Work,
    attempt,
    is_current,
    limits,
    open_table,
    sources_of,
    unusable,
)
from triaxcald.stores import is_url

if TYPE_CHECKING:
    from triaxcald.audit import ChainAudit, Policy

FEW = 8
"""Fewer recordings than these are worked at here, unless processes are asked for:
starting two takes as long as two audits."""
MEMORY = 300 * 2**20
"""Bytes of a worker. numpy, scipy, matplotlib and dask take 170 MB of it, an audit of a
run of 30 poses some 60."""
MEMORY_LEAST = 200 * 2**20
"""Less than the 170 MB that a worker has before its first recording leaves room for
none: the worker would die at each."""
WAITING_S = 30.0
"""Without any worker for so long, that is said."""


@dataclass(frozen=True)
class Job:
    """What is done at each of the recordings ``found``. ``each`` shows a result,
    ``stopped`` says at an interrupt how far it came. ``is_whole``: all that a stored
    row tells of is there; ``refusal`` says why a recording is not worked at, by its
    stored row."""

    command: str
    doing: str
    work: Work
    columns: Sequence[Column[Any]]
    options: str
    found: Sequence[Found]
    each: Callable[[Done], None]
    stopped: Callable[[], str]
    is_whole: Callable[[Row], bool] = lambda row: True
    refusal: Callable[[Source, Row | None], str | None] = lambda source, row: None
    may_be_none: bool = False
    """Whether no recording at all is no error."""


def run_job(job: Job, a: argparse.Namespace) -> int:
    """The worst exit code of all. Raises InputError, also where there is no recording,
    DiskError, StationError."""
    if not job.found and not job.may_be_none:
        raise InputError(f"{', '.join(a.recordings)}: no recording is left to work at")
    processes = _processes(a, len(job.found))
    if processes is not None and a.memory is not None and a.memory < MEMORY_LEAST:
        raise InputError(f"--memory: a process needs at least {MEMORY_LEAST // 2**20}M; give more, or take --jobs 1")
    settings = Settings(
        sha256(f"{job.command}\n{job.options}".encode()).hexdigest()[:16],
        memory=a.memory if processes is None else a.memory or MEMORY,
    )
    with ExitStack() as stack:
        table = stack.enter_context(open_table(a.output, job.command, job.columns, resume=a.resume))
        engine = _Here(job, settings, table) if processes is None else _Elsewhere(job, settings, table, a, processes)
        stack.enter_context(at_abort(lambda _: AbortNotice(_stopped(job, a.output))))
        codes = {0}
        for done in engine.through():
            codes.add(done.exit_code)
            job.each(done)
            sys.stdout.flush()  # a signal that ends the work leaves no line in the buffer
        table.finish((of.name for of in job.found), a.recordings)
    return severest(codes)


def _stopped(job: Job, table: Path | None) -> str:
    return job.stopped() if table is None else f"{job.stopped()}; --resume goes on with {table}"


def _processes(a: argparse.Namespace, count: int) -> int | None:
    """How many workers of our own; 0 for those of a scheduler, None for this process.
    Raises ModuleNotFoundError where the extra is not installed and asked for."""
    if a.scheduler is not None:
        from triaxcald.many.cluster import require_dask

        require_dask()
        return 0
    if a.jobs is not None:
        if a.jobs == 1:
            return None
        from triaxcald.many.cluster import require_dask

        require_dask()
        return int(a.jobs)
    cores = limits.processors()
    if (most := limits.memory()) is not None:
        cores = min(cores, max(1, most // (a.memory or MEMORY)))
    if count < FEW or cores == 1 or td.hints.absent(("distributed",)):
        return None
    return min(cores, count)


class _Engine:
    """Results of a job as they come: those stored before, and new ones, which are
    stored before they are shown."""

    def __init__(self, job: Job, settings: Settings, table: Table) -> None:
        self._job, self._settings, self._table = job, settings, table
        self._pace = Pace(len(job.found), time.monotonic())

    def _plan(self, of: Found) -> Done | str | None:
        """The stored result that holds, or why there is no work to do; None where there
        is."""
        if isinstance(of, Unusable):
            return of.error
        row = self._table.stored(of.name)
        if row is not None and is_current(row, of, self._settings) and self._job.is_whole(row):
            return Done(of.name, row)
        return self._job.refusal(of, row)

    def _without_work(self, of: Found) -> Done | None:
        plan = self._plan(of)
        if isinstance(plan, str):
            code = of.exit_code if isinstance(of, Unusable) else BAD_INPUT
            return self._stored(unusable(of, plan, code, self._settings))
        if plan is not None:
            self._pace.skip(1)
        return plan

    def _stored(self, done: Done) -> Done:
        before = self._table.stored(done.name) if done.written else None
        self._table.store(done.row)
        self._pace.another(time.monotonic())
        return published(done, self._table, before)

    def _tell(self, what: str = "") -> None:
        if self._pace.total == 1:
            at(f"{self._job.doing} {self._job.found[0].name}")
        else:
            at(self._pace.line(self._job.doing) + what, self._pace.share)


class _Here(_Engine):
    """In this process, in the order given."""

    def through(self) -> Iterator[Done]:
        for of in self._job.found:
            known = self._without_work(of)
            if known is not None:
                yield known
            elif isinstance(of, Source):
                self._tell()
                supervised = self._pace.total > 1  # of one alone the trace tells more
                yield self._stored(attempt(self._job.work, of, self._settings, supervised=supervised))


class _Elsewhere(_Engine):
    """On other processes, in the order in which they are through."""

    def __init__(self, job: Job, settings: Settings, table: Table, a: argparse.Namespace, processes: int) -> None:
        super().__init__(job, settings, table)
        self._address, self._processes = a.scheduler, processes
        self._last_worker_s = time.monotonic()

    def through(self) -> Iterator[Done]:
        left = [of for of in self._job.found if isinstance(of, Source) and self._plan(of) is None]
        if not left:
            yield from self._others(set())
            return
        from triaxcald.many.cluster import cluster_at, local_cluster, results

        self._tell()
        with (  # before anything is stored: where none answers, the table stays as it is
            local_cluster(min(self._processes, len(left)), self._settings.memory)
            if self._address is None
            else cluster_at(self._address) as cluster
        ):
            yield from self._others({of.name for of in left})
            for done in results(cluster, self._job.work, left, self._settings, self._waits):
                yield self._stored(done)
                self._tell()

    def _others(self, left: set[str]) -> Iterator[Done]:
        for of in self._job.found:
            if of.name not in left and (done := self._without_work(of)) is not None:
                yield done

    def _waits(self, workers: int) -> None:
        now = time.monotonic()
        if workers:
            self._last_worker_s = now
        elif now - self._last_worker_s > WAITING_S:
            self._last_worker_s = now
            say(f"triaxcal: {self._address or 'this machine'}: no worker; waiting for one")
        self._tell("" if workers else "; no worker")


def published(done: Done, table: Table, before: Row | None) -> Done:
    """Gives the file that the work has written its name, now that its row is stored:
    over the file that the row ``before`` tells of, never over another one."""
    if done.written is None:
        return done
    temporary, final = map(Path, done.written)
    try:
        if before is not None and before.get("output") == str(final):
            os.replace(temporary, final)
        else:
            _take_name(temporary, final)
        synchronise(final.parent)
        return done
    except FileExistsError:
        error = f"{final}: exists already"
    except OSError as e:
        error = f"{final}: cannot be written: {e.strerror}"
    with suppress(OSError):
        temporary.unlink(missing_ok=True)
    row = {**done.row, "error": error, "exit_code": BAD_INPUT}
    table.store(row)
    return Done(done.name, row)


def _take_name(temporary: Path, final: Path) -> None:
    """Raises FileExistsError where the name is taken, and other OSError."""
    try:
        os.link(temporary, final)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        os.close(os.open(final, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        try:
            os.replace(temporary, final)
        except BaseException:
            final.unlink(missing_ok=True)
            raise
    else:
        temporary.unlink()


def own_files(a: argparse.Namespace) -> list[Path]:
    """Files that are no recordings, though they may lie among them."""
    return [a.output] if a.output is not None else []


def said_options(options: dict[str, Any]) -> str:
    """Options as text that is the same for the same options."""
    return "\n".join(f"{name}={value!r}" for name, value in sorted(options.items()) if value not in (None, False))


# audit.


def audit_command(a: argparse.Namespace) -> int:
    from triaxcald.audit import Policy, many, text  # the whole line, which no other command needs
    from triaxcald.signing.trust import load_trust

    _require_agreeing(a)
    elsewhere = a.scheduler is not None  # workers start from another folder, and may not have the trust file
    trust = load_trust(a.trust.absolute()) if elsewhere and a.trust is not None else a.trust
    policy = Policy(trust, a.allow_unsigned, tuple(Path(r).resolve() for r in a.recordings if os.path.isdir(r)))
    chains, broken = _audited_chains(a, policy)
    found = sources_of(a.recordings, many.ENDINGS, without=own_files(a), lists=many.MANIFESTS, absolute=elsewhere)
    if a.as_made:
        return _audit_as_made(a, found, policy)
    if a.output is not None:
        found = many.with_files_beside(found)
    left = [one for one in found if not _emptied(one, chains)]
    emptied, found = len(left) < len(found), left
    counts: Counter[str] = Counter()
    documents: dict[str, dict[str, Any]] = {}

    def each(done: Done) -> None:
        counts[text.outcome_of(done.row.get("result"))] += 1
        if done.error is not None:
            say(f"triaxcal: {done.error}")
        if a.json:
            documents[done.name] = dict(done.document or text.document_of_row(done.row))
        elif a.output is None or done.exit_code:
            for line in done.lines or text.lines_of_row(done.row):
                show(line)

    job = Job(
        "audit",
        "auditing",
        partial(many.audited, within=a.within, policy=policy),
        many.COLUMNS,
        said_options(
            {"within": a.within, "allow_unsigned": a.allow_unsigned, "trust": many.trust_digests(found, policy)}
        ),
        found,
        each,
        lambda: text.stopped(counts, len(found)),
        may_be_none=emptied,
    )
    code = run_job(job, a)
    if a.json:
        audits = [documents[of.name] for of in found]
        entries = [*map(text.chain_document, chains), *(text.chain_error(of.name, of.error) for of in broken)]
        told = {"chains": entries} if a.chain else {}
        emit({"format": "triaxcal.audit/1", "audits": audits, "summary": text.counts(counts), **told})
    else:
        if len(found) > 1 or a.output is not None:
            show(text.summary(counts))
        for line in chain(*map(text.chained, chains)):
            show(line)
    for failed in broken:
        say(f"triaxcal: {failed.error}")
    return severest([code, *(of.exit_code for of in chains), *(of.exit_code for of in broken)])


def _audited_chains(a: argparse.Namespace, policy: Policy) -> tuple[list[ChainAudit], list[Unusable]]:
    """And the folders whose chains cannot be audited, which hide no others. Raises
    InputError for options that do not go together."""
    from triaxcald.audit import audit_chain

    chains, broken = [], []
    for folder in _chains(a):
        try:
            chains.append(audit_chain(folder, policy, a.head))
        except (DaemonError, td.ProfileError) as e:
            broken.append(Unusable(str(folder), str(e), exit_code_of(e)))
    return chains, broken


def _emptied(of: Found, chains: Sequence[ChainAudit]) -> bool:
    """Whether it is a folder whose recordings were all deleted, as its own chain
    proves."""
    if not (isinstance(of, Unusable) and of.empty):
        return False
    return any(one.emptied and Path(one.folder).resolve() == Path(of.name).resolve() for one in chains)


def _chains(a: argparse.Namespace) -> list[Path]:
    """Folders whose chains are asked for. Raises InputError."""
    from triaxcald.audit import chains_in

    if a.head is not None and not a.chain:
        raise InputError("--head: only --chain compares it")
    if not a.chain:
        return []
    folders = [Path(given) for given in a.recordings]
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"{folder}: --chain takes folders of stations, expected a folder")
    found = [below for folder in folders for below in chains_in(folder)]
    if a.head is not None and len(found) > 1:
        raise InputError(f"--head: is of one chain, and {len(found)} are audited")
    return found


def _audit_as_made(a: argparse.Namespace, asked: Sequence[Found], policy: Policy) -> int:
    """Under the versions that made the recordings, one environment after the other.
    Signatures are checked here, since earlier versions know no trust file."""
    from triaxcald.audit import as_made
    from triaxcald.audit.wheels import Wheels

    if not asked:
        raise InputError(f"{', '.join(a.recordings)}: no recording is left to audit")
    wheels = Wheels.of(a.wheels)
    found, failed = as_made.grouped([Path(one.name) for one in asked if isinstance(one, Source)])
    failed = [*(one for one in asked if isinstance(one, Unusable)), *failed]
    for one in failed:
        say(f"triaxcal: {one.error}")
    parts: list[as_made.Part] = []
    for software, recordings in found.items():
        for part in as_made.audit_as_made(
            software, recordings, wheels, as_json=a.json, policy=policy, begins=_at, notes=say
        ):
            parts.append(part)
            if part.error is not None:
                say(f"triaxcal: {part.error}")
    if a.json and len(parts) == 1 and parts[0].output and not failed:
        sys.stdout.write(parts[0].output.decode(errors="replace"))
    elif a.json:
        emit(as_made.document_of(parts, failed, [one.name for one in asked]))
    unproven = as_made.unproven([path for recordings in found.values() for path in recordings], policy)
    for one in unproven:
        say(f"triaxcal: {one.error}")
    codes = [part.exit_code for part in parts] + [one.exit_code for one in (*failed, *unproven)]
    return as_made.worst_of(codes)


def _at(what: str) -> None:
    """Another program shows its own progress where there is nothing to say."""
    if not what:
        erased()
    at(what)


def _require_agreeing(a: argparse.Namespace) -> None:
    """Raises InputError where options do not go together."""
    if a.as_made and a.wheels is None:
        raise InputError("--as-made: needs --wheels FOLDER, with the wheels of the versions that made the recordings")
    if a.wheels is not None and not a.as_made:
        raise InputError("--wheels: only --as-made installs something")
    if a.as_made and a.within is not None:
        raise InputError("--within: under the versions that made it nothing may be off; leave out --as-made")
    here = [f"--{name}" for name in ("output", "resume", "jobs", "scheduler", "memory", "chain") if getattr(a, name)]
    if a.as_made and here:
        raise InputError(f"{here[0]}: --as-made audits one recording after the other, without a table")
    urls = [name for name in a.recordings if a.as_made and is_url(name)]
    if urls:
        raise InputError(f"{urls[0]}: --as-made audits files alone, since an earlier version may not read URLs")
