"""Which frames of a log are the unit's."""

from __future__ import annotations

import pytest

from triaxcal_drivers.can.layout import Layout
from triaxcal_drivers.can.message import Message, Signal
from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.can_frames import LoggedFrame
from triaxcald.errors import InputError
from triaxcald.imports.of_can import Selection

UX = Signal("ux", 0, 8)


def layout(*, per_node: bool = False, extended: bool = False) -> Layout:
    return Layout((Message("M", 0x180, {"ux": UX}, extended, per_node),), {"ux": (0, UX)}, ())


def frame(source: int, channel: str = "1", flags: int = 0) -> LoggedFrame:
    return LoggedFrame(0, source, flags, b"\0", channel)


def test_an_identifier_is_standard_or_extended() -> None:
    extended = int(RawFlag.EXTENDED_ID)
    for own, other in ((0, extended), (extended, 0)):
        chosen = Selection({"readings": layout(extended=bool(own))})
        assert chosen.takes(frame(0x180, flags=own))
        assert not chosen.takes(frame(0x180, flags=other))
        assert (chosen.frames, chosen.taken, chosen.others) == (2, 1, {(0x180, other): 1})


def test_the_node_that_is_there_is_the_units() -> None:
    chosen = Selection({"readings": layout(per_node=True)})
    assert [chosen.takes(frame(s)) for s in (0x180, 0x181, 0x181 + 126, 0x180 + 128)] == [False, True, True, False]
    with pytest.raises(InputError, match=r"frames of the nodes 1 \(1 frame\), 127 \(1 frame\); --node says"):
        chosen.settle("log")
    chosen = Selection({"readings": layout(per_node=True)}, node=127)
    assert [chosen.takes(frame(s)) for s in (0x181, 0x181 + 126)] == [False, True]
    chosen.settle("log")
    assert (chosen.node, chosen.elsewhere) == (127, 1)


def test_messages_may_come_by_a_bus_each_but_none_by_two() -> None:
    layouts = {"readings": layout(), "corrected": Layout((Message("N", 0x200, {"ux": UX}),), {"ux": (0, UX)}, ())}
    chosen = Selection(layouts)
    assert chosen.takes(frame(0x180, "a"))
    assert chosen.takes(frame(0x200, "b"))
    chosen.settle("log")
    assert chosen.from_channels == ["a", "b"]
    assert chosen.takes(frame(0x180, "b"))
    with pytest.raises(InputError, match=r"0x180 comes on a \(1 frame\), b \(1 frame\); --channel says"):
        chosen.settle("log")
    chosen = Selection(layouts, channel="b")
    assert not chosen.takes(frame(0x180, "a"))
    assert chosen.takes(frame(0x180, "b"))
    chosen.settle("log")


def test_error_frames_come_along_where_they_are_of_the_units_bus() -> None:
    chosen, broken = Selection({"readings": layout()}), int(RawFlag.ERROR)
    taken = [chosen.takes(f) for f in (frame(0x180, "a"), frame(4, "b", broken), frame(4, "a", broken))]
    assert taken == [True, False, True]
    assert (chosen.taken, chosen.error_frames, chosen.elsewhere) == (1, 1, 1)


def test_what_is_there_instead_of_the_unit_is_said() -> None:
    chosen = Selection({"readings": layout()})
    with pytest.raises(InputError, match=r"none of the profile's identifiers \(0x180\) is in it; found: no frame"):
        chosen.settle("log")
    chosen.takes(frame(4, flags=int(RawFlag.ERROR)))
    with pytest.raises(InputError, match=r"found: frames of other channels or nodes, or in error \(1\)"):
        chosen.settle("log")


def test_frames_of_strangers_on_several_buses_are_none_of_the_units() -> None:
    chosen = Selection({"readings": layout(per_node=True)}, node=5)
    for source, channel in ((0x185, "a"), (0x186, "a"), (0x186, "b")):
        chosen.takes(frame(source, channel))
    chosen.settle("log")
    assert (chosen.from_channels, chosen.elsewhere) == (["a"], 2)


def test_a_node_is_refused_where_the_identifiers_know_none() -> None:
    chosen = Selection({"readings": layout()}, node=5)
    chosen.takes(frame(0x180))
    with pytest.raises(InputError, match=r"^--node 5: the identifiers of the profile are the same for all nodes"):
        chosen.settle("log")
