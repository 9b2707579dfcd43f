"""Every frame on a bus, in its order, with its stamp: as candump saw it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import pytest

from tests.guest.inside.controller import Controller
from tests.guest.inside.witness import ERROR, EXTENDED, REMOTE, Sender, received, words_of
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

SENT = RawFlag.SENT


def test_every_frame_comes_in_its_order_with_candumps_stamp(
    vcan: str, opened: Callable[..., Any], candump: Callable[..., Any]
) -> None:
    adapter, witness, frames = opened(vcan), candump(vcan, 600), []
    for kinds in (["-e"], ["-f", "-b"], ["-m"]):
        subprocess.run(["cangen", vcan, "-g", "0", "-n", "200", *kinds], check=True)
        frames += received(adapter, 200)
    seen = witness.frames()
    assert [words_of(frame) for frame in frames] == seen
    assert {frame.fd for frame in seen} >= {None, 0, 1}
    assert any(frame.word & EXTENDED for frame in seen)
    assert {frame.lost for frame in frames} == {0}
    assert any(frame.time_ns % 1000 for frame in frames)  # nanoseconds, and not candump's microseconds


def test_remote_frames_and_error_frames_are_told_from_data(
    vcan: str, sender: Sender, opened: Callable[..., Any], candump: Callable[..., Any]
) -> None:
    adapter, witness = opened(vcan), candump(vcan, 4)
    sender.send(0x123 | REMOTE, bytes(4))
    sender.send(0x1ABCDEF | EXTENDED | REMOTE)
    sender.send(ERROR | 0x40, bytes(8))
    sender.send(0x123, b"\x01\x02")
    frames = received(adapter, 4)
    assert [frame[1:4] for frame in frames] == [
        (0x123, RawFlag.REMOTE | SENT, bytes(4)),
        (0x1ABCDEF, RawFlag.REMOTE | RawFlag.EXTENDED_ID | SENT, b""),
        (0x40, RawFlag.ERROR | SENT, bytes(8)),
        (0x123, SENT, b"\x01\x02"),
    ]
    assert [words_of(frame) for frame in frames] == witness.frames()


def test_adapters_own_stamps_are_asked_for_and_the_kernels_taken_where_there_are_none(
    vcan: str, sender: Sender, opened: Callable[..., Any], candump: Callable[..., Any]
) -> None:
    adapter, witness = opened(vcan, hardware_timestamps=True), candump(vcan, 20)
    sender.count(0x100, range(20))
    assert [words_of(frame) for frame in received(adapter, 20)] == witness.frames()


def test_the_kernel_filters_so_that_a_foreign_flood_fills_no_buffer(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    adapter = opened(vcan, receive_buffer=5000)  # six frames
    adapter.only({(0x123, False), (0x18DAF101, True)})
    sender.count(0x124, range(1000))
    sender.count(0x123 | EXTENDED, range(1000))
    sender.send(ERROR | 0x40, bytes(8))
    sender.count(0x123, [7])
    sender.count(0x18DAF101 | EXTENDED, [8])
    frames = received(adapter, 3)
    assert [frame.source for frame in frames] == [0x40, 0x123, 0x18DAF101]
    assert [frame.lost for frame in frames] == [0, 0, 0]
    adapter.only(None)
    sender.count(0x124, [9])
    assert [frame.source for frame in received(adapter, 1)] == [0x124]
    adapter.only(())
    sender.count(0x124, range(100))
    sender.send(ERROR | 0x40, bytes(8))
    assert [frame.source for frame in received(adapter, 1)] == [0x40]


def test_of_two_receivers_the_one_hears_what_the_other_sends(vcan: str, opened: Callable[..., Any]) -> None:
    sends, hears, own = opened(vcan), opened(vcan), opened(vcan, receive_own_messages=True)
    sends.send(0x601, b"\x40\x18\x10\x01")
    sends.send(0x18DAF101, bytes(range(8)), extended=True)
    expected = [(0x601, SENT, b"\x40\x18\x10\x01"), (0x18DAF101, SENT | RawFlag.EXTENDED_ID, bytes(range(8)))]
    assert [frame[1:4] for frame in received(hears, 2)] == expected
    own.send(0x602, b"")
    assert [frame[1:4] for frame in received(own, 3)] == [*expected, (0x602, SENT, b"")]
    assert [frame.source for frame in received(sends, 1)] == [0x602]


def test_frames_are_not_looped_back_where_that_is_asked_for(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    silent, hears = opened(vcan, local_loopback=False), opened(vcan)
    silent.send(0x100, b"")
    sender.send(0x101)
    assert [frame.source for frame in received(hears, 1)] == [0x101]


def test_can_fd_frames_are_sent_and_received_unless_they_are_refused(
    vcan: str, opened: Callable[..., Any], candump: Callable[..., Any]
) -> None:
    hears, classic, witness = opened(vcan), opened(vcan, fd=False), candump(vcan, 2)
    hears.send(0x123, bytes(range(64)))
    hears.send(0x124, b"\x05")
    (long, short) = witness.frames()
    assert (long.fd, long.data) == (0, bytes(range(64)))
    assert (short.fd, short.data) == (None, b"\x05")
    assert [frame.source for frame in received(classic, 1)] == [0x124]
    with pytest.raises(BusError, match=rf"socketcan {vcan}: cannot send 64 bytes .* up to 8"):
        classic.send(0x123, bytes(64))
    with pytest.raises(BusError, match="13 bytes of data: no length of a CAN FD frame"):
        hears.send(0x123, bytes(13))


def test_an_interface_without_can_fd_is_told_where_it_is_asked_for(controller: Controller, opened: Any) -> None:
    with pytest.raises(BusError, match=rf"{controller.name}: fd is asked for, .* fd on"):
        opened(controller.name, fd=True)
    with pytest.raises(BusError, match="9 bytes of data: no length without CAN FD"):
        opened(controller.name).send(0x123, bytes(9))


def test_what_other_nodes_send_is_not_flagged_as_sent(controller: Controller, opened: Any) -> None:
    adapter = opened(controller.name, 500_000)
    controller.says("t1232AABB")
    controller.says("R1ABCDEF03")
    (data, remote) = received(adapter, 2)
    assert data[1:4] == (0x123, 0, b"\xaa\xbb")
    assert remote[1:4] == (0x1ABCDEF0, RawFlag.EXTENDED_ID | RawFlag.REMOTE, bytes(3))


def test_a_listen_only_receiver_sends_nothing(vcan: str, opened: Callable[..., Any], candump: Any, sender: Any) -> None:
    adapter, witness = opened(vcan, listen_only=True), candump(vcan, 1)
    with pytest.raises(BusError, match="opened listen-only: nothing is sent"):
        adapter.send(0x100, b"")
    sender.send(0x101)
    assert [frame.word for frame in witness.frames()] == [0x101]
    assert [frame.source for frame in received(adapter, 1)] == [0x101]
