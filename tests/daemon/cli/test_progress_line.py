"""What a command is at, told on standard error while it takes long."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from triaxcal.progress import Stage
from triaxcald.cli import console as progress
from triaxcald.cli.console import BEAT_S, ERASE, PLAIN_S, SILENT_S, WORDS, ProgressLine


@dataclass
class Watched:
    """A line whose time goes by as the test says."""

    terminal: bool
    now_s: float = 100.0
    written: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.line = ProgressLine(self.written.append, terminal=self.terminal, clock=lambda: self.now_s)

    def after(self, seconds: float) -> list[str]:
        """What is written when so much has gone by."""
        self.now_s += seconds
        before = len(self.written)
        self.line.beat()
        return self.written[before:]


@pytest.mark.parametrize("terminal", [True, False])
def test_work_that_is_soon_done_is_not_told(terminal: bool) -> None:
    watched = Watched(terminal)
    watched.line.at("reading a.csv")
    assert watched.after(0.9 * SILENT_S) == []
    watched.line.end()
    assert watched.after(100.0) == []
    assert watched.written == []


def test_without_a_terminal_there_is_a_line_every_some_seconds() -> None:
    watched = Watched(terminal=False)
    watched.line.at("reading a.csv")
    assert watched.after(SILENT_S) == ["reading a.csv (3 s)\n"]
    watched.line.at("weighing", 0.4)
    assert watched.after(0.9 * PLAIN_S) == []
    assert watched.after(0.1 * PLAIN_S) == ["weighing, 40% (13 s)\n"]
    watched.line.end()
    assert len(watched.written) == 2


def test_on_a_terminal_one_line_is_written_anew_and_erased_before_anything_else() -> None:
    watched = Watched(terminal=True)
    watched.line.at("fitting")
    watched.line.erase()
    assert watched.written == []  # nothing is there yet
    assert watched.after(SILENT_S) == [f"{ERASE}fitting (3 s)"]
    assert watched.after(2 * BEAT_S) == [f"{ERASE}fitting (4 s)"]
    watched.line.erase()
    watched.line.erase()
    assert watched.written[2:] == [ERASE]
    watched.after(BEAT_S)
    watched.line.end()
    assert watched.written[-1] == ERASE
    assert not any("\n" in text for text in watched.written)


def test_a_name_cannot_steer_the_terminal() -> None:
    watched = Watched(terminal=False)
    watched.line.at("reading \x1b[2Ja\nb.csv")
    (line,) = watched.after(SILENT_S)
    assert "\x1b" not in line
    assert line.count("\n") == 1


def test_every_stage_of_the_metrology_has_words() -> None:
    assert set(WORDS) == set(Stage)


def test_nothing_is_told_where_no_command_runs(capfd: pytest.CaptureFixture[str]) -> None:
    progress.at("reading a.csv")
    progress.progress(Stage.FIT)
    progress.erased()
    assert capfd.readouterr() == ("", "")
