"""A station with a key: it signs, or its run ends before the first pose."""

from __future__ import annotations

import fcntl
import json
import shutil
import stat
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Workshop
from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import SECOND_NS, T0_NS, Line, lines_of, looked_at, when
from tests.daemon.signing.test_keys import token as token  # a fixture
from tests.daemon.signing.test_keys import with_token
from tests.virtual_line import described, virtual_line
from triaxcald.audit import Policy, audit_chain
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import State
from triaxcald.cli.commands import main
from triaxcald.errors import InputError, NotSigned
from triaxcald.run.attempts import Attempts, settle_killed
from triaxcald.signing import chain
from triaxcald.signing.keys import PASSPHRASE, SigningKey, new_key
from triaxcald.signing.station import signing_of
from triaxcald.signing.trust import trust_key
from triaxcald.station.config import Station, load_station
from triaxcald.work import Attempt, Work

BUS = {"host": "127.0.0.1", "port": 1}  # nobody is there: a run that asks for it ends with 4


@pytest.fixture(autouse=True)
def _no_passphrase(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PASSPHRASE, raising=False)


@pytest.fixture
def station(workshop: Workshop) -> Callable[..., Station]:
    def make(**sign: Any) -> Station:
        settings = {"sign": sign} if sign else {}
        return load_station(workshop.station({"bus": BUS}, **settings))

    return make


def test_a_station_without_a_key_signs_nothing(station: Callable[..., Station]) -> None:
    assert signing_of(station()) is None


def test_the_only_key_in_the_folder_is_the_station_s(station: Callable[..., Station], workshop: Workshop) -> None:
    key = new_key(workshop.folder / "keys", "line-1", None)
    found = signing_of(station())
    assert found is not None
    assert (found.key.name, found.key.public, found.folder) == ("line-1", key.public, workshop.folder)


def test_of_several_keys_the_station_file_names_one_or_one_is_not_revoked(
    station: Callable[..., Station], workshop: Workshop
) -> None:
    keys = [new_key(workshop.folder / "keys", name, None) for name in ("line-1", "line-2")]
    with pytest.raises(InputError):
        signing_of(station())
    found = signing_of(station(key="line-1"))
    assert found is not None
    assert found.key.public == keys[0].public
    path = trusted(workshop.folder, when(T0_NS), keys[0], revoked=when(T0_NS), reason="replaced", retired=True)
    with pytest.raises(InputError):  # the trust file lacks the other
        signing_of(station())
    trust_key(path.parent, "line-2", keys[1].public)
    found = signing_of(station())
    assert found is not None
    assert found.key.public == keys[1].public


def test_a_key_may_be_in_another_folder_and_its_passphrase_in_a_file(
    station: Callable[..., Station], workshop: Workshop
) -> None:
    new_key(workshop.folder / "stick", "line-1", b"secret")
    workshop.write("passphrase", "secret\n")
    found = signing_of(station(folder="stick", passphrase_file="passphrase"))
    assert found is not None
    assert found.key.name == "line-1"


def _encrypted(folder: Path) -> None:
    new_key(folder / "keys", "line-1", b"secret")


def _damaged(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    (folder / "keys" / "line-1.key").write_text("-----BEGIN PRIVATE KEY-----\n")


def _unreadable(folder: Path) -> None:
    (folder / "keys" / "line-1.key").mkdir(parents=True)


def _revoked(folder: Path) -> None:
    key = new_key(folder / "keys", "line-1", None)
    trusted(folder, when(T0_NS), key, revoked=when(T0_NS), reason="stolen")


def _no_trust(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    (folder / "trust.toml").write_text("what?")


def _garbled_chain(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    (folder / "chain.jsonl").write_text("what?\n")


def _emptied_chain(folder: Path) -> None:
    """The key remembers another."""
    key = new_key(folder / "keys", "line-1", None)
    Line(folder, key).record()
    (folder / "chain.jsonl").write_text("")


def _partial_chain(folder: Path) -> None:
    """And nobody remembers it."""
    _emptied_chain(folder)
    (folder / "chain.jsonl").write_text('{"kind": "star')
    for path in (folder / "keys").glob("*.head"):
        path.unlink()


def _linked_chain(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    (folder / "chain.jsonl").symlink_to(folder / "none")


def _another_key_remembers(folder: Path) -> None:
    Line(folder, new_key(folder / "keys", "line-1", None)).record()
    for path in folder.glob("*.*"):
        if path.suffix != ".toml":
            path.unlink()
    (folder / "keys" / "line-1.key").unlink()
    new_key(folder / "keys", "line-2", None)


def _another_chain(folder: Path) -> None:
    """Which the key began elsewhere."""
    key = new_key(folder / "keys", "line-1", None)
    Line(folder, key).record()
    (folder / "other").mkdir()
    Line(folder / "other", key, T0_NS + SECOND_NS).record()
    shutil.copy(folder / "other" / "chain.jsonl", folder / "chain.jsonl")


def _signed_without_chain(folder: Path) -> None:
    Line(folder, new_key(folder / "keys", "line-1", None)).record()
    for path in (folder / "chain.jsonl", *folder.glob("*.dsse.json"), *(folder / "keys").glob("*.head")):
        path.unlink()


def _two(folder: Path) -> None:
    for name in ("line-1", "line-2"):
        new_key(folder / "keys", name, None)


def _each_revoked(folder: Path) -> None:
    keys = [new_key(folder / "keys", name, None) for name in ("line-1", "line-2")]
    trusted(folder, when(T0_NS), *keys, revoked=when(T0_NS), reason="stolen")


def _no_folder(folder: Path) -> None:
    (folder / "keys").write_text("a file")


def _only_trust(folder: Path) -> None:
    key = new_key(folder / "elsewhere", "line-1", None)
    trusted(folder, when(T0_NS), key)


def _only_chain(folder: Path) -> None:
    Line(folder, new_key(folder / "elsewhere", "line-1", None)).record()


def _only_public(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    (folder / "keys" / "line-1.key").unlink()


def _not_in_trust(folder: Path) -> None:
    new_key(folder / "keys", "line-1", None)
    trusted(folder, when(T0_NS), new_key(folder / "elsewhere", "line-2", None))


CANNOT: list[tuple[str, Callable[[Path], object], dict[str, Any]]] = [
    ("passphrase missing", _encrypted, {}),
    ("passphrase wrong", _encrypted, {"passphrase_file": "wrong"}),
    ("file with the passphrase missing", _encrypted, {"passphrase_file": "none"}),
    ("key damaged", _damaged, {}),
    ("key unreadable", _unreadable, {}),
    ("key revoked", _revoked, {}),
    ("key missing", lambda _: None, {"key": "line-9"}),
    ("no key at all", lambda _: None, {"timestamp": "http://127.0.0.1:1/"}),
    ("two keys", _two, {}),
    ("each key revoked", _each_revoked, {}),
    ("keys is no folder", _no_folder, {}),
    ("no private key, and a trust file", _only_trust, {}),
    ("no private key, and a chain", _only_chain, {}),
    ("no private key, and a public one", _only_public, {}),
    ("key not in the trust file", _not_in_trust, {}),
    ("trust file unusable", _no_trust, {}),
    ("chain garbled", _garbled_chain, {}),
    ("chain emptied", _emptied_chain, {}),
    ("chain cut in its first line", _partial_chain, {}),
    ("chain a link to nothing", _linked_chain, {}),
    ("chain gone, and another key remembers it", _another_key_remembers, {}),
    ("another chain", _another_chain, {}),
    ("chain gone, and a recording was signed into it", _signed_without_chain, {}),
    ("device absent", lambda _: None, {"key": "line-1", "pkcs11": {"module": "/none.so", "token": "station"}}),
]


@pytest.mark.parametrize(("prepare", "sign"), [row[1:] for row in CANNOT], ids=[row[0] for row in CANNOT])
def test_a_run_that_cannot_sign_ends_before_it_asks_for_a_device(
    workshop: Workshop, station: Callable[..., Station], capsys: pytest.CaptureFixture[str],
    prepare: Callable[[Path], object], sign: dict[str, Any], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    workshop.write("wrong", "guess\n")
    prepare(workshop.folder)
    path = str(station(**sign).path)
    before = sorted(workshop.folder.iterdir())
    if "pkcs11" in sign:
        monkeypatch.setenv(PASSPHRASE, "1234")
    for command in ("run", "serve"):
        assert main([command, path]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1), err
    assert sorted(workshop.folder.iterdir()) == before


def test_a_run_does_not_wait_for_ever_for_the_chain(
    workshop: Workshop, station: Callable[..., Station], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    line = Line(workshop.folder, new_key(workshop.folder / "keys", "line-1", None))
    line.record()
    path = workshop.folder / chain.NAME
    assert stat.S_IMODE(path.stat().st_mode) & ~0o640 == 0
    monkeypatch.setattr(chain, "LOCK_S", 0.2)
    with open(path) as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert main(["run", str(station().path)]) == 2
        assert str(path) in capsys.readouterr().err
        with pytest.raises(NotSigned):
            line.record("late.mcap")
    line.record("again.mcap")


def test_a_run_that_can_sign_goes_on_to_the_device(
    workshop: Workshop, station: Callable[..., Station], monkeypatch: pytest.MonkeyPatch
) -> None:
    _encrypted(workshop.folder)
    monkeypatch.setenv(PASSPHRASE, "secret")
    assert main(["run", str(station().path)]) == 4


@with_token
def test_a_station_signs_by_a_key_in_a_token(
    workshop: Workshop, station: Callable[..., Station], token: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PASSPHRASE, "1234")
    folder = str(workshop.folder)
    assert main(["keys", "new", "station-3", "--module", str(token), "--token", "station", "--folder", folder]) == 0
    assert main(["keys", "trust", "station-3", "--folder", folder]) == 0
    found = signing_of(station(key="station-3", pkcs11={"module": str(token), "token": "station"}))
    assert found is not None
    line = Line(workshop.folder, found.key)
    signature, differences = looked_at(line.record(), Policy())
    assert (signature.state, signature.name, differences) == (State.TRUSTED, "station-3", [])


# What a killed run leaves.


def _attempt(line: Line, station: Station, path: Path) -> None:
    """The file of the attempt that made the recording ``path``."""
    number = len(line.made) - 1
    run = f"01a21f9f-0000-7000-8000-{number:012d}"
    attempts = Attempts(station.folder, "tray", "bench", station.file.limits.model_dump())
    work = Work("unit", str(number))
    with attempts.under_way():
        attempts.begin(Attempt(run, when(line.now_ns), work, recording=path.name))


@pytest.mark.parametrize("kept", ["all but the indexes", "without the signature", "without the outcome"])
def test_the_next_start_signs_the_recording_of_a_killed_run(
    workshop: Workshop, station: Callable[..., Station], kept: str
) -> None:
    folder = workshop.folder
    key = new_key(folder / "keys", "line-1", None)
    trusted(folder, "2020-01-01T00:00:00+00:00", key)
    here = station()
    line = Line(folder, replace(key, folder=folder / "keys"), time.time_ns() - 10**6 * SECOND_NS)
    line.record()
    path = line.record("killed.mcap")
    # As it was when the process was killed: the file without its end, the chain without its line.
    data = path.read_bytes()
    head = 29  # bytes of an attachment before its name
    name = {"without the signature": b"manifest.dsse.json", "without the outcome": b"outcome.json"}.get(kept)
    path.write_bytes(data[:-300] if name is None else data[: data.index(name) - head])
    for beside in folder.glob("killed.*json"):
        beside.unlink()
    lines = (folder / chain.NAME).read_text().splitlines(keepends=True)
    (folder / chain.NAME).write_text("".join(lines[:-1]))
    (folder / "keys").joinpath(next(p.name for p in (folder / "keys").glob("*.head"))).unlink()
    _attempt(line, here, path)
    (killed,) = settle_killed(here) or [None]
    assert (killed is None) is (kept != "without the outcome")
    signature, differences = looked_at(path, Policy())
    # Nobody knows who left a recording that ends with a pass and has no index.
    found = [] if kept == "without the outcome" else [Kind.MENDED]
    assert (signature.state, signature.number, signature.mended, differences) == (State.TRUSTED, 2, True, found)
    assert looked_at(path, Policy(allow_unsigned=True))[1] == []
    assert not looked_at(line.made[0], Policy())[0].mended
    assert path.with_suffix(".manifest.dsse.json").exists()
    assert audit_chain(folder).differences == ()
    assert not (folder / "running").exists()


# The whole line.


@pytest.mark.slow
def test_a_run_is_signed_trusted_and_in_the_chain(workshop: Workshop, capsys: pytest.CaptureFixture[str]) -> None:
    folder = workshop.folder
    assert main(["keys", "new", "line-1", "--no-passphrase", "--folder", str(folder)]) == 0
    assert main(["keys", "trust", "line-1", "--folder", str(folder)]) == 0
    bus = {"host": "127.0.0.1", "port": 502}
    device = workshop.device(bus=bus)
    path = workshop.station({"bus": bus, "serial": "4711"}, folder="runs")
    capsys.readouterr()
    with virtual_line(described(device)):
        assert main(["run", str(path), "--json"]) == 0
    unit = json.loads(capsys.readouterr().out)["units"][0]
    recording = Path(unit["recording"])
    assert Path(unit["signature_file"]) == recording.with_suffix(".manifest.dsse.json")
    assert main(["audit", str(recording.parent), "--chain", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    signature = document["audits"][0]["signature"]
    assert (signature["state"], signature["name"], signature["number"]) == ("trusted", "line-1", 1)
    assert document["audits"][0]["codes"] == document["chains"][0]["differences"] == []
    assert document["chains"][0]["head"]["digest"] == lines_of(recording.parent)[-1]["digest"]
    # Without the signature, the trust file lets nothing pass.
    shutil.rmtree(folder / "keys")
    assert main(["audit", str(recording), "--trust", str(folder / "trust.toml")]) == 0


def test_a_missing_passphrase_is_asked_for_by_the_key_of_the_station_file(
    workshop: Workshop, station: Callable[..., Station]
) -> None:
    """A run has no option for it."""
    _encrypted(workshop.folder)
    with pytest.raises(InputError) as raised:
        signing_of(station())
    assert "sign.passphrase_file" in str(raised.value)
    assert "--passphrase-file" not in str(raised.value)


def test_the_environment_is_asked_once_for_a_key_that_costs_time(
    workshop: Workshop, station: Callable[..., Station], monkeypatch: pytest.MonkeyPatch
) -> None:
    from triaxcald.signing import station as module

    _encrypted(workshop.folder)
    monkeypatch.setenv(PASSPHRASE, "secret")
    read: list[Path] = []
    of_file = module.read_private

    def counted(path: Path, passphrase: bytes | None, given_by: str) -> SigningKey:
        read.append(path)
        return of_file(path, passphrase, given_by)

    monkeypatch.setattr(module, "read_private", counted)
    first, second = signing_of(station()), signing_of(station())
    assert first is not None
    assert second is not None
    assert first.key is second.key
    assert len(read) == 1
