"""Recordings in stores are read like files: the same result, without a copy, in bounded memory."""

from __future__ import annotations

import http.server
import json
import pickle
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

from tests.daemon.many.conftest import CAN, TABLE
from triaxcal_drivers.files import open_file
from triaxcald import stores
from triaxcald.errors import DiskError, InputError, RecordingError
from triaxcald.inputs import measure
from triaxcald.many import Source, Unusable, sources_of
from triaxcald.recording.reader import Recording, digest_of
from triaxcald.stores import BLOCK, BLOCKS, StoreFile, path_of

Run = Callable[..., Any]


@pytest.fixture
def store() -> Iterator[Any]:
    """What `memory://` holds, empty before and after."""
    memory = fsspec.filesystem("memory")
    memory.store.clear()
    memory.pipe("/line/a.mcap", CAN.read_bytes())
    memory.pipe("/line/t.csv.gz", TABLE.read_bytes())
    yield memory
    memory.store.clear()


def test_a_recording_in_a_store_has_the_poses_of_the_file(store: Any) -> None:
    for name, local in (("a.mcap", CAN), ("t.csv.gz", TABLE)):
        ours, theirs = measure(f"memory://line/{name}"), measure(str(local))
        assert [p.start_s for p in ours.poses] == [p.start_s for p in theirs.poses]
        assert all((a.mean == b.mean).all() for a, b in zip(ours.poses, theirs.poses, strict=True))
    assert digest_of(StoreFile("memory://line/a.mcap")) == digest_of(CAN)


def test_folders_patterns_and_manifests_of_a_store(store: Any) -> None:
    store.pipe("/line/below/b.mcap", b"x")
    store.pipe("/line/all.list", b"a.mcap\n# none\nbelow/b.mcap\nmemory://line/gone.mcap\n")
    names = ["memory://line/a.mcap", "memory://line/below/b.mcap"]
    found = sources_of(["memory://line"], (".mcap",))
    assert [of.name.replace(":///", "://") for of in found] == names
    assert isinstance(found[0], Source)
    assert found[0].size == CAN.stat().st_size
    assert found[0].stamp
    [one] = sources_of(["memory://line/*.mcap"], (".mcap",))
    assert one.name.replace(":///", "://") == names[0]
    listed = sources_of(["memory://line/all.list"], (".mcap",))
    assert [of.name for of in listed] == [*names, "memory://line/gone.mcap"]
    assert isinstance(listed[2], Unusable)
    for empty in ("memory://nothing", "memory://line/x*"):
        [of] = sources_of([empty], (".mcap",))
        assert isinstance(of, Unusable)
        assert of.exit_code == 2


@pytest.mark.slow
def test_a_single_audit_compares_the_files_beside_it_in_the_store(store: Any, triaxcal: Run) -> None:
    store.pipe("/line/a.outcome.json", b"{}")
    done = triaxcal("audit", "memory://line/a.mcap", "--json")
    [audit] = done.json["audits"]
    assert (done.code, audit["result"], audit["verdict"]) == (1, "differs", "pass")
    assert audit["differences"] == ["a.outcome.json: the file beside the recording is not the one in it"]


def test_a_file_is_read_in_blocks_that_are_asked_for_once(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    data = bytes(range(256)) * (BLOCK // 256) * 3 + b"end"
    store.pipe("/line/long.bin", data)
    asked: list[int] = []
    true = stores._Blocks.block
    monkeypatch.setattr(
        stores._Blocks, "block", lambda self, n: (asked.append(n) if n not in self._held else None) or true(self, n)
    )
    path = StoreFile("memory://line/long.bin")
    for _ in range(2):
        with open_file(path) as file:
            assert file.read() == data
            file.seek(BLOCK - 2)
            assert file.read(4) == data[BLOCK - 2 : BLOCK + 2]
            assert file.seek(-3, 2) == len(data) - 3
            assert file.read() == b"end"
            assert file.read(1) == b""
    assert asked == [0, 1, 2, 3]


def test_no_more_blocks_are_held_than_are_meant(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stores, "BLOCK", 16)
    store.pipe("/line/long.bin", bytes(range(256)) * 8)
    path = StoreFile("memory://line/long.bin")
    with open_file(path) as file:
        assert file.read() == bytes(range(256)) * 8
    assert path._blocks is not None
    assert len(path._blocks._held) == BLOCKS


def test_a_path_of_a_store_goes_to_a_worker_by_its_name(store: Any) -> None:
    path = StoreFile("memory://line/a.mcap")
    with open_file(path) as file:
        file.read(1)
    again = pickle.loads(pickle.dumps(path))
    assert again == path
    assert again._blocks is None


@pytest.mark.parametrize(
    ("url", "name", "parent", "suffixed"),
    [
        ("s3://b/x/a.mcap", "a.mcap", "s3://b/x", "s3://b/x/a.report.html"),
        ("s3://b/a?b.mcap", "a?b.mcap", "s3://b", "s3://b/a?b.report.html"),
        ("https://h/x/a.mcap?sig=1/2", "a.mcap", "https://h/x?sig=1/2", "https://h/x/a.report.html?sig=1/2"),
    ],
)
def test_names_in_a_store(url: str, name: str, parent: str, suffixed: str) -> None:
    path = StoreFile(url)
    assert (path.name, str(path.parent), str(path.with_suffix(".report.html"))) == (name, parent, suffixed)


def test_a_file_url_is_a_path() -> None:
    assert path_of("file:///a%20b/c.mcap") == Path("/a b/c.mcap")
    assert path_of("a:b.mcap") == Path("a:b.mcap")


def test_a_file_that_is_not_there_and_a_store_that_nobody_knows(store: Any, triaxcal: Run) -> None:
    triaxcal("poses", "memory://line/no.mcap").failed(2, "memory://line/no.mcap", "no such file in the store")
    triaxcal("audit", "memory://line/no.mcap").failed(2, "memory://line/no.mcap", "no such file in the store")
    with pytest.raises(InputError, match=r"odd://x/a\.mcap"):
        Recording.open(StoreFile("odd://x/a.mcap"))


def test_a_store_that_fails_in_between_is_like_a_disk_that_fails(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> Any:
        raise ConnectionResetError("the line is cut")

    path = StoreFile("memory://line/a.mcap")
    with open_file(path):
        pass
    assert path._blocks is not None
    monkeypatch.setattr(path._blocks._file, "read", fail)
    with pytest.raises(DiskError, match="the store failed: the line is cut"):
        Recording.open(path)


class _Web(http.server.SimpleHTTPRequestHandler):
    """Knows no ranges, as many do not."""

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def web(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "a.mcap").write_bytes(CAN.read_bytes())
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), lambda *of: _Web(*of, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.slow
def test_a_web_server_that_cannot_seek_is_read_through_a_temporary_copy(web: str, triaxcal: Run) -> None:
    done = triaxcal("poses", f"{web}/a.mcap", "--json")
    assert done.code == 0
    local = triaxcal("poses", CAN, "--json")
    assert json.loads(done.out)["poses"] == json.loads(local.out)["poses"]
    [source] = sources_of([f"{web}/a.mcap"], (".mcap",))
    assert isinstance(source, Source)
    assert source.stamp
    with pytest.raises(RecordingError):
        Recording.open(StoreFile(f"{web}/none.mcap"))
