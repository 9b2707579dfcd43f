"""The table of constants in the documentation is the one in the code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

from triaxcal.evidence import Odds

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "diagnosis.md"


def test_the_documentation_has_every_constant_with_its_value() -> None:
    told = {}
    for names, values in re.findall(r"^\| (`[^|]+) \| ([^|]+) \|", PAGE.read_text(), re.MULTILINE):
        told |= dict(zip(re.findall(r"`(\w+)`", names), map(float, values.split(", ")), strict=True))
    constants = {field.name: getattr(Odds(), field.name) for field in fields(Odds)}
    assert told == {name: value for name, value in constants.items() if not isinstance(value, Mapping)}
