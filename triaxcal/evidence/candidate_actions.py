"""What may be done next, and the pose that it would give: what a plan of more
poses chooses among."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import channel_of, is_derived
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.unmodelled_kernels import reading_geometry
from triaxcal.model.directions import cube_directions, elsewhere
from triaxcal.poses.pose import Pose

UNDECIDED_PROBABILITY = 0.02
"""A name, or an outlier, of less probability is asked about by no action of its
own."""
FAR = 3.0
"""Standard errors from the linear fit from which on a pose is one to take
again."""
AGAIN = 4
"""Poses to take again by themselves, at most: those farthest off."""
SAME = float(np.cos(np.radians(5.0)))
"""The cosine between directions that are one: nobody points a unit much better
by hand."""
POSE, MOVED, WAITED = 1.0, 5.0, 3.0
"""The cost of a pose; of one before which a channel is moved and settles,
which takes minutes where a pose takes a part of one; and of one after a pause,
which takes as long but no hands."""
FACES = 6
"""Directions in which a moved channel, or a unit that rested, is asked about:
what goes with them is a bias or a scale factor of an axis, and a face shows
either best."""
BETWEEN = 24
"""Directions farthest from all that were taken and from the cube's, on whose
faces, vertices and edges an axis reads four values alone: two functions of that
reading which agree there are distinguished between them."""
LONGER = 4.0
"""Times as long a pose is to be held where each has an error of its own: half
of what averages out is left."""


class ActionKind(StrEnum):
    POSE = "pose"
    """A pose in a direction, next."""
    REPEAT = "repeat"
    """A pose in the direction of one that was taken."""
    CHANNEL = "channel"
    """A logged channel is moved before the pose, and stays there."""
    PAUSE = "pause"
    """The unit rests before the pose."""
    LOG = "log"
    """What goes with time goes with something that is not logged: log it."""
    HOLD = "hold"
    """Each pose has an error of its own: hold all of them longer."""


@dataclass(frozen=True, eq=False)
class Action:
    """``up`` (3,) is the direction of up in the unit's frame, with the
    ``label`` that a plan has for it. ``repeat_of`` is the pose, among all that
    were given, whose direction it is. ``channel`` is moved ``by`` so much, in
    its unit, or is to be logged; empty where nobody knows which. The pose
    begins ``pause_s`` later than it would, or is held for ``hold_s``.
    ``information`` is what it is expected to bring, in nats, beside the actions
    before it."""

    kind: ActionKind
    up: Floats | None = None
    label: str = ""
    repeat_of: int | None = None
    channel: str = ""
    by: float = 0.0
    pause_s: float = 0.0
    hold_s: float = 0.0
    information: float = 0.0

    @property
    def cost(self) -> float:
        return {ActionKind.CHANNEL: MOVED, ActionKind.PAUSE: WAITED}.get(self.kind, POSE)


class Options:
    """After the poses of a posterior and those that were chosen: the actions,
    each with the pose that it gives, held as long and as quietly as is usual
    here. Covariates stay as they last were, and the pose before is the last
    one."""

    def __init__(self, posterior: Posterior, wanted: Sequence[int]) -> None:
        """``wanted`` are poses that are to be taken again in any case, even if
        the unit has to leave one for that."""
        self.rows = posterior.evidence.rows
        self.wanted = {int(self.rows.places[i]) for i in wanted}
        poses = self.rows.poses
        self.sensor = self.rows.state.sensor(self.rows.problem)
        self.usual = poses[int(np.argsort(self.rows.error[: self.rows.n], kind="stable")[self.rows.n // 2])]
        self.last = max(poses, key=lambda p: (p.run.index, p.t_s))
        run = sorted((p for p in poses if p.run == self.last.run), key=lambda p: p.t_s)
        self.duration_s = float(np.median(self.rows.duration_s))
        gaps = [after.start_s - before.end_s for before, after in itertools.pairwise(run)]
        self.gap_s = max(float(np.median(gaps)), 0.0) if gaps else 0.0
        self.lasted_s = run[-1].end_s - run[0].start_s
        self.range = {
            channel: _range(poses, channel) for channel in _channels(posterior) if channel in self.last.channels
        }
        self.taken = reading_geometry(self.rows, self.rows.problem.u).up
        self.suspects = list(dict.fromkeys([*wanted, *_suspects(posterior)]))
        cube = cube_directions()
        known = np.concatenate([self.taken, [up for _, up in cube]])
        planned = [(label, up) for label, up in cube if not self._near(up, self.suspects)]
        self.directions: list[tuple[str, Floats, int | None]] = [
            *((_label(self.taken[i]), self.taken[i], int(self.rows.places[i])) for i in self.suspects),
            *((label, up, self._again(up)) for label, up in [*planned, *elsewhere(known, BETWEEN)]),
        ]

    def after(self, chosen: Sequence[Pose]) -> list[tuple[Action, Pose]]:
        """Those in another direction than the last: a unit that stays where it
        is makes no pose of its own."""
        last = chosen[-1] if chosen else self.last
        here = reading_geometry(self.rows, last.mean[None]).up[0]
        return [
            (action, pose)
            for action, pose in self._after(last)
            if action.up is None or action.up @ here <= SAME or action.repeat_of in self.wanted
        ]

    def _after(self, last: Pose) -> Iterator[tuple[Action, Pose]]:
        next_s = last.end_s + self.gap_s
        for label, up, again in self.directions:
            yield (
                Action(ActionKind.POSE if again is None else ActionKind.REPEAT, up, label, again),
                self._pose(last, up, next_s),
            )
        for label, up in cube_directions()[:FACES]:
            again = self._again(up)
            if self.lasted_s > 0:
                later = self._pose(last, up, next_s + self.lasted_s)
                yield Action(ActionKind.PAUSE, up, label, again, pause_s=self.lasted_s), later
            for channel, whole in self.range.items():
                for by in (whole, -whole):
                    settled = replace(
                        last,
                        channels={**last.channels, channel: last.channels[channel] + by},
                        rates=dict.fromkeys(last.rates, 0.0),
                    )
                    yield Action(ActionKind.CHANNEL, up, label, again, channel, by), self._pose(settled, up, next_s)

    def _pose(self, last: Pose, up: Floats, start_s: float) -> Pose:
        nothing = np.zeros(3)
        return replace(
            self.usual,
            start_s=start_s,
            end_s=start_s + self.duration_s,
            mean=self.sensor.output(up[None] * self.rows.problem.reference, {})[0],
            creep=nothing,
            slope=nothing,
            channels=last.channels,
            rates=last.rates,
            bends=dict.fromkeys(last.bends, 0.0),
            before=last.mean,
            run=last.run,
        )

    def _again(self, up: Floats) -> int | None:
        """The pose of the same direction, among all that were given."""
        near = self._near(up, range(len(self.taken)))
        return int(self.rows.places[near[0]]) if near else None

    def _near(self, up: Floats, among: Sequence[int]) -> list[int]:
        """Those of the poses that have this direction, the nearest first."""
        along = self.taken @ up
        same = [i for i in among if along[i] > SAME]
        return sorted(same, key=lambda i: -along[i])


def _label(up: Floats) -> str:
    """That of the cube's direction, where it is one."""
    return next((label for label, v in cube_directions() if float(v @ up) > SAME), "")


def _suspects(posterior: Posterior) -> list[int]:
    """Poses that may be outliers, and then those that are far off the linear
    fit."""
    rows, outlier = posterior.evidence.rows, posterior.outlier_probabilities
    spread = np.sqrt(np.maximum(1 - np.sum(rows.basis**2, axis=1), 0.0))
    off = np.abs(rows.left / np.maximum(spread, 1e-9))[: rows.n]
    found = [i for i in range(rows.n) if outlier[i] >= UNDECIDED_PROBABILITY or off[i] >= FAR]
    return sorted(found, key=lambda i: (outlier[i] < UNDECIDED_PROBABILITY, -off[i]))[:AGAIN]


def _channels(posterior: Posterior) -> list[str]:
    """Logged ones with which an effect goes that may act."""
    effects = {t.name: t.effect for t in posterior.evidence.terms if t.effect is not None}
    likely = [effects[name] for name, p in posterior.effect_probabilities.items() if p >= UNDECIDED_PROBABILITY]
    needed = (need for effect in likely for need in effect.needs if not is_derived(need))
    return list(dict.fromkeys(map(channel_of, needed)))


def _range(poses: Sequence[Pose], channel: str) -> float:
    return float(np.ptp([p.channels[channel] for p in poses]))
