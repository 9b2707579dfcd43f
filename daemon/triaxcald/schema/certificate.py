"""The certificate of a unit (`triaxcal.certificate/1`)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

import triaxcal as tc

Sign = Literal[-1, 1]


class UnitOfCertificate(tc.schema.Model):
    name: Annotated[str, Field(description="name in the station file")]
    vendor: Annotated[str, Field(description="vendor, by the profile")]
    product: Annotated[str, Field(description="product, by the profile")]
    serial: Annotated[str | None, Field(description="serial number; `null` without one")]


class NamedFile(tc.schema.Model):
    name: Annotated[str, Field(description="its name")]
    sha256: Annotated[
        tc.schema.Sha256, Field(description="digest of its bytes; of a profile, with the files that it names")
    ]


class RecordingOfCertificate(tc.schema.Model):
    raw_sha256: Annotated[
        tc.schema.Sha256,
        Field(description="[digest](recording.md#metadata-and-attachments) of the raw records of the calibration"),
    ]
    started: Annotated[str, Field(description="host's time of the first record, UTC, ISO 8601")]
    seconds: Annotated[tc.schema.Figure, Field(description="duration [s]")]
    poses: Annotated[int, Field(description="number of still poses")]
    samples: Annotated[int, Field(description="number of samples that came")]
    missing: Annotated[int, Field(description="number of samples that did not come")]
    duplicates: Annotated[int, Field(description="number of samples that came again")]
    incomplete: Annotated[int, Field(description="number of samples of which a part did not come")]
    errors: Annotated[int, Field(description="number of errors of the bus")]
    out_of_order: Annotated[int, Field(description="number of samples that were earlier than one before")]
    receiver_overflows: Annotated[int, Field(description="number of records that came after a loss in the receiver")]
    malformed: Annotated[int, Field(description="number of records that are not as the profile has them, if any")] = 0
    invalid: Annotated[int, Field(description="number of samples that the unit called invalid, if any")] = 0
    not_finite: Annotated[int, Field(description="number of samples whose outputs are no finite numbers, if any")] = 0


class Settings(tc.schema.Model):
    signs: Annotated[list[Sign], Field(description="signs of the scale factors of x, y, z")]
    reference: Annotated[tc.schema.Figure, Field(description="magnitude of the reference vector [g]")]


class LimitsOfFit(tc.schema.Model):
    rms_g: Annotated[
        tc.schema.Figure | None, Field(description="limit of the residual, rms [g]; absent without one")
    ] = None
    cross_validated_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="limit of the cross-validated rms [g]; absent without one")
    ] = None


class RegisterWord(tc.schema.Model):
    register_: str = Field(alias="register", description="name of the register in the profile")
    role: Annotated[str, Field(description="what it is to a calibration: `scale_factor.x`, `bias.y`, …")]
    raw: Annotated[str, Field(description="its bytes, hexadecimal")]
    wanted: Annotated[tc.schema.Figure | None, Field(description="value as computed [`unit`]")]
    held: Annotated[tc.schema.Figure | None, Field(description="value as the register holds it [`unit`]")]
    unit: Annotated[str, Field(description="unit of the values")]


class OwnError(tc.schema.Model):
    before: Annotated[tc.schema.Figure | None, Field(description="under the registers that the device had [g]")]
    predicted: Annotated[
        tc.schema.Figure | None, Field(description="under the new ones, with the uncertainty of the calibration [g]")
    ]


class CorrectionOfCertificate(tc.schema.Model):
    """What the registers of a device's own linear correction leave, and gain."""

    fixed: Annotated[
        list[str],
        Field(
            default_factory=list,
            description="coefficients of the device's correction without a register; absent without "
            "`[correction] form`, and so are `left_rms_g`, `left_largest_g`, `own_rms_g` and `better`",
        ),
    ]
    left_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="rms error of |a| that their lack leaves, over the sphere [g]")
    ] = None
    left_largest_g: Annotated[tc.schema.Figure | None, Field(description="largest error that it leaves [g]")] = None
    own_rms_g: Annotated[OwnError | None, Field(description="rms error of the device's own output over the sphere")] = (
        None
    )
    better: Annotated[
        bool | None,
        Field(
            description="whether the prediction beats the device by more than it may be wrong; else nothing is written"
        ),
    ] = None


class RegistersOfCertificate(CorrectionOfCertificate):
    terms: Annotated[list[str], Field(description="`linear`, and the effects that the registers correct")]
    left_to_host: Annotated[list[str], Field(description="effects that the device has no registers for")]
    holds: Annotated[
        list[str], Field(description="conditions under which the linear part is all of a reading, in words")
    ]
    rms_g: Annotated[tc.schema.Figure | None, Field(description="rms residual under the registers, in the poses [g]")]
    cost_rms_g: Annotated[
        tc.schema.Figure | None,
        Field(description="rms difference of |a| from the whole correction, over the sphere [g]"),
    ]
    rounding_rms_g: Annotated[
        tc.schema.Figure | None, Field(description="rms change of |a| in the poses by rounding to the registers [g]")
    ]
    uncertainty: Annotated[
        tc.schema.Uncertainty,
        Field(description="[uncertainty](../explanation/uncertainty.md) of the calibration in the registers"),
    ]
    words: Annotated[list[RegisterWord], Field(description="the registers, in the order of the profile")]


class Certificate(tc.schema.Model):
    """Everything that follows from a recording, its profile and its station
    file, and nothing else."""

    format: Annotated[Literal["triaxcal.certificate/1"], Field(description="format of this document")]
    unit: Annotated[UnitOfCertificate, Field(description="the unit")]
    station: Annotated[NamedFile, Field(description="the station, and its file")]
    profile: Annotated[NamedFile, Field(description="the profile, and its files")]
    recording: Annotated[RecordingOfCertificate, Field(description="the recording: what came and what was lost")]
    software: Annotated[
        dict[str, str],
        Field(description="versions of `triaxcal`, `numpy`, `scipy`, `python`; `processor`, `blas`, `blas_kernel`"),
    ]
    settings: Annotated[Settings, Field(description="settings of the calibration")]
    limits: Annotated[LimitsOfFit, Field(description="limits of the station")]
    verdict: Annotated[
        Literal["within limits", "outside limits", "not judged"],
        Field(description="on the fit: `within limits`, `outside limits`, `not judged` (no limit)"),
    ]
    outside: Annotated[list[str], Field(description="figures that are outside their limits, in words")]
    result: Annotated[
        tc.schema.Loop | tc.schema.Rezero,
        Field(
            discriminator="format",
            description="the [`triaxcal.loop/1`](loop.md), "
            "or after `--rezero` the [`triaxcal.rezero/1`](loop.md#rezero)",
        ),
    ]
    not_written: Annotated[
        str | None, Field(description="linear parameters without a register, in words; `null` if all have one")
    ]
    registers: Annotated[
        RegistersOfCertificate | None,
        Field(description="content of the registers; `null` if the device cannot take a calibration"),
    ]
