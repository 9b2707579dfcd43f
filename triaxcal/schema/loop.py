"""The diagnosis of a unit (`triaxcal.loop/1`), and what stands in its place where
only the biases are renewed (`triaxcal.rezero/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from triaxcal.schema.calibration import Calibration, Coefficient, UnitOfCalibration
from triaxcal.schema.model import Figure, Figures, Model, Residual, Sha256, Text

Nothing = Annotated[None, Field(description="of 0.1: `null`")]
"""A key that has no meaning since names have probabilities."""
Probabilities = dict[Text, Figure | None]
"""By name; `null` is not calibrated."""


class HeldOut(Model):
    before_rms_g: Annotated[Figure | None, Field(description="rms error of the linear calibration [g]")]
    after_rms_g: Annotated[Figure | None, Field(description="rms error of the final calibration [g]")]
    noise_floor_g: Annotated[Figure | None, Field(description="rms that noise alone makes [g]")]
    poses: Annotated[int, Field(description="number of the poses")]
    contradicts: Annotated[
        Literal["uncertainty", "correction"] | None,
        Field(
            description="`uncertainty` if the error is above the expanded uncertainty on another day, `correction` if "
            "the linear calibration is clearly better; else `null`"
        ),
    ]


class Finding(Model):
    effect: Annotated[Text, Field(description="a certain effect, or the likeliest of several of which one acts")]
    verdict: Annotated[Literal["adopted", "confounded"], Field(description="`adopted`, or `confounded` with others")]
    probability: Annotated[Figure | None, Field(description="that it acts; `null` if it is not calibrated")]
    coefficients: Annotated[
        dict[Text, Coefficient], Field(description="the corrected ones by name; without a correction those if it acts")
    ]
    alternatives: Annotated[list[Text], Field(description="the others of its group")]
    probabilities: Annotated[Probabilities, Field(description="that each of these acts, by name")]
    reason: Annotated[Text, Field(description="why it is named, in words")]
    remedy: Annotated[Text, Field(description="what to do about it, in words")]
    p_value: Nothing
    spoiled: Nothing
    coincidence: Nothing
    held_out_rms_g: Nothing
    apart: Nothing
    residual: Nothing
    pose_residual_g: Nothing


class OddsUsed(Model):
    sha256: Annotated[Sha256, Field(description="SHA-256 of the file")]
    part_number: Annotated[Text | None, Field(description="part number of the units; `null` is any")]
    units: Annotated[int, Field(description="number of units that they were learned from")]
    effects: Annotated[dict[Text, Figure | None], Field(description="odds of effects by name, before any pose")]
    unmodelled_probability: Annotated[
        Figure, Field(description="probability of something that no effect describes, before any pose")
    ]


class Candidate(Model):
    effect: Annotated[Text, Field(description="an effect that is likelier than not, and not certain")]
    probability: Annotated[Figure | None, Field(description="that it acts; `null` if it is not calibrated")]
    hangs_on_one_pose: Annotated[
        bool, Field(description="whether it is not certain since one pose may be an outlier")
    ] = False
    coefficients: Annotated[dict[Text, Coefficient], Field(description="by name, if it acts")]


class AnotherUnit(Model):
    start_s: Annotated[Figure | None, Field(description="start of the first pose of it [s]")]
    recording: Annotated[int | None, Field(description="its recording among several, from 0; absent of one")] = None
    probability: Annotated[Figure, Field(description="that it is another")]


class CorrectedBy(Model):
    corrected_by: Annotated[
        list[Literal["registers", "host", "process"]],
        Field(description="who corrects: `registers`, `host`, `process` (the next recording lacks the effects)"),
    ]
    terms: Annotated[list[Text], Field(description="`linear`, and the effects that they correct")]


class Choice(Residual, CorrectedBy):
    """A way to correct the unit, and the residual that it leaves. The keys of the
    last base come first."""


class Unexplained(Model):
    significant: Annotated[bool, Field(description="whether something unmodelled is likelier than not")]
    probability: Annotated[Figure, Field(description="that something unmodelled acts")]
    kind: Annotated[
        Literal["each_pose", "direction", "odd_by_axis", "even_by_axis", "pose_before", "time", "local", "inside_poses"]
        | None,
        Field(
            description="its likeliest kind: `each_pose`, `direction`, `odd_by_axis`, `even_by_axis`, `pose_before`, "
            "`time`, `local`, `inside_poses`; `null` without one"
        ),
    ]
    rms_g: Annotated[Figure | None, Field(description="its size over the poses if it acts, rms of |a| [g]")]
    lead: Annotated[Text, Field(description="where to look for it, in words; empty if it is not significant")]
    p_value: Nothing
    or_spoiled: Nothing
    or_named: Nothing
    only_inside: Nothing


class Curve(Model):
    x: Annotated[Figures, Field(description="values of the variable")]
    y: Annotated[Figures, Field(description="contribution there")]
    half_width: Annotated[Figures, Field(description="half the width of its 95 % band")]


class Trace(Model):
    effect: Annotated[Text | None, Field(description="the effect; `null` for a residual without one")]
    axis: Annotated[Text | None, Field(description="the axis on which it acts; `null` for several")]
    coefficients: Annotated[list[Text], Field(description="its coefficients")]
    variable: Annotated[Text, Field(description="driving covariate, `reading_x` …, `predicted`, or `pose`")]
    variable_unit: Annotated[Text, Field(description="unit of the variable")]
    quantity: Annotated[
        Literal["magnitude", "reading", "standard_errors"],
        Field(description="quantity of `y`: `magnitude` [g], `reading` [g], `standard_errors`"),
    ]
    share: Annotated[
        Figure | None,
        Field(
            description="of an unexplained residual: share of its sum of squares that a smooth curve removes; "
            "else `null`"
        ),
    ]
    p_value: Annotated[
        Figure | None,
        Field(description="probability of such a share by chance (F test, Bonferroni); else `null`"),
    ]
    pose: Annotated[list[int], Field(description="by pose: its place in `calibration.poses`, from 0")]
    x: Annotated[Figures, Field(description="by pose: the variable [`variable_unit`]")]
    y: Annotated[Figures, Field(description="by pose: partial residual")]
    error: Annotated[Figures, Field(description="by pose: standard error of `y`")]
    excluded: Annotated[list[bool], Field(description="by pose: whether the fit excludes it")]
    curve: Annotated[Curve, Field(description="the effect; empty without one")]


class RecordingOfLoop(Model):
    recording: Annotated[Text, Field(description="its name")]
    poses: Annotated[int, Field(description="number of its poses")]
    before_rms_g: Annotated[Figure | None, Field(description="rms error of the linear model in them [g]")]
    after_rms_g: Annotated[Figure | None, Field(description="rms error of the final calibration in them [g]")]
    noise_floor_g: Annotated[Figure | None, Field(description="rms that noise alone makes in them [g]")]


class Loop(Model):
    """The effects that act in a recording, and the calibration that corrects
    them."""

    format: Annotated[Literal["triaxcal.loop/1"], Field(description="format of this document")]
    call: Annotated[
        Literal["usable", "record_more", "investigate"],
        Field(description="`usable`, `record_more`, `investigate` ([when](cli.md#triaxcal-diagnose))"),
    ]
    summary: Annotated[list[Text], Field(description="the four lines of the console")]
    before: Annotated[Residual, Field(description="errors of the magnitude under the linear model")]
    after: Annotated[Residual, Field(description="errors of the magnitude under the final calibration")]
    held_out: Annotated[HeldOut | None, Field(description="the poses of `--check`; absent without it")] = None
    findings: Annotated[list[Finding], Field(description="effects that act, the likeliest first")]
    candidates: Annotated[list[Candidate], Field(description="effects that are likelier than not, and not certain")]
    probabilities: Annotated[
        Probabilities, Field(description="of every likely effect, by name; `null`: not calibrated")
    ]
    nothing_probability: Annotated[Figure, Field(description="that nothing acts")]
    odds: Annotated[
        OddsUsed | None, Field(description="the learned odds of `--odds`; absent with those of the catalogue")
    ] = None
    another_unit: Annotated[
        AnotherUnit | None,
        Field(description="another unit or mounting from some pose on; `null` where that is unlikely"),
    ]
    not_corrected: Annotated[
        Literal["unmodelled", "another", "one_pose", "gain"] | None,
        Field(
            description="reason that no effect is corrected: `unmodelled`, `another` (unit or mounting), `one_pose`, "
            "`gain` (too little); else `null`"
        ),
    ]
    choices: Annotated[list[Choice], Field(description="ways to correct the unit, each with its residual")]
    unexplained: Annotated[Unexplained, Field(description="what no effect of the model explains")]
    doubts: Annotated[
        list[Literal["unit"]],
        Field(default_factory=list, description="`unit` if recordings may be of different units; absent without doubt"),
    ]
    data_quality: Annotated[
        list[Text],
        Field(description="faults of the raw stream, one line each; of several recordings behind the name of each"),
    ]
    advice: Annotated[list[Text], Field(description="actions, in words")]
    notes: Annotated[list[Text], Field(default_factory=list, description="further remarks")]
    traces: Annotated[
        list[Trace],
        Field(
            default_factory=list,
            description="[the trace](../explanation/diagnosis.md#the-trace): partial residuals of findings and "
            "candidates, else of corrected effects, of what is unmodelled, or the residuals",
        ),
    ]
    calibration: Annotated[Calibration, Field(description="the final [`triaxcal.calibration/1`](calibration.md)")]
    recordings: Annotated[
        list[Text],
        Field(default_factory=list, description="names of several recordings, the first is run 1; absent of one"),
    ]
    by_recording: Annotated[
        list[RecordingOfLoop], Field(default_factory=list, description="errors in each of several; absent of one")
    ]
    unit: Annotated[UnitOfCalibration | None, Field(description="the unit, of a station's recording")] = None
    registers_at_start: Annotated[
        dict[Text, Text] | None,
        Field(
            description="registers by which the device corrected the recorded readings, bytes as hexadecimal; absent "
            "of a device whose profile has no form of correction"
        ),
    ] = None


class Rezero(Model):
    """A calibration with biases anew: nobody has searched for effects."""

    format: Annotated[Literal["triaxcal.rezero/1"], Field(description="format of this document")]
    summary: Annotated[list[Text], Field(description="lines of the console")]
    before: Annotated[Residual, Field(description="errors of the magnitude under the earlier calibration")]
    after: Annotated[Residual, Field(description="errors of the magnitude under the new one")]
    findings: Annotated[list[Finding], Field(description="empty", max_length=0)]
    candidates: Annotated[list[Candidate], Field(description="empty", max_length=0)]
    choices: Annotated[list[Choice], Field(description="empty", max_length=0)]
    data_quality: Annotated[list[Text], Field(description="faults of the raw stream, one line each")]
    advice: Annotated[list[Text], Field(description="empty", max_length=0)]
    calibration: Annotated[Calibration, Field(description="the new [`triaxcal.calibration/1`](calibration.md)")]
