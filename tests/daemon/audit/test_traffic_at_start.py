"""The registers that corrected the readings, against what was read before the first write."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from triaxcal_drivers.catalogue import load_bundle
from triaxcald.audit.traffic import Said, Traffic, check
from triaxcald.provision.correction import AT_START

BEFORE = {"ax_offset": b"\x00\x0a", "ay_offset": b"\x00\x0b", "az_offset": b"\xff\x0c"}


@pytest.mark.parametrize(
    ("at_start", "earlier", "found"),
    [
        (BEFORE, None, []),
        (None, None, []),
        ({**BEFORE, "ay_offset": b"\x00\x0c"}, None, ["ay_offset"]),
        ({**BEFORE, "ay_offset": b"\x00\x0c"}, BEFORE, []),  # a provisioning that was interrupted came between
    ],
)
def test_an_edit_of_the_registers_at_the_start_is_found(
    at_start: Mapping[str, bytes] | None, earlier: Mapping[str, bytes] | None, found: list[str]
) -> None:
    traffic = Traffic([], load_bundle(Path("witmotion-485")).profile)
    said = Said(
        before=BEFORE,
        earlier=earlier,
        after=None,
        image=None,
        told=None,
        held=None,
        forced=False,
        aborted=True,
        provisioned=None,
        at_start=at_start,
    )
    differences = [d for d in check(traffic, said, None) if d.part == AT_START]
    assert [d.place for d in differences] == found
