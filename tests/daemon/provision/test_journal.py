"""The journal is on the disk before anything is written, and says all that it takes to go on."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon.provision.host import Host
from tests.devices.habits import Habits
from tests.devices.profiles import Timing, profile_text
from tests.devices.table import OLD
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.profile import Profile
from triaxcald.errors import DiskError, InputError
from triaxcald.provision.journal import Entry, Journal, Owner, journals_of, open_journal, parse
from triaxcald.provision.registers import Snapshot, image_of
from triaxcald.run.provision_by_hand import unit_in
from triaxcald.software import new_run_id

LEFT = Owner("TRIAX/REF", "0007", "left")

ENTRY = Entry(
    unit="left",
    serial="0007",
    profile_sha256="ab" * 32,
    started="2026-03-02T09:00:00+00:00",
    before={"bias_x": b"\x00\x01", "crc": b"\xff\xff"},
    wanted={"bias_x": b"\x00\x02", "crc": b"\x12\x34"},
    step="storing",
    product="TRIAX/REF",
    run="01",
)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    journal = Journal.of(tmp_path, LEFT, "01")
    journal.write(ENTRY)
    assert journal.path == tmp_path / "journal" / "TRIAX_REF-0007.json"
    assert journal.read() == ENTRY


def test_a_device_without_a_serial_number_has_its_journal_by_slot_and_run(tmp_path: Path) -> None:
    run = new_run_id()
    path = Journal.of(tmp_path, Owner("TRIAX/REF", None, "left side"), run).path
    assert path == tmp_path / "journal" / f"left_side-{run}.json"


def test_without_a_journal_nothing_was_cut_short(tmp_path: Path) -> None:
    assert Journal.of(tmp_path, LEFT, "01").read() is None


def test_two_products_with_one_serial_number_keep_a_journal_each(tmp_path: Path) -> None:
    others = [Owner("A", "0777", "left"), Owner("B", "0777", "right")]
    paths = {Journal.of(tmp_path, owner, "01").path for owner in others}
    assert {path.name for path in paths} == {"A-0777.json", "B-0777.json"}


HABITS = Habits()
BUNDLE = parse_bundle(profile_text("modbus", HABITS, Timing()).encode(), {}, where="a profile")
NO_SERIAL = BUNDLE.profile.model_copy(
    update={"identity": BUNDLE.profile.identity.model_copy(update={"serial_register": None})}
)


def kept(folder: Path, name: str, owner: Owner, **changes: object) -> Path:
    """A journal in that file, as an earlier provisioning of the unit left it."""
    registers = dict.fromkeys(OLD.image(HABITS), b"\0\0")
    entry = replace(ENTRY, serial=owner.serial, product=owner.product, before=registers, wanted=registers)
    journal = Journal(folder / "journal" / name)
    journal.write(replace(entry, **changes))
    return journal.path


def found(folder: Path, owner: Owner, profile: Profile = BUNDLE.profile) -> list[str]:
    return [journal.path.name for journal, _ in journals_of(folder, owner, profile)]


def test_a_journal_of_an_earlier_version_is_found_behind_the_own_one(tmp_path: Path) -> None:
    owner = Owner.of(BUNDLE.profile, "unit", "4711")
    kept(tmp_path, "4711.json", owner, product="")
    assert found(tmp_path, owner) == ["4711.json"]
    kept(tmp_path, "misbehaving_unit-4711.json", owner)
    assert found(tmp_path, owner) == ["misbehaving_unit-4711.json", "4711.json"]


def test_a_journal_of_an_earlier_version_with_other_registers_is_of_another_product(tmp_path: Path) -> None:
    owner = Owner.of(BUNDLE.profile, "unit", "4711")
    kept(tmp_path, "4711.json", owner, product="", before={"bias_x": b"\0\0"})
    assert found(tmp_path, owner) == []


@pytest.mark.parametrize("changes", [{"product": "misbehaving/unit"}, {"serial": "0815"}])
def test_a_journal_of_another_unit_under_the_same_name_is_refused(tmp_path: Path, changes: dict[str, str]) -> None:
    owner = Owner.of(BUNDLE.profile, "unit", "4711")
    kept(tmp_path, "misbehaving_unit-4711.json", owner, **changes)
    with pytest.raises(InputError, match="is the journal of"):
        journals_of(tmp_path, owner, BUNDLE.profile)


def test_journals_of_a_slot_are_found_the_newest_first(tmp_path: Path) -> None:
    runs = [new_run_id(milliseconds * 1_000_000) for milliseconds in (1_000, 3_000, 2_000)]
    owner = Owner.of(NO_SERIAL, "left", None)
    for run in runs:
        kept(tmp_path, f"left-{run}.json", owner)
    kept(tmp_path, f"left-2-{runs[0]}.json", Owner.of(NO_SERIAL, "left-2", None))
    kept(tmp_path, "unit-left.json", owner, product="")
    names = [f"left-{run}.json" for run in (runs[1], runs[2], runs[0])]
    assert found(tmp_path, owner, NO_SERIAL) == [*names, "unit-left.json"]
    assert open_journal(tmp_path, NO_SERIAL, "left", None) == tmp_path / "journal" / names[0]


@pytest.mark.parametrize("stated", ["777", "0777", " 0777 ", "00777"])
def test_leading_zeros_of_a_serial_number_do_not_count(tmp_path: Path, stated: str) -> None:
    owner = Owner.of(BUNDLE.profile, "unit", "0777")
    path = kept(tmp_path, "misbehaving_unit-0777.json", owner)
    assert open_journal(tmp_path, BUNDLE.profile, "unit", stated) == path


def test_nobody_knows_the_journal_of_a_unit_that_was_not_asked(tmp_path: Path) -> None:
    kept(tmp_path, "unit-unit.json", Owner.of(BUNDLE.profile, "unit", None))
    assert open_journal(tmp_path, BUNDLE.profile, "unit", None) is None


async def test_the_success_of_one_product_leaves_the_journal_of_another(tmp_path: Path) -> None:
    other = kept(tmp_path, "other_unit-4711.json", Owner("other unit", "4711", "unit"))
    older = kept(tmp_path, "4711.json", Owner("other unit", "4711", "unit"), product="")
    host = Host(tmp_path, Habits())
    assert await host.provision()
    assert host.starts_with() == "new"
    assert host.journals == sorted([other, older])


async def test_an_old_journal_of_the_unit_is_finished_and_goes(tmp_path: Path) -> None:
    host = Host(tmp_path, Habits())
    assert not await host.provision(kill_at=30)
    (path,) = host.journals
    document = {k: v for k, v in json.loads(path.read_text()).items() if k not in ("product", "run")}
    path.unlink()
    (tmp_path / "journal" / "4711.json").write_text(json.dumps(document))
    assert await host.resume()
    assert host.starts_with() == "new"
    assert host.journals == []


async def put_back(host: Host, registers: dict[str, bytes]) -> None:
    """Another calibration than the journal's, as from a certificate."""
    p = host.provisioning = host._begun(image_of(host.bundle.profile, registers))
    await host._finished(p.put_back(Snapshot(registers, "4711")))


@pytest.mark.parametrize("way", ["resume", "restore", "another"])
async def test_the_run_that_is_settled_is_the_one_whose_journal_goes(tmp_path: Path, way: str) -> None:
    host = Host(tmp_path, Habits())
    assert not await host.provision(kill_at=30)
    (path,) = host.journals
    path.write_text(json.dumps({**json.loads(path.read_text()), "run": "the cut run"}))
    if way == "another":
        registers = replace(OLD, bias=(0.031, 0.002, -0.004)).image(HABITS)
        assert await host._process(put_back(host, registers), None, False)
    else:
        assert await getattr(host, way)()
    assert host.journals == []
    assert host.provisioning is not None
    assert host.provisioning.settles == "the cut run"


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
    journal = Journal.of(tmp_path, LEFT, "01")
    journal.write(ENTRY)
    at = [what for what, _ in order].index("replace")
    assert any(path.startswith(str(journal.path.parent / ".TRIAX_REF-0007.json")) for _, path in order[:at])
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
        Journal.of(tmp_path, LEFT, "01").write(ENTRY)
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
        (b"[" + b"[]," * 400_000 + b"[]]", "more than 400000 lists and objects"),
        (b'{"step": "writing", "step": "stored"}', "the key 'step' is given twice"),
    ],
)
def test_what_is_no_journal_is_told(text: bytes, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse(text, where="a.json")


def test_a_journal_to_restore_from_has_the_bounds_of_a_document(tmp_path: Path) -> None:
    path = tmp_path / "journal.json"
    path.write_bytes(b" " * (4 * 2**20 + 1))
    with pytest.raises(InputError, match="larger than the 4 MiB that such a file may have"):
        unit_in(path)
