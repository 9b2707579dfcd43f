"""One, two or three stop signals at random moments, to processes at work on simulated units."""

from __future__ import annotations

import sys

import pytest

from benchmarks.stop_signals import COMMANDS, fire, shot_of

DEADLINE_S = 180.0
"""Far beyond what it takes, on a machine that has much else to do; a signal that is lost is never heeded."""
QUICK = [n for n in range(14) if COMMANDS[n % len(COMMANDS)] != "run"]
"""Without `run`, which takes as long as all the others; `benchmarks/stop_signals.py` has it too."""


@pytest.mark.slow
@pytest.mark.parametrize("number", QUICK)
async def test_a_command_that_is_stopped_ends_in_good_order(number: int) -> None:
    ended = await fire(shot_of(1, number, sys.executable, transports=("tcp",)), deadline_s=DEADLINE_S)
    assert ended.faults == (), (ended.shot, ended.code, ended.err)
