"""What to do after a diagnosis: what to record next, how to be rid of an
effect, and what the poses cannot show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from triaxcal.diagnosis import Loop, Recommendation, Verdict
from triaxcal.effects.catalogue import package_of
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.evidence.model_average import Refusal
from triaxcal.evidence.next_measurement import Action, ActionKind
from triaxcal.evidence.posterior import NotIdentifiable, Why
from triaxcal.number_format import plain
from triaxcal.planning.addition import ChannelRange
from triaxcal.poses.pose import Pose, moment, the_poses
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.combined import Scopes
from triaxcal.units import ErrorUnit

ALMOST = 0.999
"""Probabilities beyond are written as such: by which model they were reckoned
matters more."""
GOES_WITH = {
    UnmodelledKind.EACH_POSE: "each pose by itself",
    UnmodelledKind.DIRECTION: "the direction",
    UnmodelledKind.ODD: "the sign and the size of an axis's reading",
    UnmodelledKind.EVEN: "the size of an axis's reading",
    UnmodelledKind.POSE_BEFORE: "the pose before",
    UnmodelledKind.TIME: "the time",
    UnmodelledKind.LOCAL: "one direction, or one end of an axis, which a few poses share",
}
BY_DIRECTION = "; the mean over all that may act is corrected, as a smooth function of the direction"
REFUSED = {
    Refusal.UNMODELLED: "something that no known effect describes acts",
    Refusal.CHANGE_POINT: "one calibration does not hold in all poses",
    Refusal.ONE_POSE: "a single pose decides the result",
    Refusal.GAIN: "no name is certain, and the expected error would fall too little",
}


def chance(p: float) -> str:
    """A probability as it stands in a sentence."""
    if p > ALMOST:
        return f"more than {ALMOST}"
    return f"less than {1 - ALMOST:.1g}" if p < 1 - ALMOST else f"{p:.2g}" if p < 0.99 else f"{p:.3f}"


def to_do(loop: Loop, small: ErrorUnit) -> str:
    """The most urgent of `advice`, in one line."""
    first = "; ".join([*_poses_again(loop), *_apart(loop), *_next(loop, small)])
    if first:
        # What is not known for certain is in the uncertainty already.
        optional = loop.call is Recommendation.RECORD_MORE
        return f"optional where the limits are kept: {first}" if optional else first
    return _without_recording(loop)


def _without_recording(loop: Loop) -> str:
    """What to do where no pose is to be recorded."""
    if loop.call is Recommendation.INVESTIGATE:
        return "find out what acts before the calibration is used; no further pose is expected to tell"
    known = all(f.verdict is Verdict.ADOPTED for f in loop.findings) and not loop.candidates
    return "use the calibration" + ("" if known else "; no further pose is expected to tell more")


def advice(loop: Loop, small: ErrorUnit) -> Iterator[str]:
    """What to do, an action a line, the most urgent first."""
    yield from [*_poses_again(loop), *_apart(loop), *_next(loop, small)] or [_without_recording(loop)]
    yield from _meanwhile(loop, small)
    if loop.held_out is not None and loop.held_out.worse:
        before, after = small.in_full(loop.held_out.before_rms_g), small.in_full(loop.held_out.after_rms_g)
        yield (
            "diagnose both recordings together: in the check recording the linear calibration is better "
            f"({before}, with what was found {after})"
        )
    for finding in loop.findings:
        if finding.verdict is Verdict.ADOPTED:
            yield f"{finding.effect}: this calibration corrects it. In general: {finding.remedy}"
        else:
            yield f"if {finding.effect} acts: {finding.remedy}"


def _meanwhile(loop: Loop, small: ErrorUnit) -> Iterator[str]:
    """What the calibration is good for before the cause is known."""
    if loop.call is Recommendation.RECORD_MORE:
        yield "the calibration can be used meanwhile: its uncertainty contains what is not certain"
    if loop.call is Recommendation.INVESTIGATE and loop.found.change_point is None:
        scopes = Scopes.of(loop.after, budget(loop.after), loop.next_recording)
        session = small.in_full(scopes.this_session)
        yield (
            "until the cause is known, use the calibration only where an expanded uncertainty of "
            f"{session} in the poses of this session is enough"
        )


def notes(loop: Loop, small: ErrorUnit) -> Iterator[str]:
    """What else to know, a line each: nothing that anybody has to do."""
    if loop.refusal is not None:
        yield f"no effect is adopted, because {REFUSED[loop.refusal]}{BY_DIRECTION if loop.smooth else ''}"
    for name, expected in loop.advice.expected.items():
        if loop.stated[name] is None:  # not calibrated, so what it may become is not either
            continue
        yield (
            f"{name}: probability {chance(expected.now)} now, {chance(expected.if_it_acts)} expected after the poses "
            "that are advised, if it acts"
        )
    reasons = {name: blind(why) for name, why in loop.not_identifiable.items()}
    for reason in dict.fromkeys(reasons.values()):
        yield f"these poses cannot show in full {', '.join(n for n, r in reasons.items() if r == reason)}: {reason}"
    for name, reason in loop.faulty.items():
        yield f"the effect {name} of {package_of(name)} cannot be used: {reason}"


def of_creep(poses: Sequence[Pose]) -> str:
    """What to do about poses that creep; empty where none does."""
    creeping = sum(bool(p.creep.any()) for p in poses)
    if not creeping:
        return ""
    held = "their standard errors contain it"
    if 2 * creeping <= len(poses):
        return f"{held}, nothing to do"
    return f"{held}; as most poses creep, let the unit settle for longer before each, or keep its temperature steadier"


def _poses_again(loop: Loop) -> Iterator[str]:
    faulty = [p.pose for p in loop.after.poses if p.pose.fault]
    for fault in dict.fromkeys(p.fault for p in faulty):
        yield f"take again {the_poses(p.began for p in faulty if p.fault == fault)}: excluded ({fault})"
    if loop.found.outliers:
        poses = loop.after.poses
        yield f"take again {the_poses(poses[i].pose.began for i in loop.found.outliers)}: outliers"


def _apart(loop: Loop) -> Iterator[str]:
    if loop.found.change_point is not None:
        since = moment(loop.after.poses[loop.found.change_point.pose].pose.began)
        yield f"check the mounting and the connector, and which unit it is, from the pose at {since} on"


def _next(loop: Loop, small: ErrorUnit) -> Iterator[str]:
    actions = loop.advice.actions
    if beside := [_other_action(action) for action in actions if action.kind in (ActionKind.LOG, ActionKind.HOLD)]:
        yield "; ".join(beside)
    if poses := [_pose(action, loop) for action in actions if action.kind not in (ActionKind.LOG, ActionKind.HOLD)]:
        order = ", in this order" if len(poses) > 1 else ""
        yield f"record next, to tell what acts{order}: {', then '.join(poses)}"
    if loop.too_uncertain:
        following = loop.next_recording
        start, whole = small.in_full(following.start_to_start), small.in_full(following.standard)
        yield (
            f"record more poses (triaxcal plan): the standard uncertainty in the next recording is {whole}, of which "
            f"{start} would stay however many there are"
        )


def _other_action(action: Action) -> str:
    if action.kind is ActionKind.HOLD:
        return f"hold each pose for {action.hold_s:.0f} s, since each has an error of its own"
    return f"log {action.channel or 'what else may go with the time: the supply, a second temperature'}"


def _pose(action: Action, loop: Loop) -> str:
    pose, again = _direction(action), action.repeat_of
    if again is not None:
        pose = f"{pose} again (as pose {again + 1} at {moment(loop.after.poses[again].pose.began)})"
    if action.kind is ActionKind.CHANNEL:
        return f"{pose} with {action.channel} moved by {plain(action.by, sign='+')} and settled"
    return f"{pose} after {action.pause_s:.0f} s of rest" if action.kind is ActionKind.PAUSE else pose


def _direction(action: Action) -> str:
    if action.label or action.up is None:
        return action.label
    return "up along (" + ", ".join(f"{v:+.2f}" for v in action.up) + ")"


def to_move(channel: ChannelRange) -> str:
    """How a channel has to move in poses to come."""
    if channel.lowest is None or channel.highest is None:
        return "is not in the recording: log it, and move it"
    if channel.lowest == channel.highest:
        return f"stood still at {channel.lowest:.4g}: move it to either side of that"
    return f"from {channel.lowest:.4g} to {channel.highest:.4g} in the recording; levels are within that"


def blind(why: NotIdentifiable) -> str:
    """Why poses cannot show an effect in full."""
    match why.why:
        case Why.NOT_LOGGED:
            return f"channel {why.channel} is not logged"
        case Why.SOMETIMES_LOGGED:
            return f"channel {why.channel} is not logged in every pose"
        case Why.RATE_UNKNOWN:
            return f"how fast {why.channel} changes is not known in every pose"
        case Why.NOT_KNOWN:
            return f"{why.channel} is not known"
        case Why.STOOD_STILL:
            return f"{why.channel} stood still"
        case Why.EVEN_RATE:
            return f"{why.channel} changes no faster in one pose than in another"
        case Why.EVEN_SCATTER:
            return "the readings scatter alike in all poses"
        case Why.MOVED_ALONG:
            return "too few poses, or what it goes with moved along with their directions"
        case Why.FEW_DIRECTIONS:
            return "the poses point in too few directions"
