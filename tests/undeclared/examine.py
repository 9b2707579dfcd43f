"""A recording, what the loop says of it by the public calls alone, and how that stands to the truth."""

from __future__ import annotations

import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from tests.undeclared.generator import CannotShow, Recording, misses, recording
from tests.undeclared.imitation import best_imitation
from tests.undeclared.told import rms_g, told_errors_g
from tests.undeclared.visible import Linear, told_power
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.estimate.hold_out import magnitude_errors
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.samples import Samples
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.stillness.detector import StillnessDetector

IN_MOTION_S = 0.2


@dataclass(frozen=True)
class Case:
    """Arguments of `generator.recording`, and whether the error in held-out poses is compared too."""

    kind: str
    seed: int
    size: tuple[float, float]
    poses: int
    noise: str
    held_out: bool = False

    def make(self) -> Recording:
        return recording(self.seed, self.kind, self.size, self.poses, self.noise)

    def __str__(self) -> str:
        low, high = self.size
        size = f"{low:g}" if low == high else f"{low:g}:{high:g}"
        return f"--one {self.kind} {self.seed} --poses {self.poses} --size {size} --noise {self.noise}"


@dataclass(frozen=True)
class Outcome:
    """``found`` (name, verdict, alternatives) in order; ``candidates`` and ``probability`` are of names, and
    ``nothing`` is the probability that nothing acts; ``after_ratio`` and ``told_ratio`` are errors in held-out poses,
    of the loop and of a fit that was told the effects, over those of nine parameters on the noise alone.
    """

    case: Case
    text: str
    names: tuple[str, ...] = ()
    sizes: tuple[float, ...] = ()
    beside: tuple[float, ...] = ()
    told_power: float = float("nan")
    imitation: tuple[str, float] = ("", float("nan"))
    """Where a catalogue has no name: the one that leaves least, and s of what it leaves."""
    found: tuple[tuple[str, str, tuple[str, ...]], ...] = ()
    candidates: tuple[str, ...] = ()
    probability: Mapping[str, float] = field(default_factory=dict)
    nothing: float = 1.0
    unexplained: bool = False
    after_ratio: float = float("nan")
    told_ratio: float = float("nan")
    poses_made: int = 0
    poses_found: int = 0
    moving: int = 0
    """Spans that hold more than `IN_MOTION_S` of a move."""
    overstated: float = 1.0
    """Noncentrality under the true standard errors over that under those stated, square root: s shrinks by it."""
    set_aside: int = 0
    error: str = ""

    @property
    def verdict(self) -> str:
        """adopted, confounded (with the truth in it), candidate (the truth is likely), wrong, astray (other names are
        listed or likely), unexplained, nothing."""
        listed = any(v == "confounded" and set(self.names) & {e, *others} for e, v, others in self.found)
        likely = set(self.names) & set(self.candidates)
        if not self.found:
            if self.candidates:
                return "candidate" if likely else "astray"
            return "unexplained" if self.unexplained else "nothing"
        first, verdict, _ = self.found[0]
        if verdict == "adopted" and first in self.names:
            return "adopted"
        if listed:
            return "confounded"
        if likely and verdict != "adopted":
            return "candidate"
        return "wrong" if verdict == "adopted" else "astray"

    @property
    def wrong(self) -> bool:
        """Somewhere a unique name that is none of the truth's."""
        return any(v == "adopted" and e not in self.names for e, v, _ in self.found)

    @property
    def detected(self) -> bool:
        """Whether it is likelier than not that something acts."""
        return self.nothing < 0.5

    @property
    def listed_names(self) -> set[str]:
        return {n for e, _, others in self.found for n in (e, *others)}

    @property
    def stated_names(self) -> set[str]:
        """Those that are named, listed with others, or likely."""
        return self.listed_names | set(self.candidates)

    @property
    def stated(self) -> bool:
        return bool(self.stated_names & set(self.names))

    @property
    def line(self) -> str:
        known = [f"{e} {v}" + (f" (or {', '.join(a)})" if a else "") for e, v, a in self.found]
        likely = [f"{name} likely ({self.probability[name]:.2f})" for name in self.candidates]
        found = "; ".join([*known, *likely]) or "no finding"
        left = ", unexplained" if self.unexplained else ""
        left += f", nothing {self.nothing:.2f}" if self.nothing > 0.01 else ""
        poses = "" if self.poses_found == self.poses_made else f", poses {self.poses_found}/{self.poses_made}"
        poses += f", moving in {self.moving}" if self.moving else ""
        poses += f", errors overstated {self.overstated:.1f}" if self.overstated > 1.3 else ""
        excluded = f", set aside {self.set_aside}" if self.set_aside else ""
        name, rest = self.imitation
        like = f", {name} leaves s = {rest:.1f}" if name else ""
        ratio = f", held out {self.after_ratio:.2f} (told {self.told_ratio:.2f})" if self.case.held_out else ""
        return f"{self.case} | {self.text} | {self.error or found + left + poses + excluded + like + ratio}"


def still_poses(samples: Samples) -> list[Pose]:
    detector = StillnessDetector()
    detector.feed(samples.time_ns, samples.readings, samples.channels)
    detector.finish()
    return poses_of(detector.windows(), detector.spans())


def moving(poses: list[Pose], r: Recording) -> int:
    """How many of the still spans found are not."""
    s = r.take.scene
    begin, end = s.begin / s.rate_hz, s.end / s.rate_hz
    still = [float(np.clip(np.minimum(end, p.end_s) - np.maximum(begin, p.start_s), 0, None).max()) for p in poses]
    return sum(p.end_s - p.start_s - held > IN_MOTION_S for p, held in zip(poses, still, strict=True))


def overstated(loop: Loop, r: Recording) -> float:
    """By what factor the effects' size shrinks if it is reckoned with the stated errors; 1 where spans do not match."""
    here = r.take.scene
    stated = np.array([p.standard_error_g for p in loop.before.poses])
    if len(stated) != here.poses or not r.effects:
        return 1.0
    u, miss = r.triad.outputs(here.pose_force), misses(r.take.added_g, here, r.triad)
    return Linear.of(r.triad, u, r.errors_g).size(miss) / Linear.of(r.triad, u, stated).size(miss)


def examine(case: Case) -> Outcome:
    """Whatever goes wrong in the loop is an outcome too."""
    try:
        r = case.make()
    except CannotShow as e:
        return Outcome(case, str(e), error=f"not drawn: {e}")
    truth = Outcome(case, str(r), r.names, r.sizes, r.beside, _told_power(r), poses_made=r.take.scene.poses)
    try:
        return _compared(truth, r)
    except Exception as e:  # noqa: BLE001 — a benchmark goes on
        return replace(truth, error=f"{type(e).__name__}: {e}")


def _told_power(r: Recording) -> float:
    return told_power(r.sizes[0], r.ranks[0]) if len(r.sizes) == 1 else float("nan")


def _compared(truth: Outcome, r: Recording) -> Outcome:
    poses = still_poses(r.samples())
    check = still_poses(r.held_out_samples()) if truth.case.held_out else None
    loop = diagnose(poses, signs=r.signs, check=check)
    if check is not None:
        nine, told = told_errors_g(r)
        truth = replace(truth, after_ratio=_held_out(loop, check, r) / _alone(r), told_ratio=told / nine)
    return replace(
        truth,
        found=tuple((f.effect, f.verdict.value, tuple(f.alternatives)) for f in loop.findings),
        candidates=tuple(candidate.effect for candidate in loop.candidates),
        probability=dict(loop.probabilities),
        nothing=loop.found.nothing,
        unexplained=loop.found.unexplained.significant,
        poses_found=len(poses),
        moving=moving(poses, r),
        overstated=overstated(loop, r),
        imitation=best_imitation(r) if r.effects and not r.names else truth.imitation,
        set_aside=sum(not p.used for p in loop.after.poses),
    )


def _held_out(loop: Loop, check: list[Pose], r: Recording) -> float:
    if len(check) != r.held_out.scene.poses or not any(e.of_recording for e in r.effects):
        return loop.held_out.after_rms_g if loop.held_out else float("nan")
    c = loop.after
    miss, _ = magnitude_errors(
        c.sensor, check, channel_reference=c.channel_reference, reference=c.reference, moment=c.moment
    )
    return rms_g(r, miss)


def _alone(r: Recording) -> float:
    """Nine parameters on the same noise, nothing else inside."""
    c = fit(still_poses(r.samples(effect=False)), signs=r.signs)
    check = still_poses(r.held_out_samples(effect=False))
    miss, _ = magnitude_errors(c.sensor, check, channel_reference=c.channel_reference, reference=c.reference)
    return rms_g(r, miss) if len(check) == r.held_out.scene.poses else float(np.sqrt(np.mean(miss**2)))


def describe(case: Case) -> str:
    """One recording in full."""
    r = case.make()
    scene = r.take.scene
    lines = [f"{case}", f"truth: {r}", f"{r.noise}", f"{r.triad}"]
    lines.append(
        f"{scene.poses} poses, {scene.rate_hz:g} Hz, {scene.duration_s:.0f} s; true standard errors of |a| "
        f"{1e6 * r.errors_g.min():.1f} to {1e6 * r.errors_g.max():.1f} µg; ranks {r.ranks}; s beside the others "
        f"{[round(b, 1) for b in r.beside]}"
    )
    for name, values in scene.channels.items():
        lines.append(f"{name}: {values.min():.4g} to {values.max():.4g}")
    try:
        poses, check = still_poses(r.samples()), still_poses(r.held_out_samples())
        loop = diagnose(poses, signs=r.signs, check=check)
    except Exception:  # noqa: BLE001 — shown
        return "\n".join([*lines, traceback.format_exc()])
    begin, end = scene.begin / scene.rate_hz, scene.end / scene.rate_hz
    made = ", ".join(f"{b:.2f}-{e:.2f}" for b, e in zip(begin, end, strict=True))
    shown = ", ".join(f"{p.start_s:.2f}-{p.end_s:.2f}" for p in poses)
    if len(poses) != scene.poses:
        lines += [f"poses made {made}", f"poses found {shown}"]
    else:
        stated = np.array([p.standard_error_g for p in loop.before.poses])
        lines.append(f"standard errors stated over true: {np.round(stated / r.errors_g, 2).tolist()}")
    for part in (loop.before, loop.after):
        q = part.residual
        lines.append(
            f"{part.terms}: rms {1e6 * q.rms_g:.1f}, cross-validated {1e6 * (q.cross_validated_rms_g or np.nan):.1f}, "
            f"noise {1e6 * q.noise_floor_g:.1f} µg, p {q.lack_of_fit_p}; set aside "
            f"{[i for i, p in enumerate(part.poses) if not p.used]}"
        )
    for f in loop.findings:
        lines.append(
            f"{f.effect} {f.verdict} {loop.probabilities[f.effect]:.4f} {dict(f.alternatives)} {dict(f.coefficients)}"
        )
    lines += [f"{c.effect} likely {loop.probabilities[c.effect]:.3f} {dict(c.coefficients)}" for c in loop.candidates]
    lines.append(f"probabilities: { {name: round(p, 3) for name, p in loop.probabilities.items() if p >= 0.01} }")
    lines.append(f"outliers: {dict(loop.found.outliers)}; nothing: {loop.found.nothing:.3f}; refused: {loop.refusal}")
    lines.append(f"unexplained: {loop.found.unexplained}")
    lines.append(f"held out: {loop.held_out}; told over noise alone {np.divide(*told_errors_g(r)[::-1]):.2f}")
    return "\n".join(lines)
