"""Ways to spoil an input: bytes changed, and values put where they do not belong."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable, Sequence

TOKENS = (
    *(token.encode() for token in (
        "[", "]", "{", "}", '"', "'", '"""', "'''", ",", "=", ".", ":", ";", "#", "%", "%(x)s", "$NODEID",
        "\0", "\n", "\r\n",
        "\\", "\\u0000", "\\ud800", "\ufeff", "\u2028", "nan", "-nan", "NaN", "inf", "-inf", "Infinity",
        "true", "null",
        "0", "-1", "1e400", "1e-400", "1e308", "-0.0", "5e-324", "4294967296", "-2147483649", "18446744073709551616",
        "9" * 400, "9" * 5000, "0x" + "f" * 100, "0b1", "1979-05-27T07:32:00Z", "07:32:00", "../x",
        "/etc/passwd", "/dev/zero", "a" * 300, "x.y.z", "[[a]]", "{a=1}", "BO_ ", "SG_ ", " m0 ", " M ",
        "SG_MUL_VAL_ 389 Ux Uy 0-4294967295;\n",
        "SIG_VALTYPE_ 389 Ux : 1;\n", "[1A00sub0]\n", "[3000Name]\nNrOfEntries=4000000000\n", "CompactSubObj=255\n",
        "DefaultValue=0xFFFFFFFF\n", "DataType=0x8\n", "t_s,ux,uy,uz\n", "0,0,0,0\n", "9e9,1,2,3\n",
    )),
    b"\xff", b"\x89MCAP0\r\n", b"\x06", b"\x05\0\0\0\0\0\0\0\0", b"\xff" * 8, b"\0" * 8, b"\x1f\x8b",
)  # fmt: skip
VALUES = (
    "0", "-1", "1", "2", "255", "65536", "4294967296", "18446744073709551616", "-9223372036854775809", "1e308",
    "-1e308", "5e-324", "1e-300", "1e400", "0.5", "nan", "inf", "true", "false", '""', '"a"', '"\\u0000"',
    '"../x"', '"can"',
    '"0x1A00:01"', "[]", "[0]", "[1, 2, 3]", "[[[]]]", "{}", "{ a = 1 }", "1979-05-27", '"' + "x" * 500 + '"',
    "[" * 40, "9" * 120,
)  # fmt: skip
NASTY: tuple[object, ...] = (
    None, True, False, 0, -1, 2, 1e308, -1e308, 5e-324, 1e-300, 10**30, 10**400, float("nan"), float("inf"), "", "a",
    "1.5", "\0", "\ud800", "x" * 500, [], {}, [[]], [1, 2, 3], [1, 2], ["1", "2", "3"], [None] * 3,
    [1e308] * 3, [True] * 3,
    {"a": 1}, {"value": 1}, {"x": {"value": float("nan")}},
)  # fmt: skip


def _flip(data: bytearray, rng: random.Random, other: bytes) -> None:
    for _ in range(rng.choice((1, 1, 2, 8))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _byte(data: bytearray, rng: random.Random, other: bytes) -> None:
    at = rng.randrange(len(data))
    data[at : at + rng.choice((1, 4, 8))] = bytes(
        rng.choice((0, 1, 127, 128, 255)) for _ in range(rng.choice((1, 4, 8)))
    )


def _truncate(data: bytearray, rng: random.Random, other: bytes) -> None:
    del data[rng.randrange(len(data)) :]


def _delete(data: bytearray, rng: random.Random, other: bytes) -> None:
    at = rng.randrange(len(data))
    del data[at : at + rng.choice((1, 3, 20, 200))]


def _insert(data: bytearray, rng: random.Random, other: bytes) -> None:
    at = rng.randrange(len(data) + 1)
    data[at:at] = rng.choice(TOKENS) * rng.choice((1, 1, 1, 2, 30))


def _repeat(data: bytearray, rng: random.Random, other: bytes) -> None:
    at = rng.randrange(len(data))
    piece = data[at : at + rng.choice((1, 5, 40, 400))]
    data[at:at] = bytes(piece) * rng.choice((1, 3, 50, 500))


def _splice(data: bytearray, rng: random.Random, other: bytes) -> None:
    at, start = rng.randrange(len(data)), rng.randrange(len(other))
    piece = other[start : start + rng.choice((10, 100, 1000))]
    data[at : at + rng.choice((0, len(piece)))] = piece


def _lines(data: bytearray, rng: random.Random, other: bytes) -> None:
    """A line doubled, left out or moved."""
    lines = bytes(data).split(b"\n")
    line = lines[rng.randrange(len(lines))]
    if rng.random() < 0.5:
        lines.remove(line)
    if rng.random() < 0.7:
        lines.insert(rng.randrange(len(lines) + 1), line)
    data[:] = b"\n".join(lines)


def _number(data: bytearray, rng: random.Random, other: bytes) -> None:
    found = list(re.finditer(rb"-?\d[\d.eE+-]*", data))
    if found:
        at = rng.choice(found)
        data[at.start() : at.end()] = rng.choice(VALUES[:18]).encode()


def _value(data: bytearray, rng: random.Random, other: bytes) -> None:
    """What follows an equals sign."""
    found = list(re.finditer(rb"=[^\n,}]*", data))
    if found:
        at = rng.choice(found)
        data[at.start() + 1 : at.end()] = rng.choice(VALUES).encode()


def _tree(data: bytearray, rng: random.Random, other: bytes) -> None:
    """A value of a JSON document."""
    try:
        document = json.loads(data)
    except ValueError:
        return
    at = document
    while isinstance(at, dict | list) and at:
        key = rng.choice(list(at) if isinstance(at, dict) else range(len(at)))
        if not isinstance(at[key], dict | list) or not at[key] or rng.random() < 0.3:
            if rng.random() < 0.2:
                del at[key]
            else:
                at[key] = rng.choice(NASTY)
            break
        at = at[key]
    data[:] = json.dumps(document).encode()


BLIND = (_flip, _byte, _truncate, _delete, _insert, _repeat, _splice)
INFORMED = (_lines, _number, _value, _insert)


def spoil(data: bytearray, rng: random.Random, other: bytes, *, structural: bool, tree: bool) -> None:
    """Changes ``data`` once; with pieces of ``other``, too. ``tree``: it is JSON; ``structural``: it is text."""
    ways: Sequence[Callable[[bytearray, random.Random, bytes], None]] = BLIND
    if structural and rng.random() < 0.7:
        ways = (_tree,) if tree else INFORMED
    if data:
        rng.choice(ways)(data, rng, other)


def spoil_packed(data: bytearray, rng: random.Random) -> None:
    rng.choice((_flip, _truncate, _delete, _splice))(data, rng, bytes(data))
