"""The commands of keys, with their arguments and help."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from triaxcald.cli.syntax import add_command, add_json, words


def register_keys(commands: Any) -> None:
    keys = commands.add_parser("keys", help="keys by which a station signs its recordings")
    parts = keys.add_subparsers(dest="part", required=True, metavar="new|list|trust|revoke")
    p = add_command(
        parts, "new", "keys:new_command", "make a key, by which the station signs from then on",
        "The passphrase is that of TRIAXCAL_KEY_PASSPHRASE or of a file.", "keys new line-1 --folder station",
    )  # fmt: skip
    p.add_argument("name", metavar="NAME", help="1 to 64 of A–Z a–z 0–9 . _ -")
    p.add_argument("--passphrase-file", metavar="FILE", type=Path, help="its first line is the passphrase")
    p.add_argument("--no-passphrase", action="store_true", help="whoever can read the file can sign; its mode is 0600")
    p.add_argument("--module", metavar="MODULE", type=Path, help="make it in a device, by this library (PKCS #11)")
    p.add_argument("--token", metavar="LABEL", help="which token of the device; the passphrase is its PIN")
    _add_key_folder(p)
    p = add_command(
        parts, "list", "keys:list_command", "show keys, and which are trusted", "", "keys list --folder station"
    )
    _add_key_folder(p)
    p = add_command(
        parts, "trust", "keys:trust_command", "trust a key, or a time-stamping authority",
        "The first key makes the trust file: recordings from then on have to be signed.", "keys trust line-1",
    )  # fmt: skip
    p.add_argument("name", metavar="NAME")
    p.add_argument(
        "--public", metavar="FILE", type=Path, help="public key in PEM; default: NAME.pub in the folder keys"
    )
    p.add_argument("--authority", metavar="FILE", type=Path, help="root certificate in PEM of an authority (RFC 3161)")
    _add_key_folder(p)
    p = add_command(
        parts, "revoke", "keys:revoke_command", "trust nothing that a key signs from now on", "",
        "keys revoke line-1 --reason 'the computer was stolen'",
    )  # fmt: skip
    p.add_argument("name", metavar="NAME")
    p.add_argument("--reason", metavar="TEXT", type=words, required=True)
    p.add_argument(
        "--retired", action="store_true",
        help="nobody else had it: what it says to have signed before stays trusted; without this, only what a time "
        "stamp shows",
    )  # fmt: skip
    _add_key_folder(p)


def _add_key_folder(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--folder",
        metavar="DIR",
        type=Path,
        default=Path(),
        help="of the station, with keys and trust.toml; default: .",
    )
    add_json(p)
