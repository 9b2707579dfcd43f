"""Processor time until a command answers, beside its peers: `python -m benchmarks.startup`.

Each is started several times in turn, and the least of its times is told: what else the machine does only adds.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

BIN = Path(sys.executable).parent
RUNS = 7
COMMANDS = {
    "python -c pass": [sys.executable, "-c", "pass"],
    "triaxcal --version": [str(BIN / "triaxcal"), "--version"],
    "triaxcal --help": [str(BIN / "triaxcal"), "--help"],
    "triaxcal fit --help": [str(BIN / "triaxcal"), "fit", "--help"],
    "import triaxcal": [sys.executable, "-c", "import triaxcal"],
    "triaxcal.Calibration": [sys.executable, "-c", "import triaxcal; triaxcal.Calibration"],
    "import imucal": [sys.executable, "-c", "import imucal"],
    "can_logger --help": [str(BIN / "can_logger"), "--help"],
}


def seconds(command: list[str]) -> float | None:
    """Of user and system, of the process and its children; None where it is not installed or fails."""
    before = os.times()
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except OSError:
        return None
    after = os.times()
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return spent if done.returncode == 0 else None


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    p.add_argument("--runs", type=int, default=RUNS)
    runs = p.parse_args().runs
    least: dict[str, float | None] = {}
    for _ in range(runs):
        for name, command in COMMANDS.items():
            found, known = seconds(command), least.get(name)
            least[name] = found if known is None or (found is not None and found < known) else known
    peer = least["import imucal"]
    print(f"{'command':<22} {'s of processor time':>20} {'of import imucal':>18}")
    for name, s in least.items():
        told = "—" if s is None else f"{s:.3f}"
        ratio = "—" if s is None or not peer else f"{s / peer:.2f}"
        print(f"{name:<22} {told:>20} {ratio:>18}")


if __name__ == "__main__":
    main()
