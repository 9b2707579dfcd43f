"""Documents of the interface as its contract has them, of 48 runs."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any

from tests.daemon.service.page.stage import run_row
from triaxcald.schema.columns import NAMES

FAILED = {
    5: "verification_outside",
    11: "no_poses",
    18: "verification_outside",
    23: "fit_outside",
    24: "lost",
    30: "verification_outside",
    37: "stopped",
}
XSS = "<script>window.caught=1</script>"


def rows() -> list[dict[str, Any]]:
    """Oldest first."""
    return [run_row(i, serial=f"SN-{1000 + i}", code=FAILED.get(i, "within_limits")) for i in range(47)] + [
        run_row(47, serial=XSS)
    ]


def characteristic(name: str, unit: str, high: float | None, found: list[dict[str, Any]]) -> dict[str, Any]:
    points = [
        {"run": r["run"], "serial": r["serial"], "time": r["ended"], "value": r[name]}
        for r in found
        if r[name] is not None
    ]
    values = [p["value"] for p in points]
    mean = sum(values) / len(values)
    sd = (sum((v - mean) ** 2 for v in values) / (len(values) - 1)) ** 0.5
    ranges = [abs(b - a) for a, b in itertools.pairwise(values)]
    width = sum(ranges) / len(ranges)
    ppk = None if high is None or len(values) < 30 else (high - mean) / (3 * sd)
    return {
        "name": name, "unit": unit, "n": len(values), "mean": mean, "sd": sd, "low": None, "high": high, "ppk": ppk,
        "ppk_interval": None if ppk is None else [0.8 * ppk, 1.2 * ppk],
        "chart": {
            "points": points,
            "individuals": {"centre": mean, "lower": mean - 2.66 * width, "upper": mean + 2.66 * width},
            "moving_range": {"centre": width, "lower": 0.0, "upper": 3.267 * width},
        },
    }  # fmt: skip


def quality(found: list[dict[str, Any]]) -> dict[str, Any]:
    codes = Counter(r["code"] for r in found)
    return {
        "format": "triaxcal.quality/1", "units": 46, "attempts": len(found), "first_pass_yield": 0.87, "yield": 0.93,
        "codes": dict(codes),
        "characteristics": [
            characteristic(name, unit, 5e-5 if name == "verification_rms_g" else None, found)
            for name, unit in [("verification_rms_g", "g"), ("rms_g", "g"), ("bias_x", "g"), ("misalignment_z", "rad")]
        ],
    }  # fmt: skip


def events(run: str) -> list[dict[str, Any]]:
    head = {"format": "triaxcal.event/1", "run": run, "tray": "t", "unit": "a"}
    at = "2026-01-20T06:00:0{}.000+00:00"
    return [
        head | {"seq": 1, "time": at.format(1), "event": "stage", "stage": "identity"},
        head | {"seq": 2, "time": at.format(2), "event": "stage", "stage": "poses"},
        head | {"seq": 3, "time": at.format(3), "event": "poses", "found": 1, "wanted": 14,
                "next": {"label": "+X", "vector": [1, 0, 0], "once_more": False}},
        head | {"seq": 4, "time": at.format(4), "event": "lost", "code": "lost", "reason": "no answer for 2 s"},
        head | {"seq": 5, "time": at.format(5), "event": "back"},
        head | {"seq": 6, "time": at.format(6), "event": "ended", "outcome": {"verdict": "pass"}},
    ]  # fmt: skip


def documents() -> dict[str, Any]:
    found = rows()
    newest = found[::-1]
    unit = [
        run_row(i, serial="SN-1005", code=code, attempt=i - 99)
        for i, code in ((100, "verification_outside"), (101, "within_limits"), (102, "within_limits"))
    ]
    assert set(found[0]) == set(NAMES)
    return {
        "runs": {"runs": newest, "next": "47"},
        "units/SN-1005": {"serial": "SN-1005", "runs": unit},
        f"units/{XSS}": {"serial": XSS, "runs": [found[47]]},
        "quality": quality(found),
        **{f"runs/{r['run']}": r | {"events": events(r["run"])} for r in found},
    }
