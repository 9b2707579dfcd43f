"""A folder of runs for the pages: outcomes of 55 runs, of which some failed, and one unit with three attempts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.daemon.service.conftest import outcome
from triaxcald.documents import to_text
from triaxcald.schema.codes import Code, Verdict

FAILED = {
    5: Code.VERIFICATION_OUTSIDE, 11: Code.NO_POSES, 18: Code.VERIFICATION_OUTSIDE, 23: Code.FIT_OUTSIDE,
    24: Code.LOST, 30: Code.VERIFICATION_OUTSIDE, 37: Code.STOPPED,
}  # fmt: skip
RUNS = 55
RETESTED = "SN-1005"
LIMIT_G, FAILED_G = 5e-5, 6.3e-5
FIRST_LIMIT_G, CHANGED_AT = 7e-5, 12
"""With ``changed`` the limit of the first runs was another."""
SLASHED = "A/1 <b>#?"
XSS = "<img src=x onerror=window.caught=1>"


def written(folder: Path, *, changed: bool = False) -> list[dict[str, Any]]:
    """The outcomes, oldest first."""
    folder.mkdir(exist_ok=True)
    found = []
    for i in range(RUNS):
        serial = {50: RETESTED, 51: RETESTED, RUNS - 2: SLASHED, RUNS - 1: XSS}.get(i, f"SN-{1000 + i}")
        document = _outcome(i, FAILED.get(i, Code.WITHIN_LIMITS), serial, attempt=i - 48 if i in (50, 51) else 1)
        if changed and i < CHANGED_AT and document["verification"] is not None:
            document["limits"]["verification_rms_g"] = document["verification"]["limit_rms_g"] = FIRST_LIMIT_G
            if document["verdict"] == Verdict.FAIL:
                document["verification"]["after_rms_g"] = FIRST_LIMIT_G + FAILED_G - LIMIT_G
        (folder / f"run-{i:03d}.outcome.json").write_text(to_text(document), encoding="utf-8")
        found.append(document)
    return found


def _outcome(i: int, code: Code, serial: str, attempt: int) -> dict[str, Any]:
    document = outcome(
        i, code, serial=serial, slot="abcd"[i % 4], operator="Olena", order="4711", part_number="TX & 3", fixture="F2",
        attempt=attempt,
    )  # fmt: skip
    wobble = [((i + 3) * k * 7919 % 101) / 50 - 1 for k in range(1, 12)]
    if document["measured"] is not None:
        document["measured"]["calibration"] |= {
            "scale_factor": [1.2 + 0.01 * w for w in wobble[:3]],
            "misalignment": [3e-3 * w for w in wobble[3:6]],
            "bias": [0.02 * w for w in wobble[6:9]],
        }
        failed = code.verdict is Verdict.FAIL
        document["limits"]["verification_rms_g"] = LIMIT_G
        document["verification"] = {
            "before_rms_g": 1.9e-3, "after_rms_g": FAILED_G if failed else 2.1e-5 + 5e-6 * wobble[9],
            "limit_rms_g": LIMIT_G,
        }  # fmt: skip
    return document
