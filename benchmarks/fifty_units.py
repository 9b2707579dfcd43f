"""Fifty units from DataFrames to a table, here and with imucal: `python -m benchmarks.fifty_units`.

Each unit is held in 26 directions by hand (about 3° off) for triaxcal, and on six faces of a block (1 mrad off), with a
turn about each axis, for imucal. imucal is given the sections of its recordings, which its user marks with the mouse.
Lines are those of the functions here, and times those of one run.
"""

from __future__ import annotations

import argparse
import inspect
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

import triaxcal as tc
from benchmarks.table import Table
from triaxcal.arrays import Floats

RATE, DURATION_S, MOVED_S, NOISE_V, VOLTS_PER_G = 100, 2.0, 1.0, 1e-3, 2.0
BY_HAND, BLOCK = 0.05, 1e-3
"""Standard deviation in rad of how far a direction is off."""
FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
SECTIONS = ("x_p", "x_a", "y_p", "y_a", "z_p", "z_a", "x_rot", "y_rot", "z_rot")


class Unit:
    """A linear one, made from its number. Readings are in volts."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.matrix = VOLTS_PER_G * (np.diag(1 + self.rng.normal(0, 0.01, 3)) + self.rng.normal(0, 2e-3, (3, 3)))
        self.bias = VOLTS_PER_G * self.rng.normal(0, 0.02, 3)

    def volts(self, a: Floats) -> Floats:
        return np.asarray(a @ self.matrix.T + self.bias + self.rng.normal(0, NOISE_V, a.shape))

    def recording(self, ups: Floats, off: float) -> pd.DataFrame:
        ups = ups + off * self.rng.standard_normal(ups.shape)
        ups /= np.linalg.norm(ups, axis=1)[:, None]
        way = np.linspace(0, 1, int(MOVED_S * RATE))[:, None]
        pieces = []
        for one, other in zip(ups, [*ups[1:], ups[-1]], strict=True):
            move = (1 - way) * one + way * other
            length = np.linalg.norm(move, axis=1)[:, None]
            pieces += [np.repeat(one[None], int(DURATION_S * RATE), axis=0), move / np.maximum(length, 0.1)]
        a = np.concatenate(pieces)
        frame = pd.DataFrame(self.volts(a), columns=["ax", "ay", "az"])
        frame.insert(0, "time", np.arange(len(a)) / RATE)
        return frame

    def session(self) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Accelerometer and gyroscope on six faces and in three turns, and where each section begins and ends."""
        n = int(DURATION_S * RATE)
        faces = FACES + BLOCK * self.rng.standard_normal(FACES.shape)
        held = [np.repeat(v[None], n, axis=0) for v in faces]
        turned = [np.repeat(faces[2 * i][None], n, axis=0) for i in range(3)]
        rates = [np.zeros((n, 3))] * 6 + [
            np.repeat(-360 / DURATION_S * np.eye(3)[i][None], n, axis=0) for i in range(3)
        ]
        frame = pd.DataFrame(self.volts(np.concatenate(held + turned)), columns=["acc_x", "acc_y", "acc_z"])
        frame[["gyr_x", "gyr_y", "gyr_z"]] = np.concatenate(rates)
        starts = n * np.arange(len(SECTIONS))
        return frame, pd.DataFrame({"start": starts, "end": starts + n}, index=list(SECTIONS))


def with_triaxcal(recordings: Sequence[pd.DataFrame], folder: Path) -> tuple[list[Any], pd.DataFrame]:
    calibrations, rows = [], []
    for i, frame in enumerate(recordings):
        calibration = tc.calibrate(frame, columns={"t": "time", "ux": "ax", "uy": "ay", "uz": "az"})
        calibration.save(folder / f"{i}.json")
        calibrations.append(calibration)
        rows.append([*calibration.scale_factor, *calibration.bias, calibration.residual.rms_g])
    return calibrations, pd.DataFrame(rows, columns=["sx", "sy", "sz", "bx", "by", "bz", "rms"])


def with_imucal(sessions: Sequence[tuple[pd.DataFrame, pd.DataFrame]], folder: Path) -> tuple[list[Any], pd.DataFrame]:
    from imucal import FerrarisCalibration, ferraris_regions_from_section_list

    calibrations, rows = [], []
    for i, (frame, sections) in enumerate(sessions):
        regions = ferraris_regions_from_section_list(frame, sections)
        calibration = FerrarisCalibration(grav=1.0).compute(
            regions, sampling_rate_hz=RATE, from_acc_unit="V", from_gyr_unit="deg/s"
        )
        (folder / f"{i}.json").write_text(calibration.to_json())
        calibrations.append(calibration)
        rows.append([*np.diag(calibration.K_a), *calibration.b_a])
    return calibrations, pd.DataFrame(rows, columns=["sx", "sy", "sz", "bx", "by", "bz"])


def fifty_units(units: int) -> Table:
    """Lines, seconds, and the rms error of |a| in directions that no fit saw."""
    made = [Unit(seed) for seed in range(units)]
    ups = np.array([p.up for p in tc.plan(26)])
    a = np.random.default_rng(1).standard_normal((200, 3))
    a /= np.linalg.norm(a, axis=1)[:, None]
    readings = [a @ unit.matrix.T + unit.bias for unit in made]
    recordings = [unit.recording(ups, BY_HAND) for unit in made]
    sessions = [unit.session() for unit in made]
    with TemporaryDirectory() as folder:
        ours, our_s = _timed(with_triaxcal, recordings, Path(folder))
        theirs, their_s = _timed(with_imucal, sessions, Path(folder))
    applied = [c.apply(u) for c, u in zip(ours, readings, strict=True)]
    peer = [np.linalg.solve(c.K_a @ c.R_a, (u - c.b_a).T).T for c, u in zip(theirs, readings, strict=True)]
    rows = [
        ["triaxcal, 26 directions by hand", _lines(with_triaxcal), f"{our_s / their_s:.1f}", _error(applied)],
        ["imucal, six faces, sections given", _lines(with_imucal), "1.0", _error(peer)],
    ]
    return Table(
        f"{units} units from DataFrames to a table and documents (imucal: {their_s / units * 1e3:.0f} ms a unit)",
        ["program", "lines", "time", "rms error of |a| [µg]"],
        rows,
    )


def _timed(function: Callable[..., tuple[list[Any], pd.DataFrame]], *arguments: Any) -> tuple[list[Any], float]:
    begin = time.process_time()
    calibrations, _ = function(*arguments)
    return calibrations, time.process_time() - begin


def _lines(function: Callable[..., Any]) -> str:
    return str(len([line for line in inspect.getsource(function).splitlines() if line.strip()]))


def _error(applied: Sequence[Floats]) -> str:
    errors = np.concatenate([np.linalg.norm(a, axis=1) - 1 for a in applied])
    return f"{1e6 * float(np.sqrt(np.mean(errors**2))):.0f}"


if __name__ == "__main__":
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    p.add_argument("--units", type=int, default=50)
    print(fifty_units(p.parse_args().units))
