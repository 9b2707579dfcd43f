"""The same poses to other people's programs: a plain least-squares fit, ODRPACK95's orthogonal distance, imucal's
Ferraris calibration, and the paper's closed form.

Errors are over the Cramér–Rao bound, rms over the nine parameters and the seeds; imucal's, which knows the faces and
calibrates in their frame, are compared by what needs no frame: |a| in directions that no fit saw.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares

from benchmarks.table import Table, chosen
from benchmarks.truth import PAPER_UNIT, Condition, bound_and_best, hard, plan
from triaxcal.estimate.initial_estimate import closed_form, coefficients
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose

SEEDS, QUICK = 200, 20
SIGMA = 1.5e-5


def _means(poses: Sequence[Pose]) -> np.ndarray:
    return np.array([p.mean for p in poses])


def ours(c: Condition, poses: Sequence[Pose]) -> np.ndarray:
    return fit(poses, signs=c.signs, excluded=()).values


def paper(c: Condition, poses: Sequence[Pose]) -> np.ndarray:
    """The closed form of the paper, as corrected, with the signs declared."""
    k, angles, b = coefficients(*closed_form(_means(poses)))
    x, y, z = c.signs
    return np.concatenate([k * c.signs, angles * [y * z, x * z, x * y], b * c.signs])


def _magnitude(u: np.ndarray, p: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|a| (n,) and a (n,3) by back substitution; ``p`` (9,) are scale factors in units of ``k``, angles, biases."""
    s = u / (p[:3] * k) - p[6:]
    y = s[:, 1] - p[3] * s[:, 2]
    a = np.stack([s[:, 0] - p[5] * y - p[4] * s[:, 2], y, s[:, 2]], axis=1)
    return np.linalg.norm(a, axis=1), a


def scipy_magnitude(c: Condition, poses: Sequence[Pose]) -> np.ndarray:
    """``scipy.optimize.least_squares`` on |a| − 1, every pose alike, from the truth."""
    u, k = _means(poses), c.unit.scale_factor
    first = np.concatenate([np.ones(3), c.truth[3:]])
    p = least_squares(lambda p: _magnitude(u, p, k)[0] - 1, first, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    return np.concatenate([p[:3] * k, p[3:]])


def orthogonal_distance(c: Condition, poses: Sequence[Pose]) -> np.ndarray:
    """ODRPACK95, implicit model ``|a(u)| = 1``, every output weighted by its own noise, from the truth."""
    from odrpack import odr_fit

    k = c.unit.scale_factor
    # Lengths in units of the noise would differ by orders between conditions; in g they are all alike.
    x = (_means(poses) / k).T
    weight = np.array([np.diag(p.covariance) for p in poses]).T / k[:, None] ** 2
    weight = weight.min() / weight

    def model(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        return np.asarray(_magnitude(x.T, p, np.ones(3))[0] - 1)

    def by_parameters(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        _, a, by_s = _gradient(x.T, p)
        s_over = x.T / p[:3] ** 2
        angles = np.stack([by_s[:, 1] * a[:, 2], by_s[:, 0] * a[:, 2], by_s[:, 0] * a[:, 1]], axis=1)
        return -np.concatenate([by_s * s_over, angles, by_s], axis=1).T[None]

    def by_outputs(x: np.ndarray, p: np.ndarray) -> np.ndarray:
        return (_gradient(x.T, p)[2] / p[:3]).T[None]

    first = np.concatenate([np.ones(3), c.truth[3:]])
    found = odr_fit(
        model,
        x,
        np.zeros(x.shape[1]),
        first,
        task="implicit-ODR",
        weight_x=weight,
        jac_beta=by_parameters,
        jac_x=by_outputs,
        sstol=1e-15,
        partol=1e-15,
        maxit=500,
    ).beta
    return np.concatenate([found[:3] * k, found[3:]])


def _gradient(u: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """|a|, a, and the gradient of |a| by s = R a (n,3)."""
    length, a = _magnitude(u, p, np.ones(3))
    n = a / length[:, None]
    second = n[:, 1] - p[5] * n[:, 0]
    return length, a, np.stack([n[:, 0], second, n[:, 2] - p[4] * n[:, 0] - p[3] * second], axis=1)


METHODS: dict[str, Callable[[Condition, Sequence[Pose]], np.ndarray]] = {
    "triaxcal": ours,
    "odrpack": orthogonal_distance,
    "scipy, |a| − 1": scipy_magnitude,
    "closed form": paper,
}


def cases() -> list[Condition]:
    rng = np.random.default_rng(0)
    by_pose = 1e-5 * np.geomspace(1, 30, 26)[rng.permutation(26)][:, None]
    return [
        Condition("14 poses, equal noise", PAPER_UNIT, plan(14), np.array(SIGMA)),
        Condition("26 poses, equal noise", PAPER_UNIT, plan(26), np.array(SIGMA)),
        Condition("noise 1 : 3 : 30 by axis", PAPER_UNIT, plan(26), np.array([1e-5, 3e-5, 3e-4])),
        Condition("noise 1 to 30 by pose", PAPER_UNIT, plan(26), by_pose),
        hard(),
    ]


def table(seeds: int) -> Table:
    rows = []
    for c in cases():
        bound = np.sqrt(np.diag(bound_and_best(c)[0]))
        cells, spent = [], {}
        draws = [c.draw(seed)[0] for seed in range(seeds)]
        for name, method in METHODS.items():
            begin = time.perf_counter()
            found = np.array([_or_nothing(method, c, poses) for poses in draws])
            spent[name] = time.perf_counter() - begin
            lost = np.isnan(found).any(axis=1)
            error = np.sqrt(np.mean(((found[~lost] - c.truth) / bound) ** 2)) if not lost.all() else np.nan
            cells.append("fails" if lost.all() else f"{error:.3g}" + (f" ({lost.sum()} lost)" if lost.any() else ""))
        cells += [f"{spent[name] / spent['triaxcal']:.2g}" for name in list(METHODS)[1:]]
        rows.append([c.name, *cells])
    return Table(
        f"Peers: rms error over the bound, {seeds} seeds; then the time that each takes, over ours",
        ["condition", *METHODS, *(f"{name}, time" for name in list(METHODS)[1:])],
        rows,
    )


def _or_nothing(
    method: Callable[[Condition, Sequence[Pose]], np.ndarray], c: Condition, poses: Sequence[Pose]
) -> np.ndarray:
    from triaxcal.errors import Refused

    try:
        return method(c, poses)
    except Refused:
        return np.full(9, np.nan)


# imucal


def ferraris(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (3,3) from the faces' frame to the outputs, and centre (3,), by imucal from the outputs (6,3) on the faces
    +X, −X, +Y, −Y, +Z, −Z. Its gyroscope gets readings that suit it.
    """
    from imucal import FerrarisCalibration, FerrarisSignalRegions

    names = ("acc_x_p", "acc_x_a", "acc_y_p", "acc_y_a", "acc_z_p", "acc_z_a")
    held = {name: np.repeat(u[None], 4, axis=0) for name, u in zip(names, faces, strict=True)}
    held |= {name.replace("acc", "gyr"): np.zeros((4, 3)) for name in names}
    for i, axis in enumerate("xyz"):
        held[f"acc_{axis}_rot"] = np.repeat(faces[2 * i][None], 4, axis=0)
        held[f"gyr_{axis}_rot"] = np.repeat(-360 * np.eye(3)[i][None], 4, axis=0)
    found = FerrarisCalibration(grav=1.0).compute(
        FerrarisSignalRegions(**held), sampling_rate_hz=4, from_acc_unit="V", from_gyr_unit="deg/s"
    )
    return np.asarray(found.K_a @ found.R_a), np.asarray(found.b_a)


FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)


def faces_table(seeds: int) -> Table:
    """Errors of |a| in directions that no fit saw, for faces that are not exact and a unit that does not sit square."""
    c = Condition("", PAPER_UNIT, plan(26), np.array(SIGMA))
    rng = np.random.default_rng(0)
    held_out = rng.standard_normal((200, 3))
    held_out /= np.linalg.norm(held_out, axis=1, keepdims=True)
    u_out = PAPER_UNIT.output(held_out, {})
    rows = []
    for name, tilt in (("exact", 0.0), ("0.1 mrad off", 1e-4), ("1 mrad off", 1e-3)):
        errors: dict[str, list[float]] = {"triaxcal, 26 poses": [], "imucal, 6 faces": []}
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 24])
            ups = c.ups + tilt * rng.standard_normal(c.ups.shape)
            tilted = Condition("", PAPER_UNIT, ups / np.linalg.norm(ups, axis=1, keepdims=True), np.array(SIGMA))
            poses, _ = tilted.draw(seed)
            p = ours(tilted, poses)
            unit = Sensor(p[:3], p[3:6], p[6:])
            errors["triaxcal, 26 poses"].append(_held_out(unit.specific_force(u_out, {})))
            means = _means(poses)
            faces = np.array([means[int(np.argmax(c.ups @ v))] for v in FACES]) * np.sign(PAPER_UNIT.scale_factor)
            M, centre = ferraris(faces)
            errors["imucal, 6 faces"].append(
                _held_out(np.linalg.solve(M, (u_out * np.sign(PAPER_UNIT.scale_factor) - centre).T).T)
            )
        rms = [float(np.sqrt(np.mean(np.square(e)))) for e in errors.values()]
        rows.append([name, *(f"{r / SIGMA:.2f}" for r in rms)])
    return Table(
        f"Six faces: rms error of |a| in other directions, in standard errors of a pose, {seeds} seeds",
        ["directions of the poses", *errors],
        rows,
    )


def _held_out(a: np.ndarray) -> float:
    return float(np.sqrt(np.mean((np.linalg.norm(a, axis=1) - 1) ** 2)))


def main(arguments: list[str] | None = None) -> int:
    quick = chosen(__doc__, arguments)
    print(table(QUICK if quick else SEEDS))
    print(faces_table(QUICK if quick else SEEDS))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
