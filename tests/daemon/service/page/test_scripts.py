"""What the scripts compute as the rest of the program does: the words of a pose, and the state after events."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.daemon.service.page.conftest import Opened
from tests.daemon.service.page.stage import FACES, Stage
from triaxcal.model.directions import cube_directions, directions
from triaxcald.station.faces import described

pytestmark = pytest.mark.slow


def ups() -> list[list[float]]:
    """Faces, edges and corners, a spiral, anything, and what lies half way between two steps."""
    rng = np.random.default_rng(1)
    chance = rng.normal(size=(2000, 3))
    tilted = [v + 0.08 * k * w for _, v in cube_directions() for _, w in cube_directions()[:6] for k in (1, 2, 3)]
    found = [v for _, v in cube_directions()] + [v for _, v in directions(37)] + list(chance) + tilted
    return [[round(float(c), 6) for c in v / np.linalg.norm(v)] for v in found if np.linalg.norm(v) > 0.1]


def test_a_pose_has_the_words_of_the_terminal(stage: Stage, opened: Opened) -> None:
    page = opened("/sign-in")
    told = page.evaluate(
        """async ([ups, faces]) => {
          const { describedPose } = await import("/static/pose.js");
          const said = ({ pose, tilt }) => (tilt ? `${pose}, ${tilt}` : pose);
          return ups.map((up) => said(describedPose(up, faces)));
        }""",
        [ups(), FACES],
    )
    expected = [described(np.array(up), FACES) for up in ups()]
    assert [(a[0].lower() + a[1:], b) for a, b in zip(told, expected, strict=True) if a.lower() != b.lower()] == []


def test_events_lead_to_the_state_that_the_service_has(stage: Stage, opened: Opened) -> None:
    stage.scan("OP:Olena", "SN-1", "SN-2", "SN-3", "SN-4", "CMD:START")
    before: dict[str, Any] = stage.do(lambda: stage.floor.state(stage.floor.stream.seq))
    stage.stage("identity")
    stage.stage("poses")
    stage.instruct([0, 1, 0])
    stage.poses("a", 3, 14, [0.0, 1.0, 0.0])
    stage.say("lost", "b", code="lost", reason="no answer for 2 s")
    stage.say("lost", "c", code="absent", reason="no answer for 2 s")
    stage.say("back", "b")
    stage.stage("power_off", "d")
    stage.stage("check_poses", "a")
    stage.finish("d", "verification_outside", "63 µg off")
    stage.finish("c", "no_limit", "no limit")
    events = stage.events()
    after: dict[str, Any] = stage.do(lambda: stage.floor.state(stage.floor.stream.seq))
    page = opened("/sign-in")
    found = page.evaluate(
        """async ([state, events]) => {
          const { after } = await import("/static/state.js");
          const twice = events.flatMap((event) => [event, event]);
          return twice.reduce(after, state);
        }""",
        [before, events],
    )
    assert len(events) == 17
    assert found == after
