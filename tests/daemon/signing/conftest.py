from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon.signing.line import Line, when
from triaxcald.signing import stamps, station
from triaxcald.signing.keys import SigningKey, new_key, to_text
from triaxcald.signing.trust import FORMAT, TrustedKey, TrustFile, save


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SigningKey]:
    """Three keys without a passphrase, which cost nothing."""
    folder = tmp_path_factory.mktemp("keys")
    return {name: new_key(folder, name, None) for name in ("line-1", "line-2", "stranger")}


@pytest.fixture(scope="session")
def key(keys: dict[str, SigningKey]) -> SigningKey:
    return keys["line-1"]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory, key: SigningKey) -> Line:
    """A folder with a trust file, an earlier recording without a signature, and four signed ones. Not to be changed."""
    folder = tmp_path_factory.mktemp("line")
    line = Line(folder, replace(key, folder=folder / "keys"))
    (folder / "keys").mkdir()
    line.record("earlier.mcap", signed=False)
    since = when(line.now_ns + 1_000_000_000)
    line.now_ns += 10_000_000_000
    trusted(folder, since, key)
    for _ in range(4):
        line.record()
    return line


@pytest.fixture
def line(tmp_path: Path, recorded: Line) -> Line:
    """A copy of it, to be changed."""
    folder = tmp_path / "line"
    shutil.copytree(recorded.folder, folder)
    return Line(
        folder, replace(recorded.key, folder=folder / "keys"), recorded.now_ns,
        made=[folder / path.name for path in recorded.made],
    )  # fmt: skip


def trusted(folder: Path, since: str, *keys: SigningKey, **settings: object) -> Path:
    """A trust file with these keys."""
    entries = tuple(TrustedKey(name=k.name, public=to_text(k.public), since=since, **settings) for k in keys)  # type: ignore[arg-type]
    path = folder / "trust.toml"
    save(path, TrustFile(format=FORMAT, since=since, keys=entries))
    return path


@pytest.fixture(autouse=True)
def _nothing_remembered() -> None:
    """Keys that are open, and authorities that did not answer."""
    station._opened.clear()
    stamps._down.clear()
