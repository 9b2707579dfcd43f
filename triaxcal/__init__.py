"""The metrology of three-axis accelerometers: numbers in, numbers out. Needs
numpy and scipy alone; the models of its documents (`tc.schema`) need pydantic.

    import triaxcal as tc

    poses = tc.find_poses(t, u, channels={"temp_c": temperature})
    calibration = tc.calibrate(poses)
    a = calibration.apply(u)

Everything is loaded when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from triaxcal.lazy import lazily

if TYPE_CHECKING:
    from triaxcal import (
        diagnosis,
        distributions,
        documents,
        effects,
        estimate,
        evidence,
        frames,
        inputs,
        interchange,
        number_format,
        pictures,
        planning,
        pooled_units,
        population,
        poses,
        rounding,
        schema,
        synthetic,
        text,
        uncertainty,
        units,
    )
    from triaxcal.api import (
        Diagnosis,
        PlannedPose,
        Poses,
        Verification,
        budget,
        calibrate,
        diagnose,
        find_poses,
        plan,
        rezero,
        verify,
    )
    from triaxcal.arrays import Floats, Ints
    from triaxcal.documents import Calibration
    from triaxcal.errors import InvalidData, MissingChannel, Refused, TooShort, TriaxcalError
    from triaxcal.model.gravity import HEIGHTS_M, local_gravity_g
    from triaxcal.model.samples import Moment, Samples
    from triaxcal.model.sensor import Sensor
    from triaxcal.poses.pose import Pose, StillSpan
    from triaxcal.progress import Stage
    from triaxcal.uncertainty import Stated

    __version__: str

_ROOMS = (
    "diagnosis",
    "distributions",
    "documents",
    "effects",
    "estimate",
    "evidence",
    "frames",
    "inputs",
    "interchange",
    "number_format",
    "pictures",
    "planning",
    "pooled_units",
    "population",
    "poses",
    "rounding",
    "schema",
    "synthetic",
    "text",
    "uncertainty",
    "units",
)
_NAMES = {
    "api": (
        "Diagnosis",
        "PlannedPose",
        "Poses",
        "Verification",
        "budget",
        "calibrate",
        "diagnose",
        "find_poses",
        "plan",
        "rezero",
        "verify",
    ),
    "arrays": (
        "Floats",
        "Ints",
    ),
    "documents": ("Calibration",),
    "errors": (
        "InvalidData",
        "MissingChannel",
        "Refused",
        "TooShort",
        "TriaxcalError",
    ),
    "model.gravity": (
        "HEIGHTS_M",
        "local_gravity_g",
    ),
    "model.samples": (
        "Moment",
        "Samples",
    ),
    "model.sensor": ("Sensor",),
    "poses.pose": (
        "Pose",
        "StillSpan",
    ),
    "progress": ("Stage",),
    "uncertainty": ("Stated",),
}

__all__ = [
    "HEIGHTS_M",
    "Calibration",
    "Diagnosis",
    "Floats",
    "Ints",
    "InvalidData",
    "MissingChannel",
    "Moment",
    "PlannedPose",
    "Pose",
    "Poses",
    "Refused",
    "Samples",
    "Sensor",
    "Stage",
    "Stated",
    "StillSpan",
    "TooShort",
    "TriaxcalError",
    "Verification",
    "__version__",
    "budget",
    "calibrate",
    "diagnose",
    "diagnosis",
    "distributions",
    "documents",
    "effects",
    "estimate",
    "evidence",
    "find_poses",
    "frames",
    "inputs",
    "interchange",
    "local_gravity_g",
    "number_format",
    "pictures",
    "plan",
    "planning",
    "pooled_units",
    "population",
    "poses",
    "rezero",
    "rounding",
    "schema",
    "synthetic",
    "text",
    "uncertainty",
    "units",
    "verify",
]


if not TYPE_CHECKING:  # a checker would take any name for one that is here
    _find = lazily(__name__, _NAMES, _ROOMS)

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            from importlib.metadata import version  # as slow to import as numpy's half

            return version("triaxcal")
        return _find(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
