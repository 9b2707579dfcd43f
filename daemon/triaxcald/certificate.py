"""The certificate: everything that follows from a recording, its profile and
its station file, and nothing else.

A station writes it once; an audit computes it again from the recording alone
and must get the same bytes. So no clock, no path and no random number enters
here.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.caveats import is_passing
from triaxcald.computer import compute_with_one_thread
from triaxcald.documents import loop_document, rezero_document
from triaxcald.provision.correction import (
    free_coefficients,
    has_form,
    register_values,
    removed_from,
    start_of_fit,
    with_values,
)
from triaxcald.provision.registers import RegisterImage, build_image
from triaxcald.raw_to_poses import Pipeline, of_poses
from triaxcald.recording.schema import RawDigest
from triaxcald.software import drawn_with as drawn_with
from triaxcald.software import software as software
from triaxcald.station.config import Limits, StationFile

if TYPE_CHECKING:  # the models are loaded when a document is made
    from triaxcald.learned_odds import OddsFile
    from triaxcald.schema.certificate import CorrectionOfCertificate, RegistersOfCertificate

DAY_S = 86_400
TEMPERATURE = "temp_c"


@dataclass(frozen=True)
class Certified:
    """A certificate, what it stands on, and the registers that it asks for
    (None where the device has none). It stands on a ``loop``, or on an earlier
    calibration ``updated`` by a few poses."""

    document: tc.interchange.Document
    loop: tc.diagnosis.Loop | None
    image: RegisterImage | None
    within_limits: bool
    updated: tc.estimate.Calibration | None = None
    better: bool = True
    """Whether the registers beat what the device holds, by more than that prediction
    can be wrong."""
    at_start: Mapping[str, bytes] | None = None

    @property
    def calibration(self) -> tc.estimate.Calibration:
        found = self.loop.after if self.loop is not None else self.updated
        assert found is not None
        return found

    @property
    def before(self) -> tc.estimate.Residual:
        """Of the linear model, or of the earlier calibration in these poses."""
        if self.loop is not None:
            return self.loop.before.residual
        assert self.calibration.update is not None
        return self.calibration.update.before


def certify(
    bundle: td.Bundle,
    station: StationFile,
    station_text: bytes,
    pipeline: Pipeline,
    poses: list[tc.Pose],
    digest: RawDigest,
    *,
    unit_name: str,
    serial: str | None,
    signs: tuple[int, int, int],
    computed_with: Mapping[str, str],
    earlier: tc.inputs.Earlier | None = None,
    at_start: Mapping[str, bytes] | None = None,
    odds: OddsFile | None = None,
) -> Certified:
    """``computed_with``: `software` of the station, so that an audit years
    later can get the same bytes. ``earlier``: the calibration of which the
    poses renew the biases alone. ``at_start``: the registers by which the device
    corrected while the poses were taken, where its profile has a form of
    correction. ``odds`` are learned ones.

    Raises Refused where the poses cannot carry the answer, RegisterValueError
    where the registers cannot."""
    from triaxcald.schema.certificate import (
        Certificate,
        LimitsOfFit,
        NamedFile,
        RecordingOfCertificate,
        Settings,
        UnitOfCertificate,
    )

    compute_with_one_thread()
    profile = bundle.profile
    poses = removed_from(profile, poses, at_start)
    loop = updated = None
    if earlier is None:
        loop = tc.diagnosis.diagnose(
            poses, signs=signs, reference=station.reference, at=station.moment,
            odds=None if odds is None else odds.prior,
        )  # fmt: skip
        after = loop.after
    else:
        after = updated = tc.inputs.updated_biases(poses, earlier)
    stated = station.stated(profile)
    measured_ns = pipeline.first_host_ns or 0
    held = held_by_device(profile, after, at_start=at_start)
    image = image_of(profile, held, measured_ns // (DAY_S * 1_000_000_000)) if held else None
    output_unit = profile.output.unit
    quality = pipeline.data_quality() + of_poses(poses, output_unit)
    if loop is None:
        result = rezero_document(after, data_quality=quality, output_unit=output_unit, stated=stated)
    else:
        beside = held.beside_process if held else None
        result = loop_document(
            loop, data_quality=quality, output_unit=output_unit, stated=stated, held_by_device=beside,
            odds=None if odds is None else odds.document,
        )  # fmt: skip
    outside = over_limits(result["after"], station.limits)
    identity, rounded = profile.identity, tc.rounding.number
    document = Certificate(
        format="triaxcal.certificate/1",
        unit=UnitOfCertificate(name=unit_name, vendor=identity.vendor, product=identity.product, serial=serial),
        station=NamedFile(name=station.name, sha256=hashlib.sha256(station_text).hexdigest()),
        profile=NamedFile(name=profile.name, sha256=bundle.digest()),
        recording=RecordingOfCertificate.model_validate(
            {
                "raw_sha256": digest.hexdigest(),
                "started": datetime.fromtimestamp(measured_ns // 1_000_000_000, UTC).isoformat(),
                "seconds": rounded(pipeline.seconds),
                "poses": len(poses),
                **pipeline.counts,
            }
        ),
        software=dict(computed_with),
        settings=Settings.model_validate({"signs": list(signs), "reference": rounded(station.reference)}),
        limits=LimitsOfFit.model_validate(
            {name: rounded(limit) for name in LIMITED if (limit := getattr(station.limits, name))}
        ),
        verdict=verdict_of(outside, station.limits),
        outside=outside,
        result=(tc.schema.Rezero if loop is None else tc.schema.Loop).model_validate(result),
        not_written=why_not_written(profile),
        registers=_registers_part(image, held, after, poses, stated) if image and held else None,
    ).document()
    return Certified(document, loop, image, not outside, updated, _is_better(image, held), at_start)


def roles(sensor: tc.Sensor, channel_reference: Mapping[str, float]) -> dict[str, float]:
    """A sensor's coefficients by register role."""
    out = {
        f"{name}.{axis}": float(values[i])
        for name, values in zip(td.roles.LINEAR, (sensor.scale_factor, sensor.misalignment, sensor.bias), strict=True)
        for i, axis in enumerate(td.roles.AXES)
    }
    for effect, values in sensor.effects:
        out |= {f"{effect.name}.{c.name}": float(v) for c, v in zip(effect.coefficients, values, strict=True)}
    if TEMPERATURE in channel_reference:
        out[td.roles.REFERENCE_ROLE] = channel_reference[TEMPERATURE]
    return out


def why_not_written(profile: td.Profile) -> str | None:
    """Why a device cannot take a calibration at all: without one of the nine,
    the other eight would be wrong. One with a correction of another form takes what
    it can."""
    if has_form(profile):
        return (
            None if free_coefficients(profile) else "the device has no register of its correction that can be written"
        )
    missing = [role for role in td.roles.LINEAR_ROLES if profile.by_role(role) is None]
    return f"the device has no register for {', '.join(missing)}" if missing else None


@dataclass(frozen=True)
class HeldByDevice:
    """What a device can hold of a calibration: ``registers`` are the whole
    correction, as nearly as its registers have it, at the moment for which that
    holds. ``beside_process`` is the same beside what belongs to the recording
    and not to the unit, in the recording's own poses. ``correction`` are the
    coefficients of a device with a form of correction, of which ``registers`` are the
    equivalent."""

    registers: tc.estimate.Reduced
    beside_process: tc.estimate.Calibration
    correction: tc.estimate.DeviceCorrection | None = None


def held_by_device(
    profile: td.Profile,
    full: tc.estimate.Calibration,
    logged: Mapping[str, tc.Floats] | None = None,
    at_start: Mapping[str, bytes] | None = None,
) -> HeldByDevice | None:
    """None where the device cannot take a calibration at all. ``logged`` as
    `triaxcal.estimate.reduced` has it, ``at_start`` as `certify`."""
    if why_not_written(profile):
        return None
    if has_form(profile):
        free = free_coefficients(profile)
        found = tc.estimate.device_correction(full, start_of_fit(profile, at_start), free, logged)
        return HeldByDevice(found.equivalent, found.equivalent.calibration, found)

    def has(effect: tc.effects.Effect) -> bool:
        return all(profile.by_role(f"{effect.name}.{c.name}") for c in effect.coefficients)

    beside = tc.estimate.reduced(full, lambda effect: has(effect) or is_passing(effect), logged).calibration
    return HeldByDevice(tc.estimate.reduced(full, has, logged), beside)


def image_of(profile: td.Profile, held: HeldByDevice, date_days: int) -> RegisterImage:
    """Of the coefficients as they are printed, so that the words follow from
    the document. Raises RegisterValueError where a value does not go into its
    register."""
    if held.correction is not None:
        values = register_values(profile, held.correction.correction)
    else:
        registers = held.registers.calibration
        values = roles(registers.sensor, registers.channel_reference)
    wanted = {role: tc.rounding.number(v) for role, v in values.items()}
    return build_image(
        profile, {r: v for r, v in wanted.items() if v is not None and profile.by_role(r)}, date_days=date_days
    )


def with_registers(
    certified: Certified, bundle: td.Bundle, station: StationFile, wanted: Mapping[str, float]
) -> Certified:
    """With the registers for other coefficients, ``wanted`` by role, than were
    computed: those of a stored certificate that says the same."""
    profile, full, image = bundle.profile, certified.calibration, certified.image
    held = held_by_device(profile, full, at_start=certified.at_start)
    if image is None or held is None:
        return certified
    days = next((w.value for w in image.words if w.role == td.roles.DATE_ROLE), 0)
    coefficients = {w.role: w.value for w in image.words if w.role not in (td.roles.DATE_ROLE, td.roles.CRC_ROLE)}
    image = build_image(profile, coefficients | dict(wanted), date_days=int(days))
    poses = [p.pose for p in full.poses]
    registers = _registers_part(image, held, full, poses, station.stated(profile)).document()
    document = {**certified.document, "registers": registers}
    return replace(certified, image=image, document=document, better=_is_better(image, held))


def _registers_part(
    image: RegisterImage, held: HeldByDevice, full: tc.estimate.Calibration, poses: list[tc.Pose], stated: tc.Stated
) -> RegistersOfCertificate:
    from triaxcald.schema.certificate import RegistersOfCertificate, RegisterWord

    registers = held.registers.calibration
    in_registers = list(registers.terms)
    if held.correction is None:
        rounding_rms = rounding_cost(image, registers, poses)
        stated = replace(stated, rounding=_steps(image), not_held=held.registers.cost)
        of_form = {}
    else:
        rounding_rms = rounding_of(image, held.correction)
        stated = replace(stated, not_held=float(np.hypot(held.registers.cost, rounding_rms)))
        of_form = vars(of_correction(image, held.correction))
    budget = tc.uncertainty.budget(registers, stated)
    return RegistersOfCertificate(
        **of_form,
        terms=in_registers,
        left_to_host=[name for name in full.terms if name not in in_registers],
        holds=registers_hold(registers, full),
        rms_g=tc.rounding.error(held.beside_process.residual.rms_g),
        cost_rms_g=tc.rounding.error(held.registers.cost),
        rounding_rms_g=tc.rounding.error(rounding_rms),
        uncertainty=tc.schema.Uncertainty.model_validate(tc.interchange.budget_document(registers, budget)),
        words=[
            RegisterWord(
                register=w.register,
                role=w.role,
                raw=w.raw.hex(),
                wanted=tc.rounding.number(w.value),
                held=tc.rounding.number(w.held),
                unit=w.unit,
            )
            for w in image.words
        ],
    )


def of_correction(image: RegisterImage, found: tc.estimate.DeviceCorrection) -> CorrectionOfCertificate:
    """What a device with a form of correction leaves, and gains."""
    from triaxcald.schema.certificate import CorrectionOfCertificate, OwnError

    rounded = _rounded(image, found)
    return CorrectionOfCertificate(
        fixed=[role for role in td.roles.CORRECTION_ROLES[:12] if role not in found.free],
        left_rms_g=tc.rounding.error(found.left_rms),
        left_largest_g=tc.rounding.error(found.left_largest),
        own_rms_g=OwnError(
            before=tc.rounding.error(found.own_rms), predicted=tc.rounding.error(found.predicted_rms(rounded))
        ),
        better=found.better(rounded),
    )


def rounding_of(image: RegisterImage, found: tc.estimate.DeviceCorrection) -> float:
    """rms change of |a| [g] by rounding to the registers of the correction."""
    return found.rounding_rms(_rounded(image, found))


def _rounded(image: RegisterImage, found: tc.estimate.DeviceCorrection) -> tc.estimate.LinearCorrection:
    return with_values(found.correction, {word.role: word.held for word in image.words})


def _is_better(image: RegisterImage | None, held: HeldByDevice | None) -> bool:
    if image is None or held is None or held.correction is None:
        return True
    return held.correction.better(_rounded(image, held.correction))


def registers_hold(registers: tc.estimate.Calibration, full: tc.estimate.Calibration) -> list[str]:
    """Under which conditions the linear part of the registers is all of a
    reading, where ``full`` has effects of time: at their moment."""
    timed = any(tc.effects.of_clocks(effect) for effect, _ in full.sensor.effects)
    moment = [tc.text.as_at(full.holds_at)] if timed and full.holds_at is not None else []
    return [*moment, *tc.interchange.holds_of(registers)]


def _steps(image: RegisterImage) -> dict[str, float]:
    return {word.role: word.step for word in image.words}


def rounding_cost(image: RegisterImage, held: tc.estimate.Calibration, poses: list[tc.Pose]) -> float:
    """rms change of |a| in the poses, in g, that rounding the coefficients to
    their registers makes."""
    rounded = {w.role: w.held for w in image.words}
    sensor = held.sensor

    def triple(name: str, values: Any) -> Any:
        return np.array([rounded.get(f"{name}.{axis}", float(values[i])) for i, axis in enumerate("xyz")])

    def of_effect(effect: tc.effects.Effect, values: Any) -> Any:
        pairs = zip(effect.coefficients, values, strict=True)
        return np.array([rounded.get(f"{effect.name}.{c.name}", float(v)) for c, v in pairs])

    worse = tc.Sensor(
        triple(td.roles.SCALE_FACTOR, sensor.scale_factor),
        triple(td.roles.MISALIGNMENT, sensor.misalignment),
        triple("bias", sensor.bias),
        tuple((effect, of_effect(effect, values)) for effect, values in sensor.effects),
    )
    u = np.array([p.mean for p in poses])
    channels = tc.poses.with_scale(
        tc.poses.channels_of(poses, held.channel_reference), poses, sensor.scale_factor, sensor.bias
    )
    reference = dict(held.channel_reference)
    covariates = {n: channels[n] - v for n, v in reference.items()}
    if TEMPERATURE in reference and td.roles.REFERENCE_ROLE in rounded:
        reference[TEMPERATURE] = rounded[td.roles.REFERENCE_ROLE]
    shifted = {n: channels[n] - v for n, v in reference.items()}
    exact = np.linalg.norm(sensor.specific_force(u, covariates), axis=1)
    return float(np.sqrt(np.mean((np.linalg.norm(worse.specific_force(u, shifted), axis=1) - exact) ** 2)))


def verdict_of(outside: Sequence[str], limits: Limits) -> Literal["within limits", "outside limits", "not judged"]:
    judged = limits.rms_g is not None or limits.cross_validated_rms_g is not None
    return "outside limits" if outside else "within limits" if judged else "not judged"


LIMITED = ("rms_g", "cross_validated_rms_g")
"""Figures of the fit that a station can limit, by their keys."""


def exceeded(measured: Mapping[str, float | None], limits: Limits) -> list[str]:
    """The keys of figures that are above their limit, or that are not known."""
    found = []
    for name in LIMITED:
        value, limit = measured.get(name), getattr(limits, name)
        if limit is not None and not (value is not None and value <= limit):
            found.append(name)
    return found


def over_limits(measured: Mapping[str, float | None], limits: Limits) -> list[str]:
    """A line for each figure that is above its limit, or that is not known."""
    return [
        f"{name} {tc.number_format.micro_g(measured.get(name))} is above the limit "
        f"{tc.number_format.micro_g(getattr(limits, name))}"
        for name in exceeded(measured, limits)
    ]
