"""The golden recordings hold what is written today, byte for byte; mcap's own reader gets it out of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from mcap.reader import make_reader

from triaxcald.recording import schema
from triaxcald.recording.schema import decode_raw, encode_raw

RECORDINGS = sorted((Path(__file__).parents[3] / "recordings").glob("*.mcap"))
NAMES = [file.stem for file in RECORDINGS]
DECODERS = {
    schema.REGISTERS: schema.decode_register_access,
    schema.EVENTS: schema.decode_event,
    schema.LOSS: schema.decode_loss,
}


def messages(file: Path, *topics: str) -> Iterator[tuple[str, bytes]]:
    with file.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=topics):
            yield channel.topic, message.data


@pytest.mark.parametrize("file", RECORDINGS, ids=NAMES)
def test_raw_batches_are_written_as_they_are_stored(file: Path) -> None:
    stored = [data for _, data in messages(file, schema.RAW)]
    assert [encode_raw(*decode_raw(data)) for data in stored] == stored
    assert len(stored) > 100


@pytest.mark.parametrize("file", RECORDINGS, ids=NAMES)
def test_other_messages_are_written_as_they_are_stored(file: Path) -> None:
    stored = list(messages(file, *DECODERS))
    assert [(topic, schema.encode(DECODERS[topic](data))) for topic, data in stored] == stored
    assert {topic for topic, _ in stored} >= {schema.REGISTERS, schema.EVENTS}
