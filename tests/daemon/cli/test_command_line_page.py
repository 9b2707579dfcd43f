"""The page of the command line is made from the commands' help."""

from __future__ import annotations

import runpy
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "docs/reference/cli.py"


def test_the_page_of_the_command_line_is_what_the_commands_say_of_themselves() -> None:
    names = runpy.run_path(str(SCRIPT))
    assert names["PAGE"].read_text("utf-8") == names["page"](), "run make docs"


def test_every_command_has_a_note_and_every_note_a_command() -> None:
    names = runpy.run_path(str(SCRIPT))
    assert set(names["NOTES"]) == {name for name, _ in names["commands_of"](names["parser"]())}
