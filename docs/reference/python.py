"""Writes docs/reference/python.md from the docstrings of the public names: `python docs/reference/python.py`."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import triaxcal as tc

PAGE = Path(__file__).with_suffix(".md")
FUNCTIONS = ("find_poses", "calibrate", "diagnose", "verify", "rezero", "plan", "budget")
CLASSES = ("Calibration", "Diagnosis", "Verification", "Poses", "Pose", "PlannedPose", "Stated")
ERRORS = ("TriaxcalError", "InvalidData", "Refused", "MissingChannel", "TooShort")
VALUES = ("Samples", "StillSpan", "Sensor", "Moment", "Stage", "local_gravity_g")
CONSTANTS = ("Floats", "Ints", "HEIGHTS_M")
ROOMS = tuple(name for name in tc.__all__ if inspect.ismodule(getattr(tc, name)))
HEAD = """# Python

    import triaxcal as tc

These names are public: their arguments and results stay; names and keyword arguments may be added. The names of the last section may change with a minor version, all others at any time. Made from the docstrings by `docs/reference/python.py`. [Use a calibration](../how-to/use-a-calibration.md) has an example.

`tc.__version__` is the version.
"""  # noqa: E501


def page() -> str:
    parts = [HEAD]
    parts += [f"## tc.{name}\n\n{_call(name, getattr(tc, name))}\n\n{_text(getattr(tc, name))}\n" for name in FUNCTIONS]
    parts += [_class(name, getattr(tc, name)) for name in CLASSES]
    parts += ["## Errors\n", *(f"* `tc.{name}`: {' '.join(_text(getattr(tc, name)).split())}" for name in ERRORS), ""]
    names = ", ".join(f"`tc.{name}`" for name in (*VALUES, *ROOMS, *CONSTANTS))
    parts += [f"## For programs built on triaxcal\n\n{names}: their docstrings describe them (`help(tc.poses)`).\n"]
    return "\n".join(parts)


def _class(name: str, of: type[Any]) -> str:
    lines = [f"## tc.{name}\n", _text(of), ""]
    seen: set[int] = set()  # an older name of a member is the same object
    plain = []
    for key, member in vars(of).items():
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        if key.startswith("_") or not inspect.isfunction(function) or id(member) in seen:
            continue
        seen.add(id(member))
        if not _text(function):
            plain.append(f"`.{key}`")
            continue
        call = f".{key}" if isinstance(member, property) else _signature(key, function)
        lines.append(f"* `{call}`: {' '.join(_text(function).split())}")
    lines += [f"* {', '.join(plain)}"] if plain else []
    return "\n".join(lines) + "\n"


def _call(name: str, function: Any) -> str:
    return f"    tc.{_signature(name, function)}"


def _signature(name: str, function: Any) -> str:
    """Names and defaults; the types stand in the text."""
    shown = []
    star = False
    for p in inspect.signature(function).parameters.values():
        if p.name in ("self", "cls"):
            continue
        if p.kind is p.KEYWORD_ONLY and not star:
            shown.append("*")
            star = True
        prefix = "**" if p.kind is p.VAR_KEYWORD else ""
        shown.append(prefix + p.name + ("" if p.default is p.empty else f"={p.default!r}"))
    return f"{name}({', '.join(shown)})"


def _text(of: Any) -> str:
    return (inspect.getdoc(of) or "").replace("``", "`")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
