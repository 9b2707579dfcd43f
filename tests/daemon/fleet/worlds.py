"""Folders of simulated outcomes and certificates of known truth."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from triaxcald.documents import to_text

START = datetime(2026, 1, 5, 6, tzinfo=UTC)
ERRORS = {"scale_factor": 1e-5, "misalignment": 7e-6, "bias": 3e-5}
RESIDUAL = {"max_abs_g": 6e-5, "noise_floor_g": 2e-5, "lack_of_fit_p": 0.5}


def residual(rms: float) -> dict[str, Any]:
    return {"rms_g": rms, "cross_validated_rms_g": 1.3 * rms} | RESIDUAL


def outcome(
    serial: str, day: float, figures: dict[str, np.ndarray], rms: float = 2.5e-5, **work: Any
) -> dict[str, Any]:
    """An attempt that ended well; ``work`` has also the station."""
    began = START + timedelta(days=day)
    given = {"operator": None, "order": None, "batch": None, "part_number": "TX-1", "fixture": None, "slot": "a"} | work
    station = given.pop("station", "line1")
    return {
        "format": "triaxcal.outcome/1",
        "unit": given["slot"],
        "serial": serial,
        "station": station,
        "run": str(uuid.uuid5(uuid.NAMESPACE_OID, f"{serial} {day} {station} {given}")),
        "started": began.isoformat(timespec="milliseconds"),
        "ended": (began + timedelta(minutes=9)).isoformat(timespec="milliseconds"),
        "work": {"serial": serial, "attempt": 1, "reason": None} | given,
        "verdict": "pass",
        "code": "within_limits",
        "reason": "within the limits",
        "exit_code": 0,
        "device_state": "new_verified",
        "limits": {"rms_g": 5e-5, "cross_validated_rms_g": None, "verification_rms_g": None},
        "measured": {
            "poses": 26,
            "before": residual(2e-4),
            "after": residual(rms),
            "terms": ["linear"],
            "calibration": {
                **{name: np.asarray(of).tolist() for name, of in figures.items()},
                "standard_error": {name: [error] * 3 for name, error in ERRORS.items()},
            },
        },
    }


def certificate(probability: float, uncertainty: float = 2.6e-5) -> dict[str, Any]:
    """What `fleet` takes of one, with the same words at other depths."""
    return {
        "format": "triaxcal.certificate/1",
        "unit": {"name": 'a "calibration": {', "effects": {"x": 1}},
        "result": {
            "format": "triaxcal.loop/1",
            "findings": [{"effect": "hysteresis", "probabilities": {"remanence": 0.1}}],
            "probabilities": {"temperature_bias": probability, "hysteresis": None},
            "calibration": {
                "effects": {
                    "temperature_bias": {
                        "x": {"value": 1e-5 * probability, "standard_error": 1e-6, "unit": "g/K"},
                        "weight": probability,
                    }
                },
                "expanded_uncertainty_g": {"this_fit": uncertainty, "another_day": 4e-3},
            },
        },
    }


def write(folder: Path, documents: list[dict[str, Any]], certificates: list[dict[str, Any]] | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for i, document in enumerate(documents):
        name = f"{document['unit']}-{document['serial']}-{i:05d}"
        (folder / f"{name}.outcome.json").write_text(to_text(document), encoding="utf-8")
        if certificates is not None:
            (folder / f"{name}.certificate.json").write_text(to_text(certificates[i]), encoding="utf-8")
    return folder


def line(
    units: int = 60, seed: int = 1, repeats: int = 3, repeated: int = 10, shift: float = 8e-3, walk: float = 0.0
) -> list[dict[str, Any]]:
    """Units in two batches on two stations and three fixtures, over a year. The first
    ``repeated`` come back, on every fixture. Fixture F2 shifts the bias of y by
    ``shift`` g; the biases of a unit walk by ``walk`` g a √day."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(units):
        k = np.array([-2.41, -2.40, -2.37]) * (1 + rng.normal(0, 2e-3, 3))
        b, angles = rng.normal(0, 3e-3, 3), rng.normal(0, 3e-3, 3)
        first, last = 360 * i / units, 0.0
        for j in range(repeats if i < repeated else 1):
            day = first + 20 * j * (1 + 0.5 * j)
            b = b + rng.normal(0, walk * np.sqrt(day - last if j else 0.0), 3)
            last = day
            fixture = f"F{1 + (i + j) % 3}"
            noisy = b + rng.normal(0, ERRORS["bias"], 3) + (np.array([0, shift, 0]) if fixture == "F2" else 0)
            figures = {
                "scale_factor": k * (1 + rng.normal(0, 1e-5, 3)),
                "misalignment": angles + rng.normal(0, 7e-6, 3),
                "bias": noisy,
            }
            found.append(
                outcome(
                    str(5000 + i), day, figures, float(abs(rng.normal(2.5e-5, 4e-6))), fixture=fixture,
                    batch=f"B{1 + 2 * i // units}", station=f"line{1 + i % 2}", slot="ab"[i % 2],
                )
            )  # fmt: skip
    return found
