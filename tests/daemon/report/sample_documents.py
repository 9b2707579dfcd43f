"""Realistic documents for the report's tests: a synthetic unit with a second-order nonlinearity, really fitted."""

from __future__ import annotations

from copy import deepcopy
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

NOISE_G = 1.5e-5
_K = np.array([-2.410618, -2.403823, -2.371761])
_ANGLES = np.array([625.454406e-5, 404.734018e-5, -65.046441e-5])
_BIAS = np.array([564.518583e-5, -288.4559e-5, 463.952349e-5])
_SECOND_ORDER = np.array([3.1e-4, -1.9e-4, 2.4e-4])
_TRUE = np.concatenate([_K, _ANGLES, _BIAS, _SECOND_ORDER])


def directions(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Faces, vertices and edges of the cube for 26, any directions beyond."""
    cube = np.array([v for v in product((-1, 0, 1), repeat=3) if any(v)], dtype=np.float64)
    places = cube if count <= 26 else np.concatenate([cube, rng.normal(size=(count - 26, 3))])
    return places[:count] / np.linalg.norm(places[:count], axis=1, keepdims=True)


def _misalignment(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    ax, ay, az = angles
    return np.array([[1, az, ay], [0, 1, ax], [0, 0, 1]])


def _invert(parameters: NDArray[np.float64], outputs: NDArray[np.float64]) -> NDArray[np.float64]:
    known = np.zeros(12)
    known[: parameters.size] = parameters
    k, angles, bias, second_order = known.reshape(4, 3)
    v = outputs / k - bias
    s = v
    for _ in range(4):
        s = v - second_order * s**2
    solved: NDArray[np.float64] = np.linalg.solve(_misalignment(angles), s.T).T
    return solved


def _fit(outputs: NDArray[np.float64], size: int) -> tuple[Any, ...]:
    def residual(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.linalg.norm(_invert(parameters, outputs), axis=1) - 1.0

    scale = np.array([1.0] * 3 + [1e-2] * 6 + [1e-3] * 3)[:size]
    start = np.concatenate([[-2.4] * 3, np.zeros(size - 3)])
    found = least_squares(residual, start, x_scale=scale, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * NOISE_G**2
    leverage = np.einsum("ij,jk,ik->i", found.jac, covariance, found.jac) / NOISE_G**2
    return found.x, np.sqrt(np.diag(covariance)), found.fun, leverage


def _residual(errors: NDArray[np.float64], leverage: NDArray[np.float64], p: float) -> dict[str, float]:
    return {
        "rms_g": float(np.sqrt(np.mean(errors**2))),
        "max_abs_g": float(np.abs(errors).max()),
        "cross_validated_rms_g": float(np.sqrt(np.mean((errors / (1 - leverage)) ** 2))),
        "noise_floor_g": NOISE_G,
        "lack_of_fit_p": p,
    }


def loop_document(count: int = 26, seed: int = 7) -> dict[str, Any]:
    """A `triaxcal.loop/1` in which a second-order nonlinearity is found and adopted."""
    rng = np.random.default_rng(seed)
    up = directions(count, rng)
    s = up @ _misalignment(_ANGLES).T
    outputs = _K * (s + _BIAS + _SECOND_ORDER * s**2 + rng.normal(scale=NOISE_G, size=s.shape))
    _, _, before, before_leverage = _fit(outputs, 9)
    found, error, after, leverage = _fit(outputs, 12)
    named = {
        axis: {"value": found[9 + i], "standard_error": error[9 + i], "unit": "g/g^2"} for i, axis in enumerate("xyz")
    }
    calibration = _calibration(found, error, named)
    calibration["residual"] = _residual(after, leverage, 0.43)
    recovered = _invert(found, outputs)
    calibration["poses"] = [
        {
            "start_s": 40.0 * i + 6.0,
            "end_s": 40.0 * i + 36.0,
            "mean": outputs[i].tolist(),
            "residual_g": float(after[i]),
            "studentized": float(after[i] / (NOISE_G * np.sqrt(1 - leverage[i]))),
            "leverage": float(leverage[i]),
            "used": True,
            "standard_error_g": NOISE_G,
            "channels": {"temp_c": 22.0 + 0.1 * i, "supply_v": 5.0},
            "direction": (recovered[i] / np.linalg.norm(recovered[i])).tolist(),
            "before_residual_g": float(before[i]),
        }
        for i in range(count)
    ]
    return {
        "format": "triaxcal.loop/1",
        "before": _residual(before, before_leverage, 1e-40),
        "after": calibration["residual"],
        "held_out": {"before_rms_g": 1.31e-4, "after_rms_g": 1.62e-5, "noise_floor_g": 1.49e-5, "poses": 9},
        "findings": [
            {
                "effect": "second_order_nonlinearity",
                "verdict": "adopted",
                "probability": 0.9998,
                "coefficients": named,
                "alternatives": [],
                "probabilities": {},
                "reason": "it acts with probability more than 0.999",
                "remedy": "Store the second-order coefficients in the device; nothing has to be repaired.",
            },
            {
                "effect": "temperature_bias",
                "verdict": "confounded",
                "probability": 0.7,
                "coefficients": {"x": {"value": 2.1e-6, "standard_error": 7.0e-7, "unit": "g/K"}},
                "alternatives": ["bias_drift", "warm_up"],
                "probabilities": {"bias_drift": 0.2, "warm_up": 0.095},
                "reason": "it acts with probability 0.7, or else bias_drift 0.2, warm_up 0.095: one of them with 0.995",
                "remedy": "Repeat four poses at another temperature.",
            },
        ],
        "candidates": [],
        "unexplained": {"significant": False, "probability": 0.043, "kind": "time", "rms_g": 4.0e-6, "lead": ""},
        "data_quality": ["mains_pickup: 50 Hz at 12 µV on y, averages out in every pose"],
        "advice": ["Add two poses at 35 °C to separate temperature from drift."],
        "calibration": calibration,
    }


def _calibration(found: NDArray[np.float64], error: NDArray[np.float64], named: dict[str, Any]) -> dict[str, Any]:
    k, angles, bias, _ = found.reshape(4, 3)
    k_error, angle_error, bias_error, _ = error.reshape(4, 3)
    return {
        "format": "triaxcal.calibration/1",
        "terms": ["linear", "second_order_nonlinearity"],
        "units": {"output": "V", "scale_factor": "V/g", "misalignment": "rad", "bias": "g"},
        "scale_factor": k.tolist(),
        "misalignment": angles.tolist(),
        "bias": bias.tolist(),
        "matrix": np.linalg.inv(np.diag(k) @ _misalignment(angles)).tolist(),
        "centre": (k * bias).tolist(),
        "effects": {"second_order_nonlinearity": named},
        "standard_error": {
            "scale_factor": k_error.tolist(),
            "misalignment": angle_error.tolist(),
            "bias": bias_error.tolist(),
        },
        "condition": 14.2,
        "blind_to": ["hysteresis", "vibration_rectification"],
        "warnings": ["The temperature spans 1.2 K only."],
    }


def certificate() -> dict[str, Any]:
    return {
        "format": "triaxcal.certificate/1",
        "unit": {"model": "TRIAX-REF", "serial_number": "TR-000123"},
        "recording": {"file": "run-17.mcap", "sha256": "9f" * 32},
        "software": {"triaxcal": "0.1.0", "numpy": "2.4.6"},
        "date": "2024-05-17",
        "limits": {"cross_validated_rms_g": 5e-5, "max_abs_g": 1e-4},
    }


def raw_stream(document: dict[str, Any], rate_hz: float = 50.0) -> tuple[NDArray[np.float64], ...]:
    """time_s (n,), readings (n, 3) that pass through the document's poses with turns between them."""
    poses = document["calibration"]["poses"]
    times = np.arange(0.0, poses[-1]["end_s"] + 6.0, 1.0 / rate_hz)
    knots = np.array([edge for pose in poses for edge in (pose["start_s"], pose["end_s"])])
    levels = np.repeat([pose["mean"] for pose in poses], 2, axis=0)
    clean = np.column_stack([np.interp(times, knots, levels[:, axis]) for axis in range(3)])
    return times, clean + np.random.default_rng(3).normal(scale=0.004, size=clean.shape)


def without_pictures(document: dict[str, Any]) -> dict[str, Any]:
    """A copy with poses whose residuals nobody knows: their pictures take most of a page's time."""
    document = deepcopy(document)
    for pose in document["calibration"]["poses"]:
        pose |= {"residual_g": None, "before_residual_g": None}
    return document
