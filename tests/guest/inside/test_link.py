"""Links that go down, interfaces that go away: said in one line that mends it, after the frames that came before."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from typing import Any

import pytest

from tests.guest.inside.witness import Sender, received
from triaxcal_drivers.errors import BusError


def ip(*words: str) -> None:
    subprocess.run(["ip", "link", *words], check=True, capture_output=True, text=True)


def test_a_link_that_goes_down_is_told_after_what_it_brought_and_comes_back(
    vcan: str, sender: Sender, opened: Callable[..., Any]
) -> None:
    adapter = opened(vcan)
    sender.count(0x123, range(3))
    ip("set", vcan, "down")
    assert len(adapter.receive(5.0)) == 3
    down = rf"socketcan {vcan}: the link is down: `ip link set {vcan} up`"
    for _ in range(2):
        with pytest.raises(BusError, match=down):
            adapter.receive(5.0)
    with pytest.raises(BusError, match=down):
        adapter.send(0x100, b"")
    with pytest.raises(BusError, match=f"cannot open {down}"):
        opened(vcan)
    ip("set", vcan, "up")
    again, other = opened(vcan), Sender(vcan)
    other.count(0x123, [4])
    assert len(received(again, 1)) == 1
    other.close()


def test_an_interface_that_goes_away_is_told_and_comes_back(vcan: str, sender: Sender, opened: Any) -> None:
    adapter = opened(vcan)
    sender.count(0x123, [1])
    ip("del", vcan)
    assert len(adapter.receive(5.0)) == 1
    with pytest.raises(BusError, match=rf"socketcan {vcan}: (there is no such interface|the link is down)"):
        adapter.receive(5.0)
    with pytest.raises(BusError, match=rf"cannot open socketcan {vcan}: there is no such interface.*`ip link add`"):
        opened(vcan)
    ip("add", "dev", vcan, "up", "type", "vcan")
    sender.close()
    again, other = opened(vcan), Sender(vcan)
    other.count(0x123, [2])
    assert len(received(again, 1)) == 1
    other.close()


def test_whoever_waits_is_told_at_once(vcan: str, opened: Callable[..., Any]) -> None:
    told: list[str] = []

    def wait(adapter: Any) -> None:
        try:
            told.append(str(adapter.receive(3600.0)))
        except BusError as e:
            told.append(str(e))

    for end in (lambda adapter: ip("set", vcan, "down"), lambda adapter: adapter.close()):
        ip("set", vcan, "up")
        adapter = opened(vcan)
        waiting = threading.Thread(target=wait, args=(adapter,))
        waiting.start()
        end(adapter)
        waiting.join(timeout=180)
        assert not waiting.is_alive()
    assert "the link is down" in told[0]
    assert told[1] == "[]" or "has been closed" in told[1]


def test_a_wrong_name_is_told_with_those_that_there_are(vcan: str, opened: Callable[..., Any]) -> None:
    with pytest.raises(BusError, match=rf"there is no such interface.*{vcan}"):
        opened("vcan99")
    with pytest.raises(BusError, match=rf"cannot open socketcan lo: no CAN interface.*{vcan}"):
        opened("lo")
    with pytest.raises(BusError, match="there is no such interface"):
        opened("a-name-longer-than-linux-allows")


def test_a_closed_receiver_says_so(vcan: str, opened: Callable[..., Any]) -> None:
    adapter = opened(vcan)
    adapter.close()
    adapter.close()
    for use in (lambda: adapter.receive(0.0), lambda: adapter.send(1, b""), lambda: adapter.only(None)):
        with pytest.raises(BusError, match=f"socketcan {vcan} has been closed"):
            use()
