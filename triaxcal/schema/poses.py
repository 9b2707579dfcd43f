"""The still poses of a recording (`triaxcal.poses/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from triaxcal.schema.model import Figure, Figures, Model, Text


class FoundPose(Model):
    start_s: Annotated[Figure, Field(description="first sample of the still span, from the first of the recording [s]")]
    end_s: Annotated[Figure, Field(description="last sample of the still span [s]")]
    samples: Annotated[int, Field(description="number of samples in it, less those that a bump disturbs")]
    mean: Annotated[Figures, Field(description="mean of x, y, z [output]")]
    standard_error: Annotated[Figures, Field(description="standard error of the mean, with autocorrelation [output]")]
    channels: Annotated[
        dict[Text, Figure | None], Field(description="means of the other channels by name [as they are logged]")
    ]
    used: Annotated[
        bool | None, Field(description="whether it can be trusted; absent where the caller does not judge")
    ] = None
    fault: Annotated[
        Text | None, Field(description="`saturation` or `stuck_output`, for which it cannot; else `null`")
    ] = None


class Poses(Model):
    """The still spans that `poses` finds."""

    format: Annotated[Literal["triaxcal.poses/1"], Field(description="format of this document")]
    poses: Annotated[list[FoundPose], Field(description="the poses, in the order of time")]
    data_quality: Annotated[
        list[Text],
        Field(
            default_factory=list,
            description="[faults of the raw stream](../explanation/data-quality.md), one line each",
        ),
    ]
