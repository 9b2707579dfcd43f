"""How well still poses are found, and how true the standard errors of their means are, where the truth is known.

    python benchmarks/stillness.py            # some minutes
    python benchmarks/stillness.py --quick    # fewer seeds

One line a condition, over all seeds: poses there were / found / split / merged / invented; how far the worst boundary
lies outside its hold; the variance of the pulls (error of a mean over its standard error; 1 is right) by axis and
along the measured vector; the largest bias that edges and bumps put into a mean, and its rms, in standard errors.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, field

import numpy as np

from benchmarks.streams import COVARIATES, PAPER_UNIT, Condition, Stream, made
from triaxcal.arrays import Floats
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.stillness.detector import Span, StillnessDetector
from triaxcal.poses.stillness.windows import Windows

HEAD = (
    f"{'condition':36} {'true':>5} {'found':>5} {'split':>5} {'merged':>6} {'invented':>8} {'missed':>6} "
    f"{'overshoot s':>11} {'used':>5} {'pulls²':>7} {'along':>6} {'bias max':>8} {'rms':>6} {'creeping':>8}"
)


@dataclass
class Tally:
    """What was found, over the seeds of a condition."""

    true: int = 0
    found: int = 0
    split: int = 0
    merged: int = 0
    invented: int = 0
    missed: int = 0
    overshoot_s: float = 0.0
    pulls: list[Floats] = field(default_factory=list)
    along: list[float] = field(default_factory=list)
    bias: list[Floats] = field(default_factory=list)
    creeping: int = 0
    used: list[float] = field(default_factory=list)
    seeds: int = 0

    def add(self, stream: Stream, w: Windows, spans: list[Span], poses: list[Pose]) -> None:
        hits: dict[int, int] = {}
        self.true += len(stream.holds)
        self.found += len(poses)
        self.seeds += 1
        begin = np.array([h[0] for h in stream.holds])
        end = np.array([h[1] for h in stream.holds])
        for span, pose in zip(spans, poses, strict=True):
            shared = np.minimum(end, pose.end_s) - np.maximum(begin, pose.start_s)
            inside = np.flatnonzero(shared > 0.1)
            if not len(inside):
                self.invented += 1
                continue
            self.merged += len(inside) - 1
            i = int(np.argmax(shared))
            hits[i] = hits.get(i, 0) + 1
            if len(inside) > 1:
                for j in inside:
                    hits.setdefault(int(j), 1)
                continue
            self.overshoot_s = max(self.overshoot_s, begin[i] - pose.start_s, pose.end_s - end[i])
            self._judge(stream, w, span, pose, i)
        self.split += sum(n - 1 for n in hits.values())
        self.missed += len(stream.holds) - len(hits)

    def _judge(self, stream: Stream, w: Windows, span: Span, pose: Pose, i: int) -> None:
        miss = pose.mean - stream.truth[i]
        gradient = (stream.truth[i] - np.mean(stream.truth, axis=0)) if len(stream.truth) < 6 else stream.truth[i]
        gradient = (gradient - PAPER_UNIT.output(np.zeros((1, 3)), {})[0]) / PAPER_UNIT.scale_factor**2
        self.pulls.append(miss / pose.standard_error)
        self.along.append(float(miss @ gradient / np.sqrt(gradient @ pose.covariance @ gradient)))
        first = np.searchsorted(stream.t_s, w.start_ns[span.used] * 1e-9 - 1e-9)
        at = (first[:, None] + np.arange(w.size)).ravel()
        self.bias.append((stream.clean[at].mean(axis=0) - stream.truth[i]) / pose.standard_error)
        self.used.append((pose.end_s - pose.start_s) / (stream.holds[i][1] - stream.holds[i][0]))
        self.creeping += bool(np.any(pose.creep))


def measured(c: Condition, seeds: range) -> Tally:
    tally = Tally()
    for seed in seeds:
        stream = made(c, seed)
        detector = StillnessDetector()
        detector.feed(np.round(stream.t_s * 1e9).astype(np.int64), stream.readings)
        detector.finish()
        w, spans = detector.windows(), detector.spans()
        tally.add(stream, w, spans, poses_of(w, spans))
    return tally


def line(c: Condition, t: Tally) -> str:
    pulls, along, bias = np.array(t.pulls), np.array(t.along), np.array(t.bias)
    if not len(pulls):
        return f"{c.name:36} {t.true:5} {t.found:5} {t.split:5} {t.merged:6} {t.invented:8} {t.missed:6}"
    return (
        f"{c.name:36} {t.true:5} {t.found:5} {t.split:5} {t.merged:6} {t.invented:8} {t.missed:6} "
        f"{t.overshoot_s:11.3f} {np.mean(t.used):5.2f} {np.mean(pulls**2):7.3f} {np.mean(along**2):6.2f} "
        f"{np.abs(bias).max():8.3f} {np.sqrt(np.mean(bias**2)):6.3f} {t.creeping:8}"
    )


def speed(rate_hz: float, seconds: float = 60.0) -> str:
    c = Condition("speed", rate_hz, hold_s=(5.0, 5.0), poses=max(2, int(seconds / 6.5)))
    stream = made(c, 0)
    time_ns = np.round(stream.t_s * 1e9).astype(np.int64)
    begin = time.process_time()
    detector = StillnessDetector()
    for at in range(0, len(time_ns), 4096):
        detector.feed(time_ns[at : at + 4096], stream.readings[at : at + 4096])
    detector.finish()
    w, spans = detector.windows(), detector.spans()
    found = time.process_time()
    poses_of(w, spans)
    done = time.process_time()
    return (
        f"{rate_hz:6g} Hz: {len(time_ns) / (found - begin) / 1e6:6.2f} M samples/s of processor time, blocks of 4096; "
        f"standard errors of {len(spans)} poses in {(done - found) * 1e3:.0f} ms"
    )


def report(*, quick: bool = False, only: str = "") -> str:
    """The table and the speeds, as text."""
    lines = [HEAD]
    for c in COVARIATES:
        if only in c.name:
            lines.append(line(c, measured(c, range(2 if quick else 20))))
    lines += ["", *(speed(rate) for rate in (100.0, 1000.0, 10_000.0))]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Stillness and standard errors of poses, where the truth is known.")
    parser.add_argument("--quick", action="store_true", help="fewer seeds")
    parser.add_argument("--only", default="", help="conditions whose name contains this")
    chosen = parser.parse_args(arguments)
    print(report(quick=chosen.quick, only=chosen.only))
    return 0


if __name__ == "__main__":
    sys.exit(main())
