"""The journal is on the disk before anything is written, and says all that it takes to go on."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.daemon.provision.host import Host
from tests.devices.habits import Habits
from triaxcald.errors import DiskError, InputError
from triaxcald.provision.journal import Entry, Journal, parse

ENTRY = Entry(
    unit="left",
    serial="0007",
    profile_sha256="ab" * 32,
    started="2026-03-02T09:00:00+00:00",
    before={"bias_x": b"\x00\x01", "crc": b"\xff\xff"},
    wanted={"bias_x": b"\x00\x02", "crc": b"\x12\x34"},
    step="storing",
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    journal = Journal.of(tmp_path, "left", "0007")
    journal.write(ENTRY)
    assert journal.path == tmp_path / "journal" / "0007.json"
    assert journal.read() == ENTRY


def test_a_device_without_a_serial_number_has_its_journal_by_its_name(tmp_path: Path) -> None:
    assert Journal.of(tmp_path, "left", None).path == tmp_path / "journal" / "unit-left.json"


def test_without_a_journal_nothing_was_cut_short(tmp_path: Path) -> None:
    assert Journal.of(tmp_path, "left", "0007").read() is None


def test_file_and_folder_are_on_the_disk_when_it_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are synchronised: the contents before the file has its name, the folder after."""
    order: list[tuple[str, str]] = []
    replace, fsync = os.replace, os.fsync

    def replaced(*paths: Path) -> None:
        order.append(("replace", ""))
        replace(*paths)

    def synchronised(descriptor: int) -> None:
        order.append(("fsync", os.readlink(f"/proc/self/fd/{descriptor}")))
        fsync(descriptor)

    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(os, "fsync", synchronised)
    journal = Journal.of(tmp_path, "left", "0007")
    journal.write(ENTRY)
    at = [what for what, _ in order].index("replace")
    assert any(path.startswith(str(journal.path.parent / ".0007.json")) for _, path in order[:at])
    assert ("fsync", str(journal.path.parent)) in order[at:]


async def test_it_is_there_before_the_first_register_is_written(tmp_path: Path) -> None:
    host = Host(tmp_path, Habits())
    kept = []
    write = host.unit.write

    def looked_at(register: str, raw: bytes, now: float) -> float:
        kept.append((register, [parse(p.read_bytes(), where="") for p in host.journals]))
        return write(register, raw, now)

    host.unit.write = looked_at  # type: ignore[method-assign]
    assert await host.provision()
    stored = [register for register, _ in kept].index("store")  # after it a value shows the restart
    writes = {register: entries for register, entries in kept[:stored] if register in host.old}
    assert set(writes) == {name for name, raw in host.old.items() if host.new[name] != raw}
    assert all(entry.before == host.old and entry.step == "writing" for (entry,) in writes.values())
    assert all({**host.old, **entry.wanted} == host.new for (entry,) in writes.values())
    (at_store,) = dict(kept)["store"]
    assert at_store.step == "storing"
    assert host.journals == []


async def test_nothing_is_written_where_the_disk_takes_no_journal(tmp_path: Path) -> None:
    (tmp_path / "journal").write_text("a file where the folder should be")
    host = Host(tmp_path, Habits())
    with pytest.raises((DiskError, InputError)):
        Journal.of(tmp_path, "unit", "4711").write(ENTRY)
    assert not await host.provision()
    assert host.unit.written == []


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"[", "no journal"),
        (b"[1]", "no journal"),
        (b'"text"', "no journal"),
        (b'{"format": "triaxcal.journal/1", "step": "dancing"}', "step: expected one of"),
        (b"[" * 100_000, "no journal"),
    ],
)
def test_what_is_no_journal_is_told(text: bytes, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse(text, where="a.json")
