"""Keys in files and in a token, the trust file, and the commands about them."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from triaxcald.audit import Policy
from triaxcald.cli.commands import main
from triaxcald.errors import InputError
from triaxcald.signing.keys import (
    PASSPHRASE,
    key_id,
    new_key,
    passphrase_of,
    read_private,
    read_public,
    verifies,
)
from triaxcald.signing.trust import load_trust, nearest, trust_of

SECRET = b"correct horse"


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A key with a passphrase. Its scrypt costs 0.2 s each time."""
    folder = tmp_path_factory.mktemp("encrypted")
    new_key(folder, "line-1", SECRET)
    return folder


def _mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_private_key_is_encrypted_and_for_its_owner_alone(encrypted: Path) -> None:
    assert _mode(encrypted / "line-1.key") == 0o600
    assert (encrypted / "line-1.key").read_bytes().startswith(b"-----BEGIN ENCRYPTED PRIVATE KEY-----")


def test_openssl_reads_the_key_and_finds_scrypt(encrypted: Path) -> None:
    path = encrypted / "line-1.key"
    public = subprocess.run(
        ["openssl", "pkey", "-in", path, "-passin", f"pass:{SECRET.decode()}", "-pubout"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert public.strip() == (encrypted / "line-1.pub").read_text().strip()
    shown = subprocess.run(["openssl", "asn1parse", "-in", path], check=True, capture_output=True, text=True).stdout
    assert "scrypt" in shown
    assert "aes-256-cbc" in shown


def test_the_key_signs_by_its_passphrase_alone(encrypted: Path) -> None:
    key = read_private(encrypted / "line-1.key", SECRET)
    assert key.public == read_public(encrypted / "line-1.pub")
    assert verifies(key.public, key.sign(b"message"), b"message")
    assert not verifies(key.public, key.sign(b"message"), b"massage")
    for wrong in (b"correct hoarse", None):
        with pytest.raises(InputError):
            read_private(encrypted / "line-1.key", wrong)


def test_a_key_of_openssl_is_read_too(tmp_path: Path) -> None:
    path = tmp_path / "theirs.key"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", path], check=True)
    assert read_private(path, None).name == "theirs"
    subprocess.run(["openssl", "genpkey", "-algorithm", "x25519", "-out", path], check=True)
    with pytest.raises(InputError):
        read_private(path, None)


def test_the_id_of_a_key_is_the_digest_of_its_public_key_in_der(tmp_path: Path) -> None:
    import hashlib

    key = new_key(tmp_path, "a", None)
    der = subprocess.run(
        ["openssl", "pkey", "-pubin", "-in", tmp_path / "a.pub", "-outform", "DER"], check=True, capture_output=True
    ).stdout
    assert key.id == key_id(key.public) == hashlib.sha256(der).hexdigest()


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".a", "a" * 65, "ä", "a\n"])
def test_a_name_may_be_a_file_s(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError):
        new_key(tmp_path, name, None)


@pytest.mark.parametrize(
    "data", [b"", b"\xff" * 100, b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n"]
)
def test_what_is_no_key_is_an_error_of_one_line(tmp_path: Path, data: bytes) -> None:
    for name in ("a.key", "a.pub"):
        (tmp_path / name).write_bytes(data)
    for read in (lambda: read_private(tmp_path / "a.key", None), lambda: read_public(tmp_path / "a.pub")):
        with pytest.raises(InputError) as e:
            read()
        assert "\n" not in str(e.value)


def test_a_passphrase_comes_from_a_file_or_from_the_environment(tmp_path: Path) -> None:
    file = tmp_path / "passphrase"
    file.write_bytes(b"in the file\r\nmore\n")
    assert passphrase_of(file, {PASSPHRASE: "of the environment"}) == b"in the file"
    assert passphrase_of(None, {PASSPHRASE: "of the environment"}) == b"of the environment"
    assert passphrase_of(None, {}) is passphrase_of(None, {PASSPHRASE: ""}) is None
    file.write_bytes(b"\n")
    with pytest.raises(InputError):
        passphrase_of(file)


# Commands.


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv(PASSPHRASE, raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_key_is_made_trusted_and_revoked(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    def listed() -> dict[str, str]:
        capsys.readouterr()
        assert main(["keys", "list", "--json"]) == 0
        return {key["name"]: key["state"] for key in json.loads(capsys.readouterr().out)["keys"]}

    assert listed() == {}
    assert main(["keys", "new", "line-1", "--no-passphrase"]) == 0
    assert _mode(folder / "keys" / "line-1.key") == 0o600
    assert _mode(folder / "keys") == 0o700
    assert listed() == {"line-1": "not trusted"}
    assert main(["keys", "trust", "line-1", "--folder", "keys"]) == 0  # the folder of the keys is known for it too
    assert listed() == {"line-1": "trusted"}
    trust = load_trust(folder / "trust.toml")
    assert trust.file.keys[0].public_bytes == read_public(folder / "keys" / "line-1.pub")
    assert main(["keys", "revoke", "line-1", "--reason", 'stolen, "they say"\x7f']) == 0
    assert listed() == {"line-1": "revoked"}
    again = load_trust(folder / "trust.toml")
    assert (again.file.since, again.file.keys[0].reason) == (trust.file.since, 'stolen, "they say"\x7f')
    revoke = ("revoke", "--reason", "again")
    for command in (("trust", "line-1"), (*revoke, "line-1"), (*revoke, "line-9"), ("new", "line-1", "--no-passphrase"),
                    ("new", "line-2"), ("trust", "line-2")):  # fmt: skip
        assert main(["keys", *command]) == 2
    assert listed() == {"line-1": "revoked"}


def test_keys_are_listed_by_what_they_are_not_by_their_names(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import json

    ids = {name: new_key(folder / "keys", name, None).id for name in ("a", "b", "c")}
    for name, file in (("b", "a"), ("other", "b")):  # the key in a.pub is trusted as b, that in b.pub as other
        assert main(["keys", "trust", name, "--public", f"keys/{file}.pub"]) == 0
    (folder / "keys" / "b.pub").unlink()
    assert main(["keys", "revoke", "b", "--reason", "stolen"]) == 0
    capsys.readouterr()
    assert main(["keys", "list", "--json"]) == 0
    rows = [(key["name"], key["key"], key["state"]) for key in json.loads(capsys.readouterr().out)["keys"]]
    assert rows == [("a", ids["a"], "revoked"), ("c", ids["c"], "not trusted"), ("other", ids["b"], "trusted")]


@pytest.mark.parametrize("command", [
    ["keys", "revoke", "line-1"], ["log", "delete", "a.mcap", "--station", "station.toml"],
])  # fmt: skip
def test_a_reason_is_text(folder: Path, command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    new_key(folder / "keys", "line-1", None)
    assert main(["keys", "trust", "line-1"]) == 0
    capsys.readouterr()
    assert main([*command, "--reason", "gestohlen, \udcfcbrigens"]) == 2  # Latin-1 on the command line
    assert "--reason" in capsys.readouterr().err


def test_a_private_key_is_at_no_moment_for_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes: list[int] = []
    of_os = os.open

    def opened(path: str, flags: int, mode: int = 0o777, **rest: int) -> int:
        found = of_os(path, flags, mode, **rest)
        if str(path).endswith(".key"):
            modes.append(_mode(Path(path)))
        return found

    before = os.umask(0)
    try:
        monkeypatch.setattr(os, "open", opened)
        new_key(tmp_path, "a", None)
    finally:
        os.umask(before)
    assert modes == [0o600]


def test_a_new_key_takes_the_passphrase_of_the_environment_or_of_a_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "secret").write_bytes(SECRET + b"\n")
    assert main(["keys", "new", "a", "--passphrase-file", "secret"]) == 0
    monkeypatch.setenv(PASSPHRASE, SECRET.decode())
    assert main(["keys", "new", "b"]) == 0
    for name in ("a", "b"):
        assert read_private(folder / "keys" / f"{name}.key", SECRET).name == name


def test_a_key_is_never_written_through_a_link_or_over_another(folder: Path) -> None:
    (folder / "keys").mkdir()
    (folder / "keys" / "a.key").symlink_to(folder / "elsewhere")
    assert main(["keys", "new", "a", "--no-passphrase"]) == 2
    assert not (folder / "elsewhere").exists()


@pytest.mark.parametrize("text", [
    "", 'format = "triaxcal.trust/2"\nsince = "2026-01-01T00:00:00+00:00"\n',
    'format = "triaxcal.trust/1"\nsince = "yesterday"\n', 'format = "triaxcal.trust/1"\nsince = "2026-01-01"\n',
    'format = "triaxcal.trust/1"\nsince = "2026-01-01T00:00:00Z"\n[[keys]]\nname = "a"\npublic = "QQ=="\n'
    'since = "2026-01-01T00:00:00Z"\n',
    'format = "triaxcal.trust/1"\nsince = "2026-01-01T00:00:00Z"\nany = 1\n', "\0", "[[keys]",
])  # fmt: skip
def test_an_unusable_trust_file_is_an_error_of_one_line(folder: Path, text: str) -> None:
    (folder / "trust.toml").write_text(text)
    assert main(["keys", "list"]) == 2
    assert main(["audit", "--trust", "trust.toml", __file__]) == 2


def test_the_trust_file_is_that_of_the_nearest_folder(tmp_path: Path) -> None:
    within = tmp_path / "station" / "2026" / "11"
    within.mkdir(parents=True)
    (tmp_path / "station" / "trust.toml").write_text(
        'format = "triaxcal.trust/1"\nsince = 2026-01-01T00:00:00Z\n'  # a time of TOML
    )
    found = trust_of(within / "recording.mcap")
    assert found is not None
    assert found.since.isoformat() == "2026-01-01T00:00:00+00:00"
    assert nearest(within / "not" / "there", "trust.toml") == found.path
    assert nearest(tmp_path, "no such file") is None


TRUST = 'format = "triaxcal.trust/1"\nsince = 2026-01-01T00:00:00Z\n'


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="gives files to other users")
def test_above_a_folder_the_trust_file_is_root_s_the_user_s_or_the_owner_s(tmp_path: Path) -> None:
    within = tmp_path / "station"
    within.mkdir()
    file = tmp_path / "trust.toml"
    file.write_text(TRUST)
    for folder, owner in ((0, 0), (4711, 0), (4711, 4711)):
        os.chown(within, folder, -1)
        os.chown(file, owner, -1)
        assert Policy().trust_of(within / "a.mcap") is not None
    os.chown(file, 4712, -1)
    with pytest.raises(InputError, match="--trust"):  # it is there, so it is not as if there were none
        Policy().trust_of(within / "a.mcap")
    assert Policy(trust=file).trust_of(within / "a.mcap") is not None
    (within / "trust.toml").write_text(TRUST)
    assert nearest(within, "trust.toml") == within / "trust.toml"


def test_the_trust_file_of_the_folder_asked_for_counts_for_all_below(tmp_path: Path) -> None:
    within = tmp_path / "station" / "2026"
    within.mkdir(parents=True)
    for folder in (tmp_path / "station", within):
        (folder / "trust.toml").write_text(TRUST)
    recording = within / "a.mcap"
    assert Policy().file_of(recording) == within / "trust.toml"
    assert Policy(folders=(tmp_path / "station",)).file_of(recording) == tmp_path / "station" / "trust.toml"
    assert Policy(folders=(tmp_path,)).file_of(recording) == within / "trust.toml"  # it has none itself


@pytest.mark.parametrize(("module", "extra"), [("cryptography", "sign"), ("pkcs11", "hsm"), ("rfc3161_client", "sign")])
def test_a_missing_package_is_named_with_its_extra(
    folder: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str, capsys: pytest.CaptureFixture[str]
) -> None:
    from triaxcald.signing.stamps import require_installed

    for name in [module, *(name for name in sys.modules if name.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setenv(PASSPHRASE, "1234")
    command = ["keys", "new", "line-1"] + (["--module", "/none.so", "--token", "t"] if module == "pkcs11" else [])
    if module == "rfc3161_client":
        with pytest.raises(InputError, match=r"triaxcal\[sign\]"):
            require_installed()
    else:
        assert main(command) == 2
        assert f"triaxcal[{extra}]" in capsys.readouterr().err
    assert not list(folder.iterdir())


# A token.

SOFTHSM = next(
    (p for p in (Path("/usr/lib/softhsm/libsofthsm2.so"), Path("/usr/lib64/softhsm/libsofthsm2.so")) if p.exists()),
    None,
)
with_token = pytest.mark.skipif(SOFTHSM is None or shutil.which("softhsm2-util") is None, reason="needs SoftHSM 2")


@pytest.fixture(scope="session")
def token(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A token `station` with the PIN 1234. The library reads its settings once a process."""
    import os

    folder = tmp_path_factory.mktemp("softhsm")
    (folder / "tokens").mkdir()
    (folder / "softhsm2.conf").write_text(f"directories.tokendir = {folder / 'tokens'}\nobjectstore.backend = file\n")
    os.environ["SOFTHSM2_CONF"] = str(folder / "softhsm2.conf")
    subprocess.run(
        ["softhsm2-util", "--init-token", "--free", "--label", "station", "--pin", "1234", "--so-pin", "5678"],
        check=True, capture_output=True,
    )  # fmt: skip
    assert SOFTHSM is not None
    return SOFTHSM


@with_token
def test_a_key_in_a_token_signs_and_never_leaves_it(folder: Path, token: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pkcs11

    from triaxcald.signing.hsm import open_key

    pkcs11.lib(str(token)).reinitialize()  # a login of another test holds for the whole process
    monkeypatch.setenv(PASSPHRASE, "1234")
    made = ["keys", "new", "line-1", "--module", str(token), "--token", "station"]
    assert main(made) == 0
    assert main(made) == 2  # never over another
    assert not (folder / "keys" / "line-1.key").exists()
    for bad in (("station", "line-1", b"9999"), ("station", "line-9", b"1234"), ("other", "line-1", b"1234"),
                ("station", "line-1", None)):  # fmt: skip
        with pytest.raises(InputError) as e:
            open_key(token, *bad)
        assert "\n" not in str(e.value)
    with pytest.raises(InputError):
        open_key(folder / "no-such.so", "station", "line-1", b"1234")
    key = open_key(token, "station", "line-1", b"1234")
    assert key.public == read_public(folder / "keys" / "line-1.pub")
    assert verifies(key.public, key.sign(b"message"), b"message")
