"""A recording counts as changed where the files that its result depends on have."""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

import triaxcal_drivers as td
from triaxcald.audit import many
from triaxcald.audit.signature import Policy
from triaxcald.cli.batch import _calibrations_beside
from triaxcald.errors import InputError
from triaxcald.many import Source, sources_of
from triaxcald.many.beside import with_files_beside

TRUST = 'format = "triaxcal.trust/1"\nsince = "2026-01-31T12:00:00+00:00"\n'
KEY = base64.b64encode(bytes(32)).decode()


@pytest.fixture
def store() -> Iterator[Any]:
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    yield memory
    memory.store.clear()


def stamps(found: Any) -> list[str]:
    assert all(isinstance(of, Source) for of in found)
    return [of.stamp for of in found]


@pytest.mark.parametrize("name", ["a.certificate.json", "a.report.html", "a.manifest.dsse.json", "a.outcome.json"])
def test_a_file_beside_a_recording_changes_its_stamp_alone(tmp_path: Path, name: str) -> None:
    for recording in ("a.mcap", "b.mcap"):
        (tmp_path / recording).write_text("x")
    found = sources_of([str(tmp_path)], (".mcap",))
    without = stamps(many.with_files_beside(found))
    assert without == stamps(found)
    (tmp_path / name).write_text("1")
    made = stamps(many.with_files_beside(found))
    os.utime(tmp_path / name, ns=(1, 1))
    touched = stamps(many.with_files_beside(found))
    (tmp_path / name).write_text("12")
    os.utime(tmp_path / name, ns=(1, 1))
    longer = stamps(many.with_files_beside(found))
    assert len({without[0], made[0], touched[0], longer[0]}) == 4
    assert {without[1], made[1], touched[1], longer[1]} == {without[1]}
    assert made[0].startswith(f"{without[0]}+")


def test_the_start_of_the_chain_counts_and_what_it_grows_by_does_not(tmp_path: Path) -> None:
    (tmp_path / "day").mkdir()
    (tmp_path / "day" / "a.mcap").write_text("x")
    found = sources_of([str(tmp_path)], (".mcap",))
    chain = tmp_path / "chain.jsonl"
    chain.write_text("start\n")
    first = stamps(many.with_files_beside(found))
    chain.write_text("start\nentry\n")
    assert stamps(many.with_files_beside(found)) == first
    chain.write_text("another\nentry\n")
    assert stamps(many.with_files_beside(found)) != first


@pytest.mark.parametrize("files", [many.with_files_beside, lambda f: with_files_beside(f, _calibrations_beside)])
def test_a_certificate_in_a_store_counts_and_a_folder_is_listed_once(
    store: Any, files: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.mcap", "b.mcap", "c.mcap"):
        store.pipe(f"/line/{name}", b"x")
    found = sources_of(["memory://line"], (".mcap",))
    without = stamps(files(found))
    store.pipe("/line/b.certificate.json", b"1")
    listed: list[str] = []
    true = type(store).ls
    monkeypatch.setattr(
        type(store), "ls", lambda self, path, *a, **more: listed.append(path) or true(self, path, *a, **more)
    )
    now = stamps(files(found))
    assert [a == b for a, b in zip(without, now, strict=True)] == [True, False, True]
    assert len(listed) == 1


def test_where_a_store_does_not_tell_nothing_is_taken_over(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    store.pipe("/line/a.mcap", b"x")
    found = sources_of(["memory://line"], (".mcap",))

    def refuses(*_: Any, **__: Any) -> Any:
        raise PermissionError("no listing for you")

    monkeypatch.setattr(type(store), "ls", refuses)
    assert stamps(many.with_files_beside(found)) == stamps(found)  # asked for one by one
    monkeypatch.setattr(type(store), "info", refuses)
    [of] = many.with_files_beside(found)
    assert of == Source(of.name)


def test_the_trust_file_that_was_given_counts_for_urls_too(tmp_path: Path) -> None:
    trust = tmp_path / "keys.toml"
    trust.write_text(TRUST)
    found = [Source("s3://line/a.mcap", 1, "e")]
    before = many.trust_digests(found, Policy(trust))
    assert before != many.trust_digests(found, Policy())
    trust.write_text(f'{TRUST}\n[[keys]]\nname = "k"\npublic = "{KEY}"\nsince = "2026-01-31T12:00:00+00:00"\n')
    assert many.trust_digests(found, Policy(trust)) != before
    trust.write_text("format = 1")
    with pytest.raises((InputError, td.ProfileError), match=r"keys\.toml"):
        many.trust_digests(found, Policy(trust))


def test_a_broken_trust_file_of_one_folder_hides_no_other(tmp_path: Path) -> None:
    for name in ("good", "bad"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "trust.toml").write_text(TRUST)
        (tmp_path / name / "a.mcap").write_text("x")
    found = sources_of([str(tmp_path)], (".mcap",))
    whole = many.trust_digests(found, Policy())
    (tmp_path / "bad" / "trust.toml").write_text("format = ")
    broken = many.trust_digests(found, Policy())
    assert [a == b for a, b in zip(whole, broken, strict=True)] == [False, True]
