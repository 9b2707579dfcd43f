"""Readings to specific force under a calibration with effects, by numpy alone."""

import json

import numpy as np

KNOWN = ("second_order_nonlinearity", "temperature_bias")


def apply(path, u, temp_c):
    """Specific force (n,3) in g of readings ``u`` (n,3) in output units, at temperatures ``temp_c`` (n,) in °C."""
    with open(path) as file:
        c = json.load(file)
    c = c.get("calibration", c)  # which diagnose writes inside its loop
    assert set(c["effects"]) == set(KNOWN)  # others need lines of their own
    k, (mx, my, mz), b = np.array(c["scale_factor"]), c["misalignment"], np.array(c["bias"])
    R = np.array([[1, mz, my], [0, 1, mx], [0, 0, 1]])
    q2, qT = (np.array([c["effects"][name][axis]["value"] for axis in "xyz"]) for name in KNOWN)
    dT = np.asarray(temp_c)[..., None] - c["channel_reference"]["temp_c"]
    s = v = u / k - b
    for _ in range(10):
        s = v - q2 * s**2 - qT * dT
    return np.linalg.solve(R, s.T).T
