"""Which faults come when: a sequence that a seed fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.soak.bench import Unit
from benchmarks.soak.replies import KINDS

BEGIN_S, QUIET_S = 8.0, 30.0
"""No fault before all is at work, nor so near the end that a unit could not come back: the longest pause between two
attempts is 10 s, and one attempt takes some seconds."""
APART_S = (4.0, 12.0)
"""From one fault to the next; some last longer, so that faults meet."""
RECORDER_APART_S = 15.0
"""What befalls the recorder itself comes alone: a kill shortly after a stop would show nothing of its own."""
KILL_EVERY_S, KILLED_BY = 300.0, 0.4
"""One kill in so long, all in the first part of the time: the last process of the recorder then lives long enough to
judge its memory."""
SHARES = (0.03, 0.10, 0.30)
FLOOD_HZ = 2000
"""Beside the units' own frames, all that a bus of 500 kbit/s can carry."""


@dataclass(frozen=True)
class Fault:
    """``place`` is a unit, a bus or the recorder; ``seconds`` how long it lasts; ``share`` of the replies that are
    struck."""

    at_s: float
    place: str
    what: str
    seconds: float
    share: float = 0.0

    def __str__(self) -> str:
        share = f" {self.share:.0%}" if self.share else ""
        return f"{self.at_s:7.1f} s  {self.place}: {self.what}{share}, {self.seconds:.1f} s"


_LONGEST_S = {
    "supply off": 6.0,
    "bus stopped": 8.0,
    "flood": 3.0,
    "connection gone": 8.0,
    "recorder stopped": 13.0,
    "recorder killed": 4.0,
    **{f"replies {kind}": 12.0 for kind in KINDS},
}
"""Longer than a silence, and some stops of the recorder than a hole that is a gap of its own (10 s)."""
_SHORTEST_S = 0.3


def schedule(seed: int, seconds: float, units: Sequence[Unit]) -> list[Fault]:
    """In the order of their times."""
    rng = np.random.default_rng(seed)
    last_s = seconds - QUIET_S
    kills_s = _kills(rng, seconds, last_s)
    faults = [Fault(at, "recorder", "recorder killed", _lasting(rng, "recorder killed")) for at in kills_s]
    choices = _choices(units)
    at_s, recorder_s = BEGIN_S, -RECORDER_APART_S
    while at_s < last_s:
        place, what = choices[int(rng.integers(len(choices)))]
        fault = Fault(at_s, place, what, min(_lasting(rng, what), last_s - at_s + 1.0), _share(rng, what))
        near = any(abs(at_s - kill) < RECORDER_APART_S for kill in kills_s) or at_s - recorder_s < RECORDER_APART_S
        if place != "recorder" or not near:
            faults.append(fault)
            recorder_s = at_s + fault.seconds if place == "recorder" else recorder_s
        at_s += rng.uniform(*APART_S)
    return sorted(faults, key=lambda fault: fault.at_s)


def _kills(rng: np.random.Generator, seconds: float, last_s: float) -> list[float]:
    until_s = min(KILLED_BY * seconds, last_s)
    count = max(1, int(seconds * KILLED_BY / KILL_EVERY_S * 2))
    span = (until_s - BEGIN_S) / count
    return [BEGIN_S + span * (i + float(rng.uniform(0.2, 0.8))) for i in range(count)] if span > 0 else []


def _choices(units: Sequence[Unit]) -> list[tuple[str, str]]:
    """Each as likely as the others; a supply of some unit as often as a bus."""
    buses = list(dict.fromkeys(unit.bus for unit in units))
    choices = [(unit.name, "supply off") for unit in units]
    choices += [(bus, "bus stopped") for bus in buses] * 2
    choices += [("can", "flood")] * 3
    choices += [(bus, "connection gone") for bus in ("rtu", "tcp")] * 2
    choices += [(bus, f"replies {kind}") for bus in ("rtu", "tcp") for kind in KINDS]
    choices += [("recorder", "recorder stopped")] * 4
    return choices


def _lasting(rng: np.random.Generator, what: str) -> float:
    return float(rng.uniform(_SHORTEST_S, _LONGEST_S[what]))


def _share(rng: np.random.Generator, what: str) -> float:
    return float(rng.choice(SHARES)) if what.startswith("replies") else 0.0
