"""Frames of every sort, and what is read out of a log's bytes."""

from __future__ import annotations

import io
import random
from collections.abc import Callable, Iterator
from typing import BinaryIO

import can
import pytest

from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.logs.can_frames import FD_LENGTHS, Account, LoggedFrame

START_S = 1_700_000_000.0
Reader = Callable[[BinaryIO, Account], Iterator[LoggedFrame]]


@pytest.fixture(scope="session")
def messages() -> list[can.Message]:
    """A thousand, a millisecond apart: both kinds of identifiers, CAN FD, remote and error frames, two channels."""
    dice = random.Random(1)
    made = []
    for i in range(1000):
        extended, kind = dice.random() < 0.4, dice.randrange(10)
        common = {
            "timestamp": START_S + i / 1000,
            "arbitration_id": dice.getrandbits(29 if extended else 11),
            "is_extended_id": extended,
            "channel": dice.randrange(2),
        }
        if kind == 0:
            made.append(can.Message(**common, is_remote_frame=True, dlc=0))
        elif kind == 1:
            made.append(can.Message(timestamp=common["timestamp"], is_error_frame=True, channel=0))
        elif kind < 4:
            data = dice.randbytes(dice.choice(FD_LENGTHS[1:]))
            brs, esi = dice.random() < 0.5, dice.random() < 0.5
            made.append(
                can.Message(
                    **common, is_fd=True, data=data, dlc=len(data), bitrate_switch=brs, error_state_indicator=esi
                )
            )
        else:
            data = dice.randbytes(dice.randrange(9))
            made.append(can.Message(**common, data=data, dlc=len(data), is_rx=dice.random() < 0.5))
    return made


def as_logged(m: can.Message) -> tuple[int, int, bytes]:
    """Identifier, flags and data as a reader has to give them."""
    if m.is_error_frame:
        return 0, int(RawFlag.ERROR), b""
    flags = RawFlag.EXTENDED_ID * m.is_extended_id | RawFlag.FD * m.is_fd | RawFlag.BIT_RATE_SWITCH * m.bitrate_switch
    flags |= RawFlag.REMOTE * (m.is_remote_frame or m.error_state_indicator) | RawFlag.SENT * (not m.is_rx)
    return m.arbitration_id, int(flags), bytes(m.data)


@pytest.fixture(scope="session")
def read() -> Callable[[Reader, bytes], tuple[list[LoggedFrame], Account]]:
    def of(reader: Reader, data: bytes) -> tuple[list[LoggedFrame], Account]:
        account = Account()
        return list(reader(io.BytesIO(data), account)), account

    return of
