"""The calibration of a unit (`triaxcal.calibration/1`).

The keys that a method adds to a fit of still poses have a default: a document of
another method does without.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from triaxcal.schema.model import (
    ByParameter,
    Figure,
    Figures,
    Matrix,
    Model,
    Residual,
    Sha256,
    Text,
    Uncertainty,
    Vector,
)

Excluded = Literal["fault", "outlier", "caller", "unknown_history"]
Source = Literal["poses", "passport", "both"]


class Units(Model):
    output: Annotated[Text, Field(description="unit of the readings; empty where it is not known")]
    reference: Annotated[Text, Field(description="unit of the reference vector")]
    scale_factor: Annotated[Text, Field(description="unit of the scale factors")]
    misalignment: Annotated[Text, Field(description="unit of the misalignments")]
    bias: Annotated[Text, Field(description="unit of the biases")]


class HoldsAt(Model):
    moment: Annotated[
        Literal["end", "mean", "seconds"],
        Field(description="`end` of the recording, `mean` time of its poses, or `seconds`: as it was asked for"),
    ]
    t_s: Annotated[
        Figure, Field(description="the moment, from the first sample; of the last of several recordings [s]")
    ]
    since_middle_s: Annotated[
        Figure | None, Field(description="the moment from the middle of the poses [s]; absent where that is `t_s`")
    ] = None


class Coefficient(Model):
    value: Annotated[Figure | None, Field(description="value [`unit`]")]
    standard_error: Annotated[
        Figure | None, Field(description="standard error [`unit`]; `null` if the poses tell a combination alone")
    ]
    unit: Annotated[Text, Field(description="unit of both")]


class StandardErrors(Model):
    scale_factor: Annotated[Figures, Field(description="of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="of the three angles [rad]")]
    bias: Annotated[Figures, Field(description="of x, y, z [g]")]


class Unmodelled(Model):
    along_g: Annotated[Figure | None, Field(description="further standard uncertainty of |a| [g]")]
    across_g: Annotated[
        Figure | None, Field(description="further standard uncertainty of each component across it [g]")
    ]


class NextRecording(Model):
    expanded_uncertainty_g: Annotated[
        Figure | None, Field(description="expanded uncertainty of |a| in another recording, at `holds_at` [g]")
    ]
    start_to_start_g: Annotated[Figure | None, Field(description="standard deviation of |a| between recordings [g]")]
    source: Annotated[
        Literal["assumed", "measured"],
        Field(description="source of `start_to_start_g`: `assumed` (2 mg) or `measured`"),
    ]


class ByReadings(Model):
    this_fit: Annotated[Figure | None, Field(description="of the calibration itself [g]")]
    this_sessions_poses: Annotated[Figure | None, Field(description="of one more pose with its noise [g]")]
    another_day: Annotated[Figure | None, Field(description="of another recording [g]")]


class FittedPose(Model):
    start_s: Annotated[
        Figure | None, Field(description="first sample of the still span, from the first of the recording [s]")
    ]
    end_s: Annotated[Figure | None, Field(description="last sample of the still span [s]")]
    mean: Annotated[Figures, Field(description="mean of x, y, z [output]")]
    direction: Annotated[Figures, Field(description="up in the sensor's frame, a unit vector")]
    residual_g: Annotated[Figure | None, Field(description="|a| − reference [g]")]
    standard_error_g: Annotated[
        Figure | None, Field(description="standard error of the mean along the measured vector [g]")
    ]
    studentized: Annotated[Figure | None, Field(description="residual over its own standard deviation")]
    leverage: Annotated[Figure | None, Field(description="influence on the pose's own fitted value, 0…1")]
    used: Annotated[bool, Field(description="whether the fit used it")]
    excluded: Annotated[
        Excluded | None,
        Field(
            description="reason if not: `fault`, `outlier`, `caller`, `unknown_history` (hysteresis in the model, "
            "the pose before unknown); else `null`"
        ),
    ]
    outlier_probability: Annotated[
        Figure | None, Field(description="probability of an outlier, which is excluded from 0.5 on; of a loop")
    ] = None
    left_out: Annotated[
        Text | None, Field(description="`excluded` in the words of 0.1; absent of a pose that the fit used")
    ] = None
    channels: Annotated[
        dict[Text, Figure | None], Field(description="means of the other channels by name [as they are logged]")
    ]
    before_residual_g: Annotated[
        Figure | None,
        Field(description="`residual_g` under the linear model, or under the earlier calibration; of a loop or rezero"),
    ] = None
    recording: Annotated[Text | None, Field(description="its recording, of several")] = None


class Rezeroed(Model):
    before: Annotated[Residual, Field(description="residual of the earlier calibration")]
    shift: Annotated[Figures, Field(description="shift of the biases [g]")]
    expected_shift: Annotated[Figures, Field(description="expected standard deviation of the shift [g]")]
    scatter_g: Annotated[
        Figure | None, Field(description="excess scatter of each pose of the earlier fit, counted here too [g]")
    ]
    scatter_dof: Annotated[Figure | None, Field(description="its degrees of freedom; `null` is infinite")]


class OriginalCalibration(Model):
    name: Annotated[Text | None, Field(description="name of its file; `null` without one")]
    sha256: Annotated[Sha256, Field(description="digest of its file")]


class OriginalRecording(Model):
    name: Annotated[Text | None, Field(description="its name; `null` without one")]


class Origin(Model):
    calibration: Annotated[OriginalCalibration, Field(description="the earlier calibration")]
    recording: Annotated[OriginalRecording, Field(description="the recording of the poses")]
    poses: Annotated[int, Field(description="number of the poses")]


class Temperature(Model):
    mean: Annotated[Figure | None, Field(description="mean, at which the values hold [°C]")]
    lowest: Annotated[Figure | None, Field(description="lowest [°C]")]
    highest: Annotated[Figure | None, Field(description="highest [°C]")]


class EstimatedAttitudes(Model):
    error_rad: Annotated[Figure | None, Field(description="the larger error, that explains the residuals [rad]")]
    error_standard_error_rad: Annotated[Figure | None, Field(description="its standard error [rad]")]
    scale_factor: Annotated[Figures, Field(description="of x, y, z [output/g]")]
    misalignment: Annotated[Figures, Field(description="of the three angles [rad]")]
    bias: Annotated[Figures, Field(description="of x, y, z [g]")]
    standard_error: Annotated[StandardErrors, Field(description="standard errors of these")]
    rotation: Annotated[Matrix, Field(description="(3,3) as `attitudes.rotation`")]
    rotation_standard_error_rad: Annotated[Figures, Field(description="standard errors about x, y, z [rad]")]
    residual: Annotated[Residual, Field(description="residual of that fit")]


class AttitudeRow(Model):
    name: Annotated[Text, Field(description="line and label of the row")]
    up: Annotated[Figures, Field(description="up in the table's frame, as it is stated")]
    off_rad: Annotated[Figure | None, Field(description="angle to the measured vector [rad]")]
    off_standard_errors: Annotated[Figure | None, Field(description="the same, over its standard error")]
    used: Annotated[bool, Field(description="false if the row contradicts the others")]


class Attitudes(Model):
    error_rad: Annotated[Figure | None, Field(description="standard error of the attitudes in either angle [rad]")]
    estimated: Annotated[bool, Field(description="whether it is estimated from the residuals")]
    error_standard_error_rad: Annotated[
        Figure | None, Field(description="standard error of the estimate [rad]; `null` without one")
    ]
    if_estimated: Annotated[
        EstimatedAttitudes | None,
        Field(description="the fit with a larger error that explains the residuals; `null` without one"),
    ]
    rotation: Annotated[Matrix, Field(description="C (3,3): sensor's frame = C · table's")]
    rotation_standard_error_rad: Annotated[Figures, Field(description="standard errors about x, y, z [rad]")]
    standard_error_if_exact: Annotated[StandardErrors, Field(description="standard errors with exact attitudes")]
    rows: Annotated[list[AttitudeRow], Field(description="the poses, in order")]


class SourceByParameter(Model):
    scale_factor: Annotated[list[Source], Field(description="of x, y, z")]
    misalignment: Annotated[list[Source], Field(description="of the three angles")]
    bias: Annotated[list[Source], Field(description="of x, y, z")]
    effects: Annotated[
        dict[Text, dict[Text, Source]],
        Field(default_factory=dict, description="of each effect, by coefficient; absent without effects"),
    ]


class Passport(Model):
    conflict_p: Annotated[
        Figure | None, Field(description="probability of residuals and shifts as large as these by chance")
    ]
    changed: Annotated[
        list[Text],
        Field(description="below 0.01: the values one of which has changed with 0.95, likeliest first; else empty"),
    ]
    changed_alone: Annotated[bool | None, Field(description="whether one change explains all; `null` without any")]
    value: Annotated[ByParameter, Field(description="values before")]
    standard_error: Annotated[ByParameter, Field(description="standard errors before")]
    shift_standard_errors: Annotated[
        ByParameter, Field(description="shifts, each in standard errors of a shift by chance")
    ]
    share_of_poses: Annotated[ByParameter, Field(description="share of the information that is from the poses, 0…1")]
    source: Annotated[
        SourceByParameter, Field(description="`poses` above a share of 0.9, `passport` below 0.1, else `both`")
    ]


class UnitOfCalibration(Model):
    name: Annotated[Text, Field(description="name in the station file; empty where the recording has none")]
    serial: Annotated[Text, Field(description="serial number")]


class Calibration(Model):
    """Scale factors, misalignments, biases and effects of one unit."""

    format: Annotated[Literal["triaxcal.calibration/1"], Field(description="format of this document")]
    terms: Annotated[list[Text], Field(description="`linear`, and the effects")]
    units: Annotated[Units, Field(description="units of the values")]
    reference: Annotated[Figure, Field(description="magnitude of the reference vector [g]")]
    channel_reference: Annotated[
        dict[Text, Figure | None],
        Field(
            description="values from which covariates count: means of channels and of the time `t_s`, rounded; else 0 "
            "[as they are logged]"
        ),
    ]
    holds_at: Annotated[
        HoldsAt | None, Field(description="moment for which effects of time hold elsewhere; `null` without a time")
    ]
    holds: Annotated[list[Text], Field(description="conditions under which the effects add nothing, in words")]
    scale_factor: Annotated[Vector, Field(description="scale factors of x, y, z, with their signs [output/g]")]
    misalignment: Annotated[
        Vector, Field(description="`ax`, `ay`, `az` of [the model](../explanation/the-fit.md#the-sensor) [rad]")
    ]
    bias: Annotated[Vector, Field(description="biases of x, y, z at the input [g]: u = K (R a + b)")]
    use: Annotated[Text, Field(description="how readings become specific force, in words")]
    matrix: Annotated[Matrix, Field(description="A (3,3), upper triangular: a = A (u − c) without effects [g/output]")]
    centre: Annotated[Vector, Field(description="c of the same [output]")]
    effects: Annotated[
        dict[Text, dict[Text, Coefficient | Figure]],
        Field(
            description="by effect and coefficient or shape (`time_constant`, `at`, `knee`): `value`, "
            "`standard_error`, `unit`; and `weight`, the share of the effect in the average of a loop, "
            "1 if it is adopted"
        ),
    ]
    standard_error: Annotated[
        StandardErrors, Field(description="standard errors of the linear values, raised if residuals exceed the noise")
    ]
    parameters: Annotated[list[Text], Field(description="names of all coefficients")]
    correlation: Annotated[list[Figures], Field(description="(p,p) correlation of their errors by noise")]
    unmodelled: Annotated[
        Unmodelled | None, Field(description="standard uncertainties by what is unmodelled; absent if nothing acts")
    ] = None
    uncertainty: Annotated[
        Uncertainty | None,
        Field(
            description="[uncertainty](../explanation/uncertainty.md) and its budget; "
            "absent with another method than still poses"
        ),
    ] = None
    next_recording: Annotated[NextRecording | None, Field(description="another recording; `null` without a budget")]
    expanded_uncertainty_g: Annotated[
        ByReadings | None,
        Field(description="expanded uncertainty of |a|, 95 %, rms over the sphere; absent without a budget"),
    ] = None
    residual: Annotated[Residual, Field(description="errors of the magnitude in the poses")]
    poses: Annotated[list[FittedPose], Field(description="the poses, in the order of time")]
    trends: Annotated[bool, Field(description="whether the changes of |a| inside the poses were fitted with the means")]
    condition: Annotated[Figure | None, Field(description="condition number of the Jacobian, columns scaled")]
    dilution: Annotated[
        Figure | None,
        Field(
            description="worst standard error of a direction of the nine parameters, in those of one pose; "
            "0.7 for 26 poses, 1.1 for 14, refused above 100"
        ),
    ]
    blind_to: Annotated[list[Text], Field(description="effects that these poses cannot show")]
    warnings: Annotated[list[Text], Field(description="reasons to trust it less, one line each")]
    linear_only: Annotated[
        Calibration | None, Field(description="with effects: the linear calibration by itself, same keys")
    ] = None
    rezero: Annotated[Rezeroed | None, Field(description="of [biases anew](#biases-anew)")] = None
    origin: Annotated[Origin | None, Field(description="sources of [biases anew](#biases-anew)")] = None
    temperature_c: Annotated[
        Temperature | None, Field(description="temperature of [a turning unit](#a-turning-unit); `null` without one")
    ] = None
    samples: Annotated[int | None, Field(description="number of samples of [a turning unit](#a-turning-unit)")] = None
    stretches: Annotated[int | None, Field(description="number of stretches of [a turning unit](#a-turning-unit)")] = (
        None
    )
    noise_g: Annotated[
        Figures | None, Field(description="noise of one sample of [a turning unit](#a-turning-unit) in x, y, z [g]")
    ] = None
    noise_unseen_share: Annotated[
        Figure | None, Field(description="share of that noise that differences of samples do not show, 0…1")
    ] = None
    attitudes: Annotated[Attitudes | None, Field(description="of [known attitudes](#known-attitudes)")] = None
    passport: Annotated[
        Passport | None, Field(description="of [refined datasheet values](#refined-datasheet-values)")
    ] = None
    data_quality: Annotated[
        list[Text],
        Field(
            default_factory=list,
            description="[faults of the raw stream](../explanation/data-quality.md), one line each",
        ),
    ]
    unit: Annotated[UnitOfCalibration | None, Field(description="the unit, of a station's recording")] = None
    registers_at_start: Annotated[
        dict[Text, Text] | None,
        Field(
            description="registers by which the device corrected the recorded readings, bytes as hexadecimal; absent "
            "of a device whose profile has no form of correction"
        ),
    ] = None
