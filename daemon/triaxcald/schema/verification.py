"""The check of a device by its own output (`triaxcal.verification/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc


class CheckPose(tc.schema.Model):
    start_s: Annotated[
        tc.schema.Figure, Field(description="first sample of the still span, from the phase's first sample [s]")
    ]
    end_s: Annotated[
        tc.schema.Figure, Field(description="last sample of the still span, from the phase's first sample [s]")
    ]
    error_g: Annotated[tc.schema.Figure | None, Field(description="|a| − reference [g]")]
    standard_error_g: Annotated[tc.schema.Figure | None, Field(description="standard error of `error_g` by noise [g]")]
    used: Annotated[bool, Field(description="whether the pose counts")]
    fault: Annotated[
        str | None, Field(description="`saturation` or `stuck_output`, for which it does not count; else `null`")
    ]
    from_fit_deg: Annotated[tc.schema.Figure, Field(description="angle to the nearest attitude of the fit [°]")]


class Verification(tc.schema.Model):
    """The magnitude that the device itself reports, in other attitudes than the
    fit's."""

    format: Annotated[Literal["triaxcal.verification/1"], Field(description="format of this document")]
    raw_sha256: Annotated[tc.schema.Sha256, Field(description="digest of the raw records of the phase `verification`")]
    before_rms_g: Annotated[
        tc.schema.Figure | None,
        Field(description="rms error of the corrected output in the poses of the calibration, with old registers [g]"),
    ]
    after_rms_g: Annotated[
        tc.schema.Figure | None,
        Field(description="rms error in the check poses, with new registers, after a restart [g]"),
    ]
    after_max_abs_g: Annotated[tc.schema.Figure | None, Field(description="largest error in the check poses [g]")]
    noise_floor_g: Annotated[
        tc.schema.Figure | None, Field(description="rms that noise alone makes in the check poses [g]")
    ]
    limit_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="the station's limit of `after_rms_g` [g]; else `null`")
    ]
    verdict: Annotated[
        Literal["within limits", "outside limits", "not judged", "worse than before"],
        Field(
            description="`within limits`, `outside limits`; without a limit `not judged`, "
            "or `worse than before` (F-test at 1 %)"
        ),
    ]
    poses: Annotated[list[CheckPose], Field(description="the check poses, in the order of time")]
    data_quality: Annotated[list[str], Field(description="faults of the corrected stream, one line each")]
    expanded_uncertainty_g: Annotated[
        tc.schema.Figure | None, Field(description="of `after_rms_g` by noise, coverage factor 2 [g]")
    ]
    poses_apart: Annotated[
        int, Field(description="number of check poses at least `plan.apart_deg` from each pose of the fit")
    ]
