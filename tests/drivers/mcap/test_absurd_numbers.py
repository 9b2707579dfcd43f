"""Numbers in messages that no float and no time holds: such a message is not as it is defined."""

from __future__ import annotations

import json

import numpy as np
import pytest

from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.mcap.driver import MessageDecoder, MessageSchema, MessageStream, Read, reader

STREAM = MessageStream.model_validate(
    {"topic": "/imu", "time": "stamp", "channels": {"ux": "a.0", "uy": "a.1", "uz": "a.2"}}
)
GOOD = b'{"stamp": {"sec": 5, "nsec": 7}, "a": [1, 2.5, 3]}'


def read() -> Read:
    return reader(MessageSchema("", "json", "", b""), ["a.0", "a.1", "a.2"], "stamp", "here")


@pytest.mark.parametrize(
    "bad",
    [
        b'{"stamp": {"sec": 1e999, "nsec": 0}, "a": [1, 2, 3]}',
        b'{"stamp": {"sec": 0, "nsec": -1e999}, "a": [1, 2, 3]}',
        b'{"stamp": {"sec": NaN, "nsec": 0}, "a": [1, 2, 3]}',
        b'{"stamp": {"sec": 1e300, "nsec": 0}, "a": [1, 2, 3]}',
        b'{"stamp": 1e305, "a": [1, 2, 3]}',
        b'{"stamp": Infinity, "a": [1, 2, 3]}',
        b'{"stamp": 1' + b"0" * 400 + b', "a": [1, 2, 3]}',
        b'{"stamp": 5.0, "a": [1' + b"0" * 400 + b", 2, 3]}",
        b'{"stamp": 5.0, "a": [1' + b"0" * 5000 + b", 2, 3]}",
    ],
)
def test_a_message_with_such_a_number_is_none(bad: bytes) -> None:
    with pytest.raises(ValueError):
        read()(bad)
    block = MessageDecoder(STREAM, read(), 0).feed(RawBatch.of([(10, 0, 0, GOOD), (20, 0, 0, bad), (30, 0, 0, GOOD)]))
    assert (len(block), block.malformed) == (2, 1)
    assert np.array_equal(block.readings, [[1, 2.5, 3]] * 2)


def test_stamps_that_are_further_apart_than_a_time_can_be_count_as_malformed() -> None:
    stamps = (-(2**62) + 1, -(2**62) + 2, 2**62 - 1)
    messages = [json.dumps({"stamp": s, "a": [1, 2, 3]}).encode() for s in stamps]
    block = MessageDecoder(STREAM, read(), 0).feed(RawBatch.of([(10, 0, 0, message) for message in messages]))
    assert (block.time_ns.tolist(), block.malformed) == ([10, 11], 1)
