"""Every table of `make bench`, one after the other; ``--quick`` for fewer runs of each."""

from __future__ import annotations

import sys

from benchmarks import (
    coverage,
    efficiency,
    frame,
    long_recordings,
    outliers,
    peers,
    raw_rotation,
    recorder,
    speed,
    stillness,
    undeclared,
    ways_in,
)
from benchmarks.table import chosen


def main(arguments: list[str] | None = None) -> int:
    quick = chosen(__doc__, arguments)
    for module in (efficiency, coverage, outliers, peers, raw_rotation, speed, ways_in, recorder, long_recordings):
        module.main(["--quick"] if quick else [])
        sys.stdout.flush()
    print("\n### The frame of the mounting faces\n")
    frame.main(30 if quick else 300)
    print("\n### Stillness and poses\n", flush=True)
    # By itself, with all its seeds, it takes longer than everything else together.
    stillness.main(["--quick"])
    # The longest of all, as each recording goes the whole way from samples to findings.
    undeclared.main(["--seeds", "15"] if quick else [])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
