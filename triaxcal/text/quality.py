"""What a raw stream is to be blamed for."""

from __future__ import annotations

from functools import singledispatch

from triaxcal.number_format import number_of
from triaxcal.poses.quality import finding as of

POSES_NAMED = 8
"""So many poses are named by when they begin; the others are counted."""


def quality_line(finding: of.QualityFinding, unit: str = "") -> str:
    """As it stands under ``data_quality``; ``unit`` is that of the outputs."""
    return f"{finding.name}: {quality(finding, unit)}"


@singledispatch
def quality(finding: of.QualityFinding, unit: str = "") -> str:
    """Which axis, how much and where. Raises TypeError for a kind that has no
    words."""
    raise TypeError(f"no words for {type(finding).__name__}")


@quality.register
def _(found: of.Saturation, unit: str = "") -> str:
    return "; ".join(
        f"{r.axis} at {r.rail:.7g} in {number_of(r.samples, 'sample')}, first at {r.first_s:.1f} s"
        + _in_poses(r.touched)
        for r in found.rails
    )


@quality.register
def _(found: of.StuckOutput, unit: str = "") -> str:
    parts = [f"{axis} never changes" for axis in found.dead]
    if found.slow:
        rate = found.slow.rate_hz
        parts.append(
            f"new values only every {found.slow.every:.2f} samples, at {rate / found.slow.every:.4g} Hz of {rate:.4g} "
            "Hz"
        )
    return "; ".join([*parts, *map(_freeze, found.freezes)])


def _freeze(f: of.Freeze) -> str:
    if f.times > 1:
        which = f"{f.axis} freezes" if f.axis else "all axes freeze"
        what = f"{which} {f.times} times, {number_of(f.longest, 'sample')} at the longest"
    else:
        which = f"{f.axis} repeats {f.value:.7g}" if f.axis else "all axes repeat one reading"
        what = f"{which} for {number_of(f.longest, 'sample')}"
    return f"{what}, first at {f.first_s:.1f} s{_in_poses(f.touched)}"


@quality.register
def _(found: of.MissingSamples, unit: str = "") -> str:
    if found.gaps == 1:
        return f"{found.missing} of {found.of} by the times, at {found.first_s:.1f} s"
    return (
        f"{found.missing} of {found.of} by the times, in {found.gaps} gaps, the first at {found.first_s:.1f} s, "
        f"{found.longest} in the longest"
    )


@quality.register
def _(found: of.Bursts, unit: str = "") -> str:
    return f"{number_of(found.samples, 'sample')} every {found.period_s * 1e3:.0f} ms, taken for evenly spaced"


@quality.register
def _(found: of.DuplicateSamples, unit: str = "") -> str:
    return f"{found.repeated} of {found.samples} samples repeat the one before on all axes"


@quality.register
def _(found: of.MainsPickup, unit: str = "") -> str:
    return "; ".join(_tone(t, found.rate_hz, _behind(unit)) for t in found.tones)


def _tone(t: of.Tone, rate_hz: float, unit: str) -> str:
    sizes = ", ".join(f"{axis} {a:.2g}{unit}" for axis, a in zip(of.AXES, t.amplitude, strict=True) if a > 0)
    said = f"{t.frequency_hz:.1f} Hz, amplitude {sizes}"
    if t.alias_of_hz is None:
        return said
    return f"{said} (the alias of {t.alias_of_hz:g} Hz at {rate_hz:.4g} Hz sampling, or a vibration)"


@quality.register
def _(found: of.CoarseQuantization, unit: str = "") -> str:
    unit = _behind(unit)
    return "; ".join(
        f"{s.axis} in steps of {s.step:.3g}{unit}, scatter {s.scatter:.2g}{unit}, pose means off by up to "
        f"{s.mean_error:.2g}{unit}"
        for s in found.axes
    )


@quality.register
def _(found: of.DisturbedPoses, unit: str = "") -> str:
    named = [_disturbance(d, _behind(unit)) for d in found.disturbances[:POSES_NAMED]]
    more = len(found.disturbances) - POSES_NAMED
    return f"{len(found.disturbed)} of {found.of}; {'; '.join(named)}" + (f"; and {more} more" if more > 0 else "")


def _disturbance(d: of.Disturbance, unit: str) -> str:
    pose = f"the pose that begins at {d.pose_s:.1f} s"
    if d.stretch_s is None:
        return f"{pose} scatters {_times(d.times)} as much as most, and its standard error says so"
    begin, end = d.stretch_s
    return (
        f"{pose} is shaken from {begin:.1f} to {end:.1f} s by {d.scatter:.2g}{unit}, {_times(d.times)} the scatter of "
        "its rest, and the mean leaves that out"
    )


def _times(factor: float) -> str:
    return f"{factor:.0f} times" if factor >= 10 else f"{factor:.2g} times"


@quality.register
def _(found: of.MergedPoses, unit: str = "") -> str:
    return "; ".join(
        f"shaking hides a move between {m.start_s:.1f} and {m.end_s:.1f} s, {m.axis} by {m.apart:.2g}{_behind(unit)}: "
        "two poses"
        for m in found.moves
    )


def _behind(unit: str) -> str:
    return f" {unit}" if unit else ""


def _in_poses(touched: of.Touched) -> str:
    """When the poses begin, so that they can be taken again."""
    if not touched.poses:
        return ", in no pose"
    times = ", ".join(f"{s:.1f}" for s in touched.starts_s[:POSES_NAMED])
    more = len(touched.starts_s) - POSES_NAMED
    which = "pose that begins" if len(touched.poses) == 1 else "poses that begin"
    return f", in the {which} at {times} s{f' and {more} more' if more > 0 else ''}: take again"
