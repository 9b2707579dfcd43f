"""Definitions of ROS 2 messages, as .msg (``ros2msg``) or as IDL (``ros2idl``).

Of two libraries that read them, mcap-ros2-support refuses capitals in the names of
fields, which real packages have. rosbags refuses the whole definition for one line, and
every ``#include`` of IDL. These readers keep a line that they cannot read in its place
among the fields. `CdrReader` names it if the profile's fields stand behind it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

Fields = Sequence[tuple[str, "Described"]]
Described = tuple[str, Any]
"""``("base", name)``, ``("message", name)``, ``("array", (element, length))``,
``("sequence", element)``, or ``("unread", (line, text))`` of a line, from 1, that
cannot be read."""

_SEPARATOR = re.compile(r"={3,}[ \t]*")
"""Line between the parts of a definition. rosbag2 writes 80 signs. No definition has a
line of them."""
_PART = re.compile(r"(?:MSG|IDL)[ \t]*:[ \t]*([\w/]+)[ \t]*")
Lines = list[tuple[int, str]]  # with their numbers, from 1


def message_types(name: str, language: str, definition: bytes) -> tuple[str, Mapping[str, Fields]]:
    """Name of the outermost message, and the fields of each message by its name. A
    type whose part cannot be read has the line as its only field."""
    full = _full(name)
    text = definition.decode("utf-8", "replace").replace("\ufeff", "")  # editors put it before any part
    lines = list(enumerate(re.split(r"\r\n|\r|\n", text), 1))
    parts = list(_parts(full, lines))
    return full, _of_idl(parts) if language == "ros2idl" else {part: _of_msg(part, body) for part, body in parts}


def _full(name: str) -> str:
    """``package/msg/Name``, of ``package/Name`` too."""
    return name.replace("/", "/msg/", 1) if name.count("/") == 1 else name


def _parts(outermost: str, lines: Lines) -> Iterator[tuple[str, Lines]]:
    name, part = outermost, Lines()
    for at, (number, line) in enumerate(lines):
        header = _PART.fullmatch(line.strip())
        if _SEPARATOR.fullmatch(line.strip()):
            yield name, part
            name, part = "", []
        elif header and (at == 0 or not name):
            name = _full(header[1])
        else:
            part.append((number, line))
    yield name, part


def _unread(number: int, line: str) -> Described:
    return "unread", (number, " ".join(line.split()))


# A .msg: each line is a field, a constant or a remark.

_PRIMITIVE = re.compile(r"bool|byte|char|float(?:32|64)|u?int(?:8|16|32|64)|w?string")
_MSG_LINE = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<many>\[(?:<=)?\s*(?P<length>\d*)\s*\])?"
    r"\s+(?P<name>[A-Za-z_]\w*)\s*(?P<rest>$|[=#].*|(?:[-+.\d\"'\[]|true\b|false\b|nan\b|inf\b).*)",
    re.IGNORECASE,
)
"""A default value, a constant's value or a remark follows the name, or nothing."""
_MSG_STRING = re.compile(r"(?P<type>w?string)(?:<=\d+)?\s+(?P<name>[A-Za-z_]\w*)\s+[^=\s].*")
"""The default value of a string may stand without quotes."""
_ELSEWHERE = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
"""Types that ROS 1 names without their package."""
PLACEHOLDER = ("structure_needs_at_least_one_member", ("base", "uint8"))
"""ROS 2 gives it to a message without fields; it is encoded."""


def _of_msg(owner: str, lines: Lines) -> Fields:
    fields: list[tuple[str, Described]] = []
    for number, line in lines:
        bare = line.strip()
        if not bare or bare.startswith(("#", "@")):
            continue
        found = _MSG_LINE.fullmatch(bare)
        if found is None and (text := _MSG_STRING.fullmatch(bare)):
            fields.append((text["name"], ("base", text["type"])))
        elif found is None:
            fields.append(("", _unread(number, bare)))
        elif not found["rest"].startswith("=") or found["many"]:  # a constant is not encoded
            fields.append((found["name"], _msg_type(found, owner)))
    return fields or [PLACEHOLDER]


def _msg_type(found: re.Match[str], owner: str) -> Described:
    name = found["type"]
    if _PRIMITIVE.fullmatch(name):
        element: Described = "base", name
    elif "/" in name:
        element = "message", _full(name)
    else:
        element = "message", _ELSEWHERE.get(name, f"{owner.rpartition('/')[0]}/{name}")
    if found["many"] is None:
        return element
    bounded = "<=" in found["many"]
    return ("array", (element, int(found["length"]))) if found["length"] and not bounded else ("sequence", element)


# IDL (OMG, version 4.2), as far as ROS 2 uses it.

_TOKEN = re.compile(
    r"(?P<skip>\s+|//[^\n]*|/\*.*?(?:\*/|\Z))|"
    r'(?P<token>L?"(?:\\.|[^"\\])*(?:"|\\?\Z)|L?\'(?:\\.|[^\'\\]){1,4}\'|'
    r"[\w.]+(?:\s*::\s*\w+)*|::\s*\w+(?:\s*::\s*\w+)*|.)",
    re.DOTALL,
)
"""What is not closed goes on to the end, so that the time grows with the length."""
_IDL_BASE = {
    "boolean": "bool", "octet": "octet", "char": "char", "string": "string", "wstring": "wstring", "short": "int16",
    "long": "int32", "long long": "int64", "unsigned short": "uint16", "unsigned long": "uint32",
    "unsigned long long": "uint64", "float": "float32", "double": "float64",
    **{f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)},
}  # fmt: skip
_UNKNOWN = frozenset(("long double", "wchar", "any", "map", "fixed", "Object"))
_NESTED_MOST = 64
"""Modules and types within each other; usual ones have three."""
DIMENSIONS_MOST = 8
"""Of an array; usual ones have one."""
_CLOSING = {"(": ")", "{": "}", "[": "]"}


class _Unreadable(Exception):
    """At the token that comes next."""


def _of_idl(parts: Sequence[tuple[str, Lines]]) -> Mapping[str, Fields]:
    read = _Idl()
    for name, lines in parts:
        read.part(name, lines)
    return read.resolved()


class _Idl:
    """Reads part after part. Names are resolved at the end, as a part may use the
    types of a later one."""

    def __init__(self) -> None:
        self._structs: dict[str, list[tuple[str, Described]]] = {}
        self._typedefs: dict[str, Described] = {}
        self._constants: dict[str, str] = {}
        self._enums: set[str] = set()
        self._tokens: list[tuple[str, int]] = []
        self._at = 0
        self._scope: list[str] = []
        self._lines: dict[int, str] = {}

    def part(self, name: str, lines: Lines) -> None:
        self._lines = dict(lines)
        self._tokens = list(_tokens(lines))
        self._at, self._scope = 0, []
        self._first_fault: Described | None = None
        if not self._tokens:
            return
        self._definitions()
        if self._next():
            self._note_fault()
        if name and name not in self._structs and name not in self._enums and name not in self._typedefs:
            self._structs[name] = [("", self._first_fault or self._fault(self._at))]

    def resolved(self) -> Mapping[str, Fields]:
        return {
            name: [(field, self._resolve(described, 0)) for field, described in fields] or [PLACEHOLDER]
            for name, fields in self._structs.items()
        }

    # Tokens.

    def _next(self) -> str:
        return self._tokens[self._at][0] if self._at < len(self._tokens) else ""

    def _take(self, expected: str = "") -> str:
        token = self._next()
        if not token or (expected and token != expected):
            raise _Unreadable
        self._at += 1
        return token

    def _name(self) -> str:
        if not re.fullmatch(r"[A-Za-z_]\w*", self._next()):
            raise _Unreadable
        return self._take()

    def _note_fault(self) -> Described:
        fault = self._fault(self._at)
        self._first_fault = self._first_fault or fault
        return fault

    def _fault(self, at: int) -> Described:
        number = self._tokens[min(at, len(self._tokens) - 1)][1] if self._tokens else min(self._lines, default=1)
        return _unread(number, self._lines.get(number, ""))

    def _skip_statement(self) -> None:
        """To behind its semicolon, or to the brace that ends what it is in."""
        open_ones: list[str] = []
        while token := self._next():
            if not open_ones and token == "}":
                return
            self._at += 1
            if token in _CLOSING:
                open_ones.append(_CLOSING[token])
            elif open_ones and token == open_ones[-1]:
                open_ones.pop()
            elif token == ";" and not open_ones:
                return

    def _annotations(self) -> set[str]:
        found = set()
        while self._next() == "@":
            self._at += 1
            found.add(self._take())
            if self._next() == "(":
                depth = 0
                while True:
                    token = self._take()
                    depth += (token == "(") - (token == ")")
                    if not depth:
                        break
        return found

    # Definitions.

    def _qualified(self, name: str) -> str:
        return "/".join((*self._scope, name))

    def _definitions(self) -> None:
        """Until the brace that closes them."""
        while self._next() not in ("", "}"):
            start = self._at
            name = ""
            try:
                self._annotations()
                kind = self._take()
                if kind == "module":
                    self._module()
                    continue
                if kind == "const":
                    self._constant()
                elif kind == "typedef":
                    element = self._type(0)
                    for name, described in self._declarators(element):
                        self._typedefs[self._qualified(name)] = described
                elif kind == "enum":
                    self._enums.add(self._qualified(self._name()))
                    self._skip_statement()
                    continue
                elif kind == "struct":
                    name = self._name()
                    self._struct(name)
                elif kind != ";":
                    name = self._next()
                    raise _Unreadable
            except _Unreadable:
                fault = self._note_fault()
                if name:
                    self._structs.setdefault(self._qualified(name), [("", fault)])
                self._at = start
                self._skip_statement()

    def _module(self) -> None:
        if len(self._scope) == _NESTED_MOST:
            raise _Unreadable
        self._scope.append(self._name())
        try:
            self._take("{")
            self._definitions()
            self._take("}")
        finally:
            self._scope.pop()
        if self._next() == ";":
            self._at += 1

    def _constant(self) -> None:
        self._type(0)
        name = self._name()
        self._take("=")
        self._constants[self._qualified(name)] = self._next()
        self._skip_statement()

    def _struct(self, name: str) -> None:
        if self._next() == ";":  # declared before it is defined
            return
        self._take("{")
        fields: list[tuple[str, Described]] = []
        while self._next() != "}":
            start = self._at
            try:
                if "optional" in self._annotations():  # encoded with a header
                    raise _Unreadable
                element = self._type(0)
                fields += self._declarators(element)
            except _Unreadable:
                fields.append(("", self._note_fault()))
                self._at = start
                self._skip_statement()
            if not self._next():
                break
        self._structs[self._qualified(name)] = fields
        self._take("}")
        self._take(";")

    def _declarators(self, element: Described) -> list[tuple[str, Described]]:
        """To behind the semicolon."""
        found = []
        while True:
            name = self._name()
            lengths: list[tuple[str, tuple[str, ...], Described]] = []
            while self._next() == "[" and len(lengths) < DIMENSIONS_MOST:
                self._at += 1
                lengths.append(self._length())
                self._take("]")
            described = element
            for length in reversed(lengths):
                described = "array", (described, length)
            found.append((name, described))
            if self._next() != ",":
                self._take(";")
                return found
            self._at += 1

    def _length(self) -> tuple[str, tuple[str, ...], Described]:
        """A number or the name of a constant, with what `_resolve` needs."""
        fault = self._fault(self._at)
        return self._take(), tuple(self._scope), fault

    def _type(self, depth: int) -> Described:
        if depth > _NESTED_MOST:
            raise _Unreadable
        at, fault = self._at, self._fault(self._at)
        word = self._take()
        while word.split()[0] in ("unsigned", "long") and self._next() in ("short", "long", "double"):
            word += f" {self._take()}"
        if word == "sequence":
            self._take("<")
            element = self._type(depth + 1)
            if self._next() == ",":
                self._at += 1
                self._take()
            self._take(">")
            return "sequence", element
        if word in ("string", "wstring") and self._next() == "<":
            self._at += 1
            self._take()
            self._take(">")
        if word in _IDL_BASE:
            return "base", _IDL_BASE[word]
        if word in _UNKNOWN or not re.fullmatch(r"(?:::)?[A-Za-z_]\w*(?:::[A-Za-z_]\w*)*", _without_blanks(word)):
            self._at = at
            raise _Unreadable
        return "name", (_without_blanks(word), tuple(self._scope), fault)

    # Names.

    def _resolve(self, described: Described, depth: int) -> Described:
        kind, detail = described
        if kind == "sequence":
            return kind, self._resolve(detail, depth + 1)
        if kind == "array":
            element, (length, scope, fault) = detail
            count = self._integer(length, scope)
            return fault if count is None else (kind, (self._resolve(element, depth + 1), count))
        if kind != "name":
            return described
        name, scope, fault = detail
        for candidate in _candidates(name, scope):
            if candidate in self._structs:
                return "message", candidate
            if candidate in self._enums:
                return "base", "uint32"
            if candidate in self._typedefs:
                return fault if depth > _NESTED_MOST else self._resolve(self._typedefs[candidate], depth + 1)
        return "message", name.removeprefix("::").replace("::", "/")

    def _integer(self, text: str, scope: tuple[str, ...]) -> int | None:
        for _ in range(_NESTED_MOST):
            if re.fullmatch(r"\d+", text):
                return int(text)
            if re.fullmatch(r"0[xX][0-9A-Fa-f]+", text):
                return int(text, 16)
            known = next((c for c in _candidates(_without_blanks(text), scope) if c in self._constants), None)
            if known is None:
                return None
            text, scope = self._constants[known], tuple(known.split("/")[:-1])
        return None


def _without_blanks(name: str) -> str:
    return re.sub(r"\s+", "", name)


def _candidates(name: str, scope: Sequence[str]) -> Iterator[str]:
    """From the innermost scope outwards."""
    path = name.removeprefix("::").replace("::", "/")
    for depth in range(0 if name.startswith("::") else len(scope), -1, -1):
        yield "/".join((*scope[:depth], path))


def _tokens(lines: Lines) -> Iterator[tuple[str, int]]:
    """Each with the number of its line, without remarks and the directives of the
    preprocessor."""
    text, continued = [], False
    for _, line in lines:
        directive = continued or line.lstrip().startswith("#")
        continued = directive and line.rstrip().endswith("\\")
        text.append("" if directive else line)
    number = 0
    for found in _TOKEN.finditer("\n".join(text)):
        if found["token"] is not None:
            yield found["token"], lines[number][0]
        number += found[0].count("\n")
