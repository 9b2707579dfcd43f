"""From raw records to still poses: the one way that a live bus and a recording
share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.decoded import DecodedStream, beside_samples, only_finite

__all__ = ["DecodedStream", "Pipeline", "beside_samples", "of_poses", "only_finite", "together"]


@dataclass
class Pipeline(DecodedStream):
    """With stillness and quality detector."""

    turn_s: float | None = None
    """Where the unit may turn in place, as for `find_spans`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._finder = tc.poses.PoseFinder(self.turn_s)

    def _take(self, block: td.SampleBlock, fresh: NDArray[np.bool_]) -> None:
        channels = {n: v[fresh] for n, v in block.channels.items()}
        self._finder.feed(block.time_ns[fresh], block.readings[fresh], channels)

    def feed_all(self, batches: Iterable[td.RawBatch]) -> Pipeline:
        for batch in batches:
            self.feed(batch)
        return self

    @property
    def windows(self) -> tc.poses.Windows | None:
        """Summaries of the stream so far; None while there are none."""
        return self._finder.windows

    def too_short(self) -> tc.TooShort | None:
        """Why no pose could be found so far, whatever the unit did."""
        return self._finder.too_short()

    def poses(self) -> list[tc.Pose]:
        """The still poses so far, whether their samples are faulty or not."""
        return self._finder.poses(judged=False)

    def sound_poses(self) -> list[tc.Pose]:
        """The still poses so far; those with faulty samples name the fault, as those
        of the whole stream do."""
        return self._finder.poses()

    def held(self) -> list[tc.StillSpan]:
        """The same without their noise, which takes longer than all the rest:
        enough to guide an operator by."""
        return self._finder.still_spans()

    def finish(self) -> list[tc.Pose]:
        """The still poses of the whole stream."""
        self.close()
        return self.parted(self.turn_s)

    def close(self) -> None:
        """No more records come."""
        self._finder.finish()

    def parted(self, turn_s: float | None) -> list[tc.Pose]:
        """The still poses of the whole stream once that is closed, for another
        ``turn_s``."""
        self._finder.part_by(turn_s)
        return self._finder.poses()

    def data_quality(self) -> list[str]:
        """What the raw stream is to be blamed for, one line each."""
        found: dict[str, str] = {}
        if self.two_senders:
            found["two_senders"] = "two units send on this stream, and their samples are mixed"
        if self.counts["missing"] or self.counts["incomplete"]:
            lost = self.counts["missing"] + self.counts["incomplete"]
            found["missing_samples"] = f"{lost} of {self.counts['samples'] + lost}"
        elif self.counts["receiver_overflows"]:
            times = self.counts["receiver_overflows"]
            found["missing_samples"] = f"the stream was interrupted {'once' if times == 1 else f'{times} times'}"
        if rate := self.wrong_rate():
            found["rate"] = rate
        if self.counts["duplicates"]:
            found["duplicate_samples"] = str(self.counts["duplicates"])
        if self.counts["malformed"]:
            found["malformed_records"] = (
                f"{self.counts['malformed']} too short for the profile's message, or not as it is defined, left out"
            )
        if self.counts["invalid"]:
            found["invalid_samples"] = f"{self.counts['invalid']} that the unit says are not valid, left out"
        if self.counts["not_finite"]:
            found["not_finite_samples"] = f"{self.counts['not_finite']} whose outputs are no finite numbers, left out"
        if self.counts["out_of_order"]:
            found["out_of_order_samples"] = f"{self.counts['out_of_order']}, left out"
        if self.counts["errors"]:
            found["bus_errors"] = tc.number_format.number_of(self.counts["errors"], "record")
        if absurd := self._implausible():
            found["implausible_readings"] = absurd
        return together(found, self._finder.findings(), self.output_unit)

    @property
    def output_unit(self) -> str:
        return self.bundle.profile.output.unit if self.stream == td.READINGS else "g"

    def _implausible(self) -> str:
        """Where still readings span more than gravity does, by the nominal
        scale factors: of a wrong register, type or order of words; else
        empty."""
        nominal = self.bundle.profile.output.nominal_scale_factor
        windows = self.windows
        spans = self._finder.spans()
        if windows is None or not spans or nominal is None or self.stream != td.READINGS:
            return ""
        means = np.array([windows.mean[s.used].mean(axis=0) for s in spans])
        half_g = np.ptp(means, axis=0) / 2 / np.abs(nominal)
        if half_g.max() <= td.SCALE_FACTOR_RATIO:
            return ""
        axis = int(np.argmax(half_g))
        return (
            f"by output.nominal_scale_factor the poses span ±{half_g[axis]:.3g} g in {'xyz'[axis]}, and gravity has "
            "±1 g; does the profile decode the readings as the unit sends them?"
        )


def together(counted: Mapping[str, str], seen: Iterable[tc.poses.QualityFinding], unit: str = "") -> list[str]:
    """What was ``counted`` on the way here, by name, and what is ``seen`` in
    the samples, whose outputs are in ``unit``: one line for each kind of fault.
    What was counted as missing leaves the gaps that are seen, which are not
    said again.
    """
    said = dict(counted)
    for finding in seen:
        if finding.name not in said:
            said[finding.name] = tc.text.quality(finding, unit)
        elif finding.name != "missing_samples":
            said[finding.name] += f"; {tc.text.quality(finding, unit)}"
    return [f"{name}: {what}" for name, what in said.items()]


def of_poses(poses: Sequence[tc.Pose], unit: str = "") -> list[str]:
    """What poses are to be blamed for, likewise."""
    said = [tc.text.quality_line(f, unit) for f in tc.poses.disturbances(poses)]
    if found := [p for p in poses if p.creep.any()]:
        said.append(f"creeping_pose: {len(found)} of {len(poses)}, the first at {found[0].start_s:.1f} s")
    return said
