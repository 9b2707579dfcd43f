"""keys."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from triaxcald.cli.console import emit, show, table
from triaxcald.errors import InputError
from triaxcald.signing import hsm, stamps, trust
from triaxcald.signing.keys import (
    FOLDER,
    PASSPHRASE,
    key_id,
    new_key,
    passphrase_of,
    public_keys,
    read_public,
    require_name,
    to_text,
    write_public,
)


def _folders(a: argparse.Namespace) -> tuple[Path, Path]:
    """The station's folder, and that of its keys, by which it may be named too."""
    folder: Path = a.folder
    return (folder.parent, folder) if folder.name == FOLDER else (folder, folder / FOLDER)


def new_command(a: argparse.Namespace) -> int:
    require_name(a.name)
    _, keys = _folders(a)
    if (a.module is None) != (a.token is None):
        raise InputError("--module, --token: give both, or neither")
    if a.no_passphrase and (a.passphrase_file is not None or a.module is not None):
        raise InputError("--no-passphrase: give one way alone")
    passphrase = None if a.no_passphrase else passphrase_of(a.passphrase_file)
    if passphrase is None and not a.no_passphrase:
        raise InputError(f"key {a.name}: give {PASSPHRASE}, --passphrase-file or --no-passphrase")
    if a.module is not None:
        public = hsm.new_key(a.module, a.token, a.name, passphrase)
        write_public(keys, a.name, public)
    else:
        public = new_key(keys, a.name, passphrase).public
    path = keys / f"{a.name}.pub"
    if a.json:
        emit({"format": "triaxcal.keys/1", "keys": [_entry(a.name, public, None)]})
    else:
        show(f"{path}: key {a.name}, {key_id(public)}")
        show(f"next: triaxcal keys trust {a.name} --folder {a.folder}")
    return 0


def list_command(a: argparse.Namespace) -> int:
    folder, keys = _folders(a)
    path = folder / trust.NAME
    file = trust.load_trust(path).file if path.exists() else None
    known = {} if file is None else {key.id: key for key in file.keys}
    read = [(path.stem, read_public(path)) for path in public_keys(keys)]
    here = {key_id(public): (name, public) for name, public in reversed(read)}
    entries = [_entry(name, public, known.get(of)) for of, (name, public) in reversed(here.items())]
    entries += [_entry(key.name, None, key) for of, key in known.items() if of not in here]
    if a.json:
        since = None if file is None else file.since
        emit({"format": "triaxcal.keys/1", "trusted_since": since, "keys": entries,
              "authorities": [] if file is None else [x.name for x in file.authorities]})  # fmt: skip
    elif entries:
        rows = [(e["name"], e["state"], e["since"] or "", e["revoked"] or "", e["key"][:16]) for e in entries]
        table("keys", ("name", "", "since", "revoked", "key"), rows)
    else:
        show("no keys; triaxcal keys new makes one")
    return 0


def _entry(name: str, public: bytes | None, known: trust.TrustedKey | None) -> dict[str, Any]:
    """A key in the folder, in the trust file, or in both, whatever its names there."""
    state = "not trusted"
    if known is not None:
        state = "trusted" if known.revoked is None else "retired" if known.retired else "revoked"
    shown = public if public is not None else known.public_bytes if known is not None else b""
    return {
        "name": name,
        "key": key_id(shown),
        "public": to_text(shown),
        "state": state,
        "since": None if known is None else known.since,
        "revoked": None if known is None else known.revoked,
        "reason": None if known is None else known.reason,
    }


def trust_command(a: argparse.Namespace) -> int:
    require_name(a.name)
    folder, keys = _folders(a)
    if a.authority is not None:
        if a.public is not None:
            raise InputError("--public, --authority: give one of them")
        trust.trust_authority(folder, a.name, stamps.certificate_in(a.authority))
        state = f"authority {a.name}"
    else:
        made = trust.trust_key(folder, a.name, read_public(a.public or keys / f"{a.name}.pub"))
        state = f"key {a.name}, {made.id}"
    if a.json:
        emit({"format": "triaxcal.keys/1", "trust": str(folder / trust.NAME), "name": a.name})
    else:
        show(f"{folder / trust.NAME}: trusts {state}")
    return 0


def revoke_command(a: argparse.Namespace) -> int:
    folder, _ = _folders(a)
    made = trust.revoke_key(folder, a.name, a.reason, retired=a.retired)
    if a.json:
        emit({"format": "triaxcal.keys/1", "trust": str(folder / trust.NAME), "name": a.name, "revoked": made.revoked})
    else:
        show(f"{folder / trust.NAME}: key {a.name} is {'retired' if a.retired else 'revoked'}")
    return 0
