"""The chain of a folder: what was removed, inserted, cut off, copied or set back, and what a crash leaves."""

from __future__ import annotations

import base64
import hashlib
import json
import multiprocessing
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Workshop
from tests.daemon.audit.forging import Forgery
from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import (
    SECOND_NS,
    Line,
    batch,
    lines_of,
    looked_at,
    outcome_digest,
    put_signature,
    when,
    write_lines,
)
from triaxcald.audit import Policy, audit_chain, chains_in
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import State
from triaxcald.cli.commands import main
from triaxcald.errors import DiskError, InputError, NotSigned
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording import disk
from triaxcald.recording.manifest import Retention
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.run.attempts import Attempts
from triaxcald.signing import chain
from triaxcald.signing.chain import OpenChain
from triaxcald.signing.keys import SigningKey
from triaxcald.signing.trust import load_trust
from triaxcald.station.config import Limits
from triaxcald.work import Attempt, Work

Keys = dict[str, SigningKey]
Make = Callable[[Line, Keys], object]


def removed(path: Path) -> None:
    for file in path.parent.glob(f"{path.stem}.*"):
        file.unlink()


def kinds(line: Line, **options: Any) -> list[Kind]:
    return [d.kind for d in audit_chain(line.folder, Policy(), **options).differences]


def test_an_untouched_folder_has_a_whole_chain(recorded: Line) -> None:
    found = audit_chain(recorded.folder)
    assert found.differences == ()
    assert (found.recordings, found.tombstones, found.earlier) == (4, 0, 1)
    assert found.head is not None
    assert found.head[0] == 4


# Forgeries.


def _line_removed(line: Line, keys: Keys) -> None:
    lines = lines_of(line.folder)
    write_lines(line.folder, lines[:2] + lines[3:])


def _removed_with_its_line(line: Line, keys: Keys) -> None:
    removed(line.made[2])
    _line_removed(line, keys)


def _removed_and_numbered_anew(line: Line, keys: Keys) -> None:
    """The lines after it get the numbers before; what is signed keeps its own."""
    removed(line.made[2])
    lines = lines_of(line.folder)
    write_lines(line.folder, [{**entry, "number": n} for n, entry in enumerate(lines[:2] + lines[3:])])


def _cut(line: Line, keys: Keys) -> None:
    """The last recordings with their lines: the folder is as it was two hours ago."""
    for path in line.made[3:]:
        removed(path)
    write_lines(line.folder, lines_of(line.folder)[:3])


def _lines_cut(line: Line, keys: Keys) -> None:
    removed(line.made[4])
    write_lines(line.folder, lines_of(line.folder)[:4])


def _emptied(line: Line, keys: Keys) -> None:
    (line.folder / chain.NAME).write_text("")


def _reordered(line: Line, keys: Keys) -> None:
    lines = lines_of(line.folder)
    lines[2], lines[3] = {**lines[3], "number": 2}, {**lines[2], "number": 3}
    write_lines(line.folder, lines)


def _inserted(line: Line, keys: Keys) -> None:
    """A recording that a stranger has signed, and a line for it in the middle."""
    other = line.folder.parent / "other"
    other.mkdir()
    path = Line(other, keys["stranger"]).record("extra.mcap")
    shutil.copy(path, line.folder / "extra.mcap")
    lines = lines_of(line.folder)
    lines.insert(2, {**lines_of(other)[1]})
    write_lines(line.folder, [{**entry, "number": n} for n, entry in enumerate(lines)])


def _of_another_chain(line: Line, keys: Keys) -> None:
    """By the same key, in another folder."""
    other = line.folder.parent / "other"
    other.mkdir()
    path = Line(other, line.key, line.now_ns).record("extra.mcap")
    shutil.copy(path, line.folder / "extra.mcap")


def _unsigned_inserted(line: Line, keys: Keys) -> None:
    line.record("extra.mcap", signed=False)


def _unsigned_of_old_inserted(line: Line, keys: Keys) -> None:
    Line(line.folder, line.key, line.now_ns - 10**7 * SECOND_NS).record("extra.mcap", signed=False)


def _copied(line: Line, keys: Keys) -> None:
    shutil.copy(line.made[1], line.folder / "again.mcap")


def _renamed(line: Line, keys: Keys) -> None:
    line.made[1].rename(line.folder / "other.mcap")
    line.made[1].with_suffix(f".{SIGNATURE_FILE}").unlink()


def _swapped(line: Line, keys: Keys) -> None:
    aside = line.folder / "aside"
    line.made[1].rename(aside)
    line.made[2].rename(line.made[1])
    aside.rename(line.made[2])


def _tombstone(line: Line, key: SigningKey, of: str, **change: Any) -> None:
    line.signing.__class__(key, line.folder, "bench", None, lambda: line.now_ns).bury(of, "unit-0002.mcap", "age")
    if change:
        lines = lines_of(line.folder)
        write_lines(line.folder, [*lines[:-1], {**lines[-1], **change}])


def _digest(line: Line, number: int) -> str:
    return str(lines_of(line.folder)[number]["digest"])


def _tombstone_forged(line: Line, keys: Keys) -> None:
    removed(line.made[2])
    stranger = replace(keys["stranger"], folder=None)
    _tombstone(line, stranger, _digest(line, 2))


def _tombstone_of_another(line: Line, keys: Keys) -> None:
    removed(line.made[2])
    removed(line.made[3])
    _tombstone(line, line.key, _digest(line, 3))


def _tombstone_moved(line: Line, keys: Keys) -> None:
    """One of another folder, by the same key."""
    other = Line(line.folder.parent / "other", replace(line.key, folder=None))
    other.folder.mkdir()
    removed(line.made[2])
    other.signing.bury(_digest(line, 2), "unit-0002.mcap", "age")
    lines = lines_of(line.folder)
    write_lines(line.folder, [*lines, {**lines_of(other.folder)[-1], "number": len(lines)}])


def _tombstone_edited(line: Line, keys: Keys) -> None:
    """Which was of another recording: its envelope is the key's, its payload is not."""
    import base64
    import hashlib

    removed(line.made[2])
    _tombstone(line, line.key, _digest(line, 3))
    lines = lines_of(line.folder)
    envelope = lines[-1]["envelope"]
    payload = json.loads(base64.b64decode(envelope["payload"]))
    data = json.dumps({**payload, "of": _digest(line, 2)}, sort_keys=True, separators=(",", ":")).encode()
    envelope = {**envelope, "payload": base64.b64encode(data).decode()}
    digest = hashlib.sha256(data).hexdigest()
    write_lines(line.folder, [*lines[:-1], {**lines[-1], "digest": digest, "envelope": envelope}])


def _start_replaced(line: Line, keys: Keys) -> None:
    """By a start that lists a recording that was made later."""
    later = Line(line.folder, line.key, line.now_ns - 10**7 * SECOND_NS).record("extra.mcap", signed=False)
    other = Line(line.folder.parent / "other", replace(line.key, folder=None))
    other.folder.mkdir()
    shutil.copy(later.with_suffix(f".{ATTACHMENT}"), other.folder)
    other.record()
    lines = lines_of(line.folder)
    write_lines(line.folder, [lines_of(other.folder)[0], *lines[1:]])


def _no_chain(line: Line, keys: Keys) -> None:
    (line.folder / chain.NAME).unlink()


def _line_garbled(line: Line, keys: Keys) -> None:
    path = line.folder / chain.NAME
    path.write_text(path.read_text().replace('"number": 3', '"number": "3"'))


def _clock_back(line: Line, keys: Keys) -> None:
    line.now_ns -= 3600 * SECOND_NS
    line.record()


def _late(line: Line, keys: Keys) -> None:
    """A recording with the times of an hour ago, closed now."""
    line.record(ended=when(line.now_ns - 3600 * SECOND_NS))


def _sidecar_alone(line: Line, keys: Keys) -> None:
    _cut(line, keys)
    shutil.rmtree(line.folder / "keys")
    shutil.copy(line.made[1].with_suffix(f".{SIGNATURE_FILE}"), line.folder / f"gone.{SIGNATURE_FILE}")


def _envelope_moved(line: Line, keys: Keys) -> None:
    put_signature(line.made[2], Forgery.of(line.made[1]).attachment(SIGNATURE_FILE).data)


@dataclass(frozen=True)
class Row:
    name: str
    make: Make
    kinds: frozenset[Kind]


def _row(name: str, make: Make, *found: Kind) -> Row:
    return Row(name, make, frozenset(found))


ROWS = [
    _row("the first removed", lambda line, _: removed(line.made[1]), Kind.REMOVED),
    _row("one in the middle removed", lambda line, _: removed(line.made[2]), Kind.REMOVED),
    _row("the last removed", lambda line, _: removed(line.made[4]), Kind.REMOVED),
    _row("a line removed", _line_removed, Kind.BROKEN),
    _row("one removed with its line", _removed_with_its_line, Kind.BROKEN, Kind.INSERTED),
    _row("one removed, the rest numbered anew", _removed_and_numbered_anew, Kind.BROKEN),
    _row("cut at the end", _cut, Kind.CUT),
    _row("cut by one", _lines_cut, Kind.CUT),
    _row("an empty chain", _emptied, Kind.CUT, Kind.INSERTED),
    _row("two lines in another order", _reordered, Kind.BROKEN),
    _row("a stranger's recording inserted", _inserted, Kind.UNTRUSTED, Kind.BROKEN),
    _row("a recording of another chain", _of_another_chain, Kind.INSERTED),
    _row("an unsigned recording", _unsigned_inserted, Kind.INSERTED),
    _row("an unsigned recording, dated back", _unsigned_of_old_inserted, Kind.INSERTED),
    _row("a copy", _copied, Kind.COPIED),
    _row("another name", _renamed, Kind.RENAMED),
    _row("two swapped", _swapped, Kind.RENAMED),
    _row("a tombstone by a stranger", _tombstone_forged, Kind.UNTRUSTED, Kind.REMOVED),
    _row("a tombstone of another recording", _tombstone_of_another, Kind.REMOVED),
    _row("a tombstone of another chain", _tombstone_moved, Kind.BROKEN, Kind.REMOVED),
    _row("a tombstone edited", _tombstone_edited, Kind.NOT_VERIFIED, Kind.REMOVED),
    _row("another start", _start_replaced, Kind.BROKEN),
    _row("no chain", _no_chain, Kind.NO_CHAIN),
    _row("a garbled line", _line_garbled, Kind.BROKEN),
    _row("the clock set back", _clock_back, Kind.CLOCK),
    _row("closed late", _late, Kind.LATE),
    _row("a signature without its recording", _sidecar_alone, Kind.REMOVED),
    _row("an envelope moved", _envelope_moved, Kind.REMOVED, Kind.COPIED),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_forged_chain_is_found_and_named(row: Row, line: Line, keys: Keys) -> None:
    row.make(line, keys)
    found = kinds(line)
    assert row.kinds <= set(found), found


def test_a_cut_is_found_by_a_head_that_was_noted_elsewhere(line: Line, keys: Keys) -> None:
    head = audit_chain(line.folder).head
    assert head is not None
    assert kinds(line, head=head[1]) == []
    _cut(line, keys)
    shutil.rmtree(line.folder / "keys")  # the key's own memory
    assert kinds(line) == []
    assert kinds(line, head=head[1]) == [Kind.CUT]


def test_a_start_that_lists_an_outcome_takes_only_that_one_for_earlier(recorded: Line) -> None:
    first = chain.said_in(chain.entry_of(chain.read_lines(recorded.folder / chain.NAME)[0]))
    assert isinstance(first, chain.Start)
    assert first.earlier == {outcome_digest(recorded.made[0])}


def test_the_start_lists_outcomes_that_are_in_recordings_alone(tmp_path: Path, key: SigningKey) -> None:
    line = Line(tmp_path, key)
    line.record("earlier.mcap", signed=False).with_suffix(f".{ATTACHMENT}").unlink()
    line.record()
    found = audit_chain(tmp_path)
    assert (found.differences, found.earlier) == ((), 1)


@pytest.mark.parametrize(("revoked", "older"), [({}, True), ({"revoked": when(0), "reason": "stolen"}, False)])
def test_the_start_of_a_revoked_key_makes_nothing_older(line: Line, revoked: dict[str, str], older: bool) -> None:
    path = line.folder / "trust.toml"
    trusted(line.folder, load_trust(path).file.since, line.key, **revoked)
    assert looked_at(line.made[0], Policy())[0].older is older


@pytest.mark.parametrize("meanwhile", ["a run ends", "the first run ends", "a recording is deleted"])
def test_what_happens_while_an_audit_reads_is_no_difference(
    line: Line, monkeypatch: pytest.MonkeyPatch, meanwhile: str, tmp_path: Path
) -> None:
    if meanwhile == "the first run ends":
        line = Line(tmp_path / "first", replace(line.key, folder=None))
        line.folder.mkdir()
    listed, once = Path.rglob, list[int]()

    def happens() -> None:
        if meanwhile == "a recording is deleted":
            line.signing.bury(_digest(line, 2), "unit-0002.mcap", "age")
            removed(line.made[2])
        else:
            for _ in range(2):
                line.record()

    def slow(path: Path, pattern: str) -> Any:
        if pattern != "*.mcap" or once:
            return listed(path, pattern)
        once.append(1)
        before = list(listed(path, pattern)) if meanwhile == "a run ends" else None
        happens()
        return listed(path, pattern) if before is None else before

    monkeypatch.setattr(Path, "rglob", slow)
    assert kinds(line) == []
    assert once


def test_a_folder_without_chain_and_signatures_is_an_error(tmp_path: Path, key: SigningKey) -> None:
    Line(tmp_path, key).record(signed=False)
    with pytest.raises(InputError):
        audit_chain(tmp_path)


# Deleting.


def test_a_tombstone_lets_a_recording_be_gone(line: Line) -> None:
    line.signing.bury(_digest(line, 2), "unit-0002.mcap", "older than two years")
    removed(line.made[2])
    found = audit_chain(line.folder)
    assert found.differences == ()
    assert (found.recordings, found.tombstones) == (4, 1)
    assert line.record()  # the chain goes on behind it
    assert kinds(line) == []


# Order, crashes, and processes.


def test_each_recording_names_the_one_before(recorded: Line) -> None:
    before = lines_of(recorded.folder)[0]["digest"]
    for number, path in enumerate(recorded.made[1:], start=1):
        signature, _ = looked_at(path, Policy())
        assert (signature.number, signature.previous) == (number, before)
        before = signature.digest


def _killed(folder: Path, key: SigningKey, now_ns: int, at: str) -> None:
    """A process that dies while it closes a recording."""

    def die(*_: Any) -> None:
        os._exit(9)

    if at == "before the file":
        note = OpenChain.note
        OpenChain.note = lambda *a: (note(*a), die())  # type: ignore[method-assign, assignment]
    elif at == "before the line":
        OpenChain.append = die  # type: ignore[method-assign, assignment]
    else:
        OpenChain.forget = die  # type: ignore[method-assign, assignment]
    Line(folder, key, now_ns).record("killed.mcap")


@pytest.mark.parametrize("at", ["before the file", "before the line", "after the line"])
def test_a_killed_process_leaves_a_chain_that_goes_on(line: Line, at: str) -> None:
    process = multiprocessing.get_context("fork").Process(
        target=_killed, args=(line.folder, line.key, line.now_ns, at), daemon=True
    )
    process.start()
    process.join(60)
    assert process.exitcode == 9
    assert (line.folder / chain.PENDING).exists()
    whole = at != "before the file"
    if whole:
        assert kinds(line) == []  # also before anybody completes the chain
    line.now_ns += 120 * SECOND_NS
    line.record()
    assert kinds(line) == []
    assert not (line.folder / chain.PENDING).exists()
    names = [entry.get("recording") for entry in lines_of(line.folder)]
    assert ("killed.mcap" in names) is whole
    assert len(names) == 7 - (not whole)


def _several(folder: Path, key: SigningKey, who: int) -> None:
    line = Line(folder, key)
    for i in range(8):
        line.record(f"unit-{who}-{i}.mcap")


def test_processes_that_close_recordings_in_one_folder_take_turns(tmp_path: Path, key: SigningKey) -> None:
    folder = tmp_path / "line"
    folder.mkdir()
    fork = multiprocessing.get_context("fork")
    processes = [fork.Process(target=_several, args=(folder, replace(key, folder=folder), who)) for who in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0, 0, 0]
    numbers = [entry["number"] for entry in lines_of(folder)]
    assert numbers == list(range(25))
    found = [d.kind for d in audit_chain(folder).differences]
    assert set(found) <= {Kind.CLOCK}, found  # each process has a clock of its own here


def test_a_line_that_was_not_written_to_its_end_is_written_anew(line: Line) -> None:
    path = line.folder / chain.NAME
    with open(path, "ab") as file:
        file.write(b'{"kind": "recor')
    line.record()
    assert kinds(line) == []
    assert len(lines_of(line.folder)) == 6


def test_a_recording_that_fails_at_its_end_is_not_in_the_chain(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    from triaxcald.recording.writer import RecordingFile

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(RecordingFile, "_write_end", full)
        with pytest.raises(Exception, match="No space left"):
            line.record("full.mcap")
    removed(line.folder / "full.mcap")
    line.record()
    assert kinds(line) == []
    assert [entry["number"] for entry in lines_of(line.folder)] == [0, 1, 2, 3, 4, 5]


def test_nothing_is_signed_into_a_chain_that_was_cut(line: Line, keys: Keys) -> None:
    _cut(line, keys)
    with pytest.raises(NotSigned):
        line.record()
    assert len(lines_of(line.folder)) == 3


def test_an_unreadable_chain_ends_the_signing(line: Line) -> None:
    with open(line.folder / chain.NAME, "ab") as file:
        file.write(b"what?\n")
    with pytest.raises(NotSigned):
        line.record()
    with pytest.raises(InputError):
        line.signing.require_works()


def test_the_head_of_a_long_chain_is_read_from_its_end(line: Line) -> None:
    """The start alone is longer than what is read first."""
    folder = line.folder.parent / "long"
    folder.mkdir()
    for i in range(1500):
        (folder / f"unit-{i}.outcome.json").write_text(str(i))
    other = Line(folder, replace(line.key, folder=folder))
    other.record()
    other.record()
    assert (folder / chain.NAME).stat().st_size > chain._TAIL
    assert [d.kind for d in audit_chain(folder, Policy(trust=line.folder / "trust.toml")).differences] == []


def test_a_revoked_key_keeps_its_chain_but_not_its_trust(line: Line) -> None:
    trusted(line.folder, when(line.now_ns), line.key, revoked=when(line.now_ns), reason="stolen")
    found = kinds(line)
    assert set(found) == {Kind.REVOKED, Kind.INSERTED}  # the start too: nothing says which recordings are earlier
    assert looked_at(line.made[1], Policy())[0].state is State.REVOKED


def test_retention_signs_a_tombstone_for_each_segment_that_it_deletes(line: Line) -> None:
    """A segment for which none can be signed stays."""
    assert _written(line, _cannot, keep_s=100.0).deleted == []
    deleted = _written(line, line.signing.bury, keep_s=100.0).deleted
    assert len(deleted) >= 3
    found = audit_chain(line.folder)
    assert (found.differences, found.tombstones) == ((), len(deleted))
    said = [chain.said_in(chain.entry_of(text)) for text in chain.read_lines(line.folder / chain.NAME)[5:]]
    assert [(s.of, s.recording, s.reason) for s in said if isinstance(s, chain.Tombstone)] == [
        (one.segment.sha256, one.segment.file, "age") for one in deleted
    ]


def _written(line: Line, bury: Any, batches: int = 5, **retention: Any) -> SegmentedWriter:
    writer = SegmentedWriter(
        line.folder / "log.segments.json", metadata={"bus": {}}, preview_channels=None, time_s=50.0,
        retention=Retention(**retention), bury=bury, clock_ns=lambda: line.now_ns, steady_ns=lambda: line.now_ns,
    )  # fmt: skip
    for i in range(batches):
        writer.raw("bus/0", batch(line.now_ns, i))
        line.now_ns += 60 * SECOND_NS
        writer.drain()
    writer.close()
    return writer


def _cannot(*_: Any) -> None:
    raise NotSigned("no key")


def test_the_tombstone_of_a_segment_is_of_its_bytes_not_of_what_the_manifest_states(line: Line) -> None:
    _written(line, _cannot, keep_s=100.0)
    digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in line.folder.glob("log-*.mcap")}
    manifest = line.folder / "log.segments.json"
    document = json.loads(manifest.read_text())
    for segment in document["segments"]:
        segment["sha256"] = _digest(line, 2)  # of a signed recording
    manifest.write_text(json.dumps(document))
    buried: list[tuple[str, str]] = []
    _written(line, lambda of, name, _: buried.append((name, of)), keep_s=100.0)
    assert set(digests.items()) & set(buried)
    assert _digest(line, 2) not in dict(buried).values()


def test_a_recording_that_finds_no_room_says_that_nothing_can_be_signed(
    line: Line, monkeypatch: pytest.MonkeyPatch
) -> None:
    _written(line, _cannot, keep_s=100.0)
    monkeypatch.setattr(disk, "free_bytes", lambda _: disk.END_BYTES - 1)
    with pytest.raises(DiskError, match="no deletion can be signed: no key"):
        _written(line, _cannot, free_bytes=2**62)


def test_a_segment_that_stays_is_buried_once(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    unlink, buried = Path.unlink, list[str]()

    def stays(path: Path, missing_ok: bool = False) -> None:
        if path.suffix == ".mcap":
            raise PermissionError(1, "not permitted")
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", stays)
    _written(line, lambda _, name, __: buried.append(name), 12, keep_s=100.0)
    assert len(buried) == len(set(buried)) >= 3


def test_a_recording_is_deleted_with_its_tombstone(line: Line, key: SigningKey, tmp_path: Path) -> None:
    station = Workshop(line.folder).station({"bus": {"host": "127.0.0.1", "port": 1}})
    delete = ["log", "delete", "--station", str(station), "--reason", "two years old"]
    assert main([*delete, str(line.made[2])]) == 2  # without a key
    assert key.folder is not None
    shutil.copy(key.folder / "line-1.key", line.folder / "keys")
    assert main([*delete, str(tmp_path / "elsewhere.mcap"), str(line.made[2])]) == 2
    assert line.made[2].exists()
    assert main([*delete, str(line.made[2])]) == 0
    assert not list(line.folder.glob("unit-0002.m*"))
    assert line.made[2].with_suffix(f".{ATTACHMENT}").exists()
    found = audit_chain(line.folder)
    assert (found.differences, found.tombstones) == ((), 1)


@pytest.fixture
def emptied(tmp_path: Path, key: SigningKey) -> Line:
    """A folder whose only recording was deleted with a tombstone, beside a trust file."""
    line = Line(tmp_path / "line", replace(key, folder=None))
    line.folder.mkdir()
    line.record()
    line.signing.bury(_digest(line, 1), line.made[0].name, "age")
    removed(line.made[0])
    trusted(line.folder, "2020-01-01T00:00:00+00:00", key)
    return line


def test_a_folder_whose_recordings_were_all_deleted_has_a_whole_chain(
    emptied: Line, capsys: pytest.CaptureFixture[str]
) -> None:
    table = emptied.folder.parent / "t.csv"
    assert main(["audit", "--json", str(emptied.folder)]) == 2
    capsys.readouterr()
    assert main(["audit", "--json", "--chain", str(emptied.folder), "-o", str(table)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["audits"] == []
    assert [(of["recordings"], of["tombstones"], of["codes"]) for of in told["chains"]] == [(1, 1, [])]
    assert len(table.read_text().splitlines()) == 1  # the names of the columns
    assert main(["audit", "--chain", str(emptied.folder), "--jobs", "2", "--memory", "1M"]) == 2


def _cut_to_its_start(line: Line, keys: Keys) -> None:
    write_lines(line.folder, lines_of(line.folder)[:1])


def _moved_below(line: Line, keys: Keys) -> None:
    (line.folder / "below").mkdir()
    (line.folder / chain.NAME).rename(line.folder / "below" / chain.NAME)


def _of_a_stranger(line: Line, keys: Keys) -> None:
    (line.folder / chain.NAME).unlink()
    other = Line(line.folder, replace(keys["stranger"], folder=None))
    other.record()
    other.signing.bury(_digest(other, 1), other.made[0].name, "age")
    removed(other.made[0])


def _without_trust(line: Line, keys: Keys) -> None:
    (line.folder / "trust.toml").unlink()


def _without_the_earlier_one(line: Line, keys: Keys) -> None:
    (line.folder / chain.NAME).unlink()
    line.made.clear()
    line.record(signed=False)
    line.record()
    line.signing.bury(_digest(line, 1), line.made[1].name, "age")
    for made in line.made:
        removed(made)


@pytest.mark.parametrize("options", [[], ["--allow-unsigned"]])
@pytest.mark.parametrize(
    "make", [_cut_to_its_start, _moved_below, _of_a_stranger, _without_trust, _without_the_earlier_one]
)
def test_an_empty_folder_without_proof_fails(
    emptied: Line, keys: Keys, make: Callable[[Line, Keys], None], options: list[str]
) -> None:
    make(emptied, keys)
    assert main(["audit", "--chain", str(emptied.folder), *options]) == 2


def test_a_signature_beside_nothing_may_name_anything(line: Line) -> None:
    body = json.loads(line.made[2].with_suffix(f".{SIGNATURE_FILE}").read_bytes())
    said = json.loads(base64.b64decode(body["payload"])) | {"recording": [1]}
    body["payload"] = base64.b64encode(json.dumps(said, sort_keys=True, separators=(",", ":")).encode()).decode()
    (line.folder / f"zz.{SIGNATURE_FILE}").write_text(json.dumps(body))
    assert Kind.REMOVED in kinds(line)


def test_a_tombstone_whose_key_is_not_trusted_is_told_from_none(line: Line, keys: Keys) -> None:
    """The file of the recording is gone; the reason is there, but does not count."""
    _tombstone_forged(line, keys)
    found = audit_chain(line.folder)
    gone = next(d for d in found.differences if d.kind is Kind.REMOVED)
    assert (found.tombstones, found.doubtful, gone.place) == (0, 1, str(len(lines_of(line.folder)) - 1))
    removed(line.made[3])
    gone = next(d for d in audit_chain(line.folder).differences if d.part == line.made[3].name)
    assert (gone.kind, gone.place) == (Kind.REMOVED, "")


@pytest.fixture
def delete(line: Line, key: SigningKey) -> list[str]:
    """The command, of a station that has its key."""
    assert key.folder is not None
    shutil.copy(key.folder / "line-1.key", line.folder / "keys")
    station = Workshop(line.folder).station({"bus": {"host": "127.0.0.1", "port": 1}})
    return ["log", "delete", "--json", "--station", str(station), "--reason", "age"]


def _cut_short(line: Line) -> None:
    data = line.made[2].read_bytes()
    line.made[2].write_bytes(data[: len(data) // 2])


def _empty(line: Line) -> None:
    line.made[2].write_bytes(b"")


def _under_way(line: Line) -> None:
    attempts = Attempts(line.folder, "tray", "bench", Limits().model_dump())
    with attempts.under_way():
        attempts.begin(Attempt("run", when(line.now_ns), Work("unit", "1"), recording=line.made[2].name))


@pytest.mark.parametrize("make", [_cut_short, _empty, _under_way])
def test_a_recording_that_is_being_made_is_not_deleted(
    line: Line, delete: list[str], make: Callable[[Line], None]
) -> None:
    make(line)
    assert main([*delete, str(line.made[1]), str(line.made[2])]) == 2
    assert all(path.exists() for path in line.made)
    assert len(lines_of(line.folder)) == 5


def test_a_recording_that_is_named_twice_gets_one_tombstone(
    line: Line, delete: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(line.folder)
    assert main([*delete, str(line.made[2]), line.made[2].name]) == 0
    assert json.loads(capsys.readouterr().out)["deleted"] == [str(line.made[2])]
    found = audit_chain(line.folder)
    assert (found.differences, found.tombstones) == ((), 1)


def test_what_was_deleted_is_told_where_the_next_one_fails(
    line: Line, delete: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    line.made[3].with_suffix(".report.html").mkdir()
    assert main([*delete, *map(str, line.made[2:4])]) == 2
    assert json.loads(capsys.readouterr().out)["deleted"] == [str(line.made[2])]
    assert [path.exists() for path in line.made[2:4]] == [False, True]
    assert kinds(line) == []


@pytest.mark.parametrize("of", ["a copy with another name", "a recording with the envelope of another"])
def test_a_tombstone_of_one_recording_does_not_bury_another(line: Line, delete: list[str], of: str) -> None:
    other = line.folder / "other.mcap"
    if of == "a copy with another name":
        shutil.copy(line.made[2], other)
    else:
        line.record("other.mcap", signed=False)
        put_signature(other, Forgery.of(line.made[2]).attachment(SIGNATURE_FILE).data)
    assert main([*delete, str(other)]) == 0
    assert kinds(line) == []
    removed(line.made[2])
    assert kinds(line) == [Kind.REMOVED]


def test_a_tombstone_under_another_name_is_of_no_entry(line: Line) -> None:
    line.signing.bury(_digest(line, 2), "other.mcap", "age")
    removed(line.made[2])
    assert kinds(line) == [Kind.REMOVED]


def test_a_station_whose_chain_is_gone_does_not_begin_another(line: Line, key: SigningKey) -> None:
    assert key.folder is not None
    other = Line(line.folder.parent / "new", line.key)
    other.folder.mkdir()
    other.record()
    (other.folder / chain.NAME).unlink()
    with pytest.raises(InputError):
        other.signing.require_works()
    with pytest.raises(NotSigned):
        other.record()
    for memory in chain.memories(line.folder / "keys"):
        if memory.of == str(other.folder.resolve()):
            memory.path.unlink()
    with pytest.raises(InputError):  # what was signed into it is still there
        other.signing.require_works()
    for path in other.folder.glob("unit-*.m*"):
        path.unlink()
    other.signing.require_works()
    other.record("again.mcap")
    assert audit_chain(other.folder).differences == ()


def test_each_chain_below_a_folder_is_its_own(line: Line, keys: Keys) -> None:
    below = line.folder / "station-2"
    below.mkdir()
    Line(below, line.key, line.now_ns).record("other.mcap")
    assert chains_in(line.folder) == [line.folder, below]
    assert chains_in(line.folder.parent) == [line.folder, below]
    assert [audit_chain(folder).differences for folder in chains_in(line.folder)] == [(), ()]
    assert chains_in(below / "nowhere") == [below / "nowhere"]


@pytest.mark.parametrize("left", ["recordings", "signatures", "the memory"])
def test_a_chain_below_does_not_hide_that_the_folder_s_own_is_gone(line: Line, left: str) -> None:
    below = line.folder / "station-2"
    below.mkdir()
    Line(below, line.key, line.now_ns).record("other.mcap")
    line.record()  # by which the key remembers the folder where it is now
    (line.folder / chain.NAME).unlink()
    if left != "recordings":
        for path in line.folder.glob("*.mcap"):
            path.unlink()
    if left == "the memory":
        for path in line.folder.glob("unit-*"):
            path.unlink()
    for asked in (line.folder, line.folder.parent):
        assert chains_in(asked) == [asked, below]
        found = {d.kind for folder in chains_in(asked) for d in audit_chain(folder).differences}
        assert Kind.NO_CHAIN in found


def test_a_chain_that_is_elsewhere_is_not_missed_here(line: Line, tmp_path: Path) -> None:
    """The key also signs in another folder."""
    (tmp_path / "other").mkdir()
    Line(tmp_path / "other", line.key, line.now_ns).record("other.mcap")
    assert chains_in(line.folder) == [line.folder]
    assert kinds(line) == []


def test_what_the_key_remembers_is_looked_for_in_all_folders_above(line: Line, keys: Keys) -> None:
    runs = line.folder / "a" / "b" / "runs"
    runs.mkdir(parents=True)
    other = Line(runs, line.key, line.now_ns)
    for _ in range(2):
        other.record()
    removed(other.made[1])
    write_lines(runs, lines_of(runs)[:2])
    assert [d.kind for d in audit_chain(runs).differences] == [Kind.CUT]
