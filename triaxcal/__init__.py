"""The metrology of three-axis accelerometers: numbers in, numbers out. Needs
numpy and scipy alone.

    import triaxcal as tc

    poses = tc.find_poses(t, u, channels={"temp_c": temperature})
    calibration = tc.calibrate(poses)
    a = calibration.apply(u)

Everything is loaded when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from triaxcal.documents import Calibration
    from triaxcal.errors import InvalidData, MissingChannel, Refused, TriaxcalError
    from triaxcal.poses.pose import Pose
    from triaxcal.uncertainty import Stated

    __version__: str

_WHERE = {
    "Calibration": "triaxcal.documents",
    "Diagnosis": "triaxcal.api",
    "InvalidData": "triaxcal.errors",
    "MissingChannel": "triaxcal.errors",
    "PlannedPose": "triaxcal.api",
    "Pose": "triaxcal.poses.pose",
    "Poses": "triaxcal.api",
    "Refused": "triaxcal.errors",
    "Stated": "triaxcal.uncertainty",
    "TriaxcalError": "triaxcal.errors",
    "Verification": "triaxcal.api",
    "budget": "triaxcal.api",
    "calibrate": "triaxcal.api",
    "diagnose": "triaxcal.api",
    "find_poses": "triaxcal.api",
    "plan": "triaxcal.api",
    "rezero": "triaxcal.api",
    "verify": "triaxcal.api",
}

__all__ = [
    "Calibration",
    "Diagnosis",
    "InvalidData",
    "MissingChannel",
    "PlannedPose",
    "Pose",
    "Poses",
    "Refused",
    "Stated",
    "TriaxcalError",
    "Verification",
    "__version__",
    "budget",
    "calibrate",
    "diagnose",
    "find_poses",
    "plan",
    "rezero",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version  # as slow to import as numpy's half

        return version("triaxcal")
    if name not in _WHERE:
        raise AttributeError(f"module 'triaxcal' has no attribute '{name}'")
    from importlib import import_module

    found = getattr(import_module(_WHERE[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
