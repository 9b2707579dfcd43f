"""Valid inputs of every kind, spoiled at random: whatever comes of one has to be an error of ours or a clean exit.

`python -m benchmarks.fuzz --count 50000 --seed 1` makes so many and prints a table; a failure is made again with
`--seed 1 --only NUMBER`. An input depends on the seed and its number alone.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType

from benchmarks.fuzz_inputs import KINDS, spoiled
from triaxcal_drivers.errors import DriverMissing, ProfileError
from triaxcald.errors import DaemonError

SECONDS_MOST = 3.0  # of processor time for one input
CODES = (0, 1, 2, 3)


class TooLong(BaseException):
    """An input took more than `SECONDS_MOST`."""


@dataclass
class Tally:
    """What came of the inputs of one kind."""

    inputs: int = 0
    codes: Counter[int] = field(default_factory=Counter)
    slowest_s: float = 0.0
    failures: list[tuple[int, str]] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        self.inputs += other.inputs
        self.codes += other.codes
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        self.failures += other.failures


@contextlib.contextmanager
def _bounded() -> Iterator[None]:
    def ring(number: int, frame: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, SECONDS_MOST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def one(seed: int, number: int, keep: Path | None = None) -> tuple[str, Tally]:
    """Makes input ``number`` and has it read."""
    rng = random.Random(f"{seed} {number}")
    (kind,) = rng.choices(KINDS, [k.share for k in KINDS])
    tally = Tally(inputs=1)
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    out, err = io.StringIO(), io.StringIO()
    began_s = time.process_time()
    try:
        for name, content in spoiled(kind, rng).items():
            (folder / name).write_bytes(content)
        if keep is not None:
            shutil.copytree(folder, keep, dirs_exist_ok=True)
        began_s = time.process_time()
        with (
            _bounded(), warnings.catch_warnings(),
            contextlib.redirect_stdout(out), contextlib.redirect_stderr(err),
        ):  # fmt: skip
            warnings.simplefilter("error", RuntimeWarning)  # numpy's would be lines of its own on standard error
            code = kind.read(folder, rng)
        tally.codes[code] += 1
        if code not in CODES:
            tally.failures.append((number, f"exit code {code}: {err.getvalue()[-300:]}"))
        elif any(ord(c) < 32 for c in err.getvalue().replace("\n", "")):
            tally.failures.append((number, f"control characters: {err.getvalue()[-300:]!r}"))
    except (DaemonError, ProfileError, DriverMissing):
        tally.codes[2] += 1
    except (Exception, TooLong, SystemExit) as e:  # noqa: BLE001 - what this looks for
        tally.failures.append((number, _told(e)))
    finally:
        tally.slowest_s = time.process_time() - began_s
        shutil.rmtree(folder, ignore_errors=True)
    return kind.name, tally


def _told(e: BaseException) -> str:
    places = [f for f in traceback.extract_tb(e.__traceback__) if "triax" in f.filename] or [None]
    last = places[-1]
    return f"{e!r:.200} at {os.path.basename(last.filename)}:{last.lineno}" if last else f"{e!r:.200}"


def many(seed: int, numbers: Sequence[int]) -> dict[str, Tally]:
    """Runs the inputs of these numbers."""
    found = {kind.name: Tally() for kind in KINDS}
    for number in numbers:
        name, tally = one(seed, number)
        found[name].add(tally)
    return found


def _print(found: dict[str, Tally]) -> None:
    print(f"{'kind':<16}{'inputs':>8}{'read':>8}{'bad input':>11}{'refused':>9}{'failures':>10}{'slowest s':>11}")
    for name, t in found.items():
        read = t.codes[0] + t.codes[1]
        print(
            f"{name:<16}{t.inputs:>8}{read:>8}{t.codes[2]:>11}{t.codes[3]:>9}{len(t.failures):>10}{t.slowest_s:>11.2f}"
        )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--from", dest="first", type=int, default=0, help="number of the first input")
    parser.add_argument("--only", type=int, metavar="NUMBER", help="one input again; its files go to fuzz-NUMBER")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    a = parser.parse_args()
    if a.only is not None:
        name, tally = one(a.seed, a.only, Path(f"fuzz-{a.only}"))
        print(f"{name}: {dict(tally.codes)} {tally.slowest_s:.2f} s", *tally.failures)
        return 1 if tally.failures else 0
    found = {kind.name: Tally() for kind in KINDS}
    last = a.first + a.count
    parts = [range(start, min(start + 500, last)) for start in range(a.first, last, 500)]
    with ProcessPoolExecutor(a.jobs) as pool:
        for done, part in enumerate(pool.map(partial(many, a.seed), parts), 1):
            for name, tally in part.items():
                found[name].add(tally)
                for number, what in tally.failures:
                    print(f"failure: {name}, --seed {a.seed} --only {number}: {what}", flush=True)
            print(f"{done} of {len(parts)} parts", file=sys.stderr, flush=True)
    _print(found)
    return 1 if any(t.failures for t in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
