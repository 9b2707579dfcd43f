"""What a person with the `mcap` library can make of a recording, every checksum of the file right."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from triaxcald.documents import to_text
from triaxcald.recording.manifest import Inventory

OUTCOME, END = "outcome.json", "end"
AFTER_THE_END = ("raw", END, "recovery")


@dataclass
class Forgery:
    """A recording's records in their order, to be changed at will and written anew."""

    profile: str
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    records: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, source: Path) -> Forgery:
        with open(source, "rb") as file:
            found = cls(make_reader(file).get_header().profile)
        with open(source, "rb") as file:
            for record in StreamReader(file).records:
                if isinstance(record, Schema):
                    found.schemas[record.id] = record
                elif isinstance(record, Channel):
                    found.channels[record.id] = record
                elif isinstance(record, Attachment | Metadata | Message):
                    found.records.append(record)
        return found

    def copied(self) -> Forgery:
        """To be changed while this one stays. The messages, which are thousands, are the same: they are replaced,
        never changed."""
        records = [r if isinstance(r, Message) else deepcopy(r) for r in self.records]
        return Forgery(self.profile, deepcopy(self.schemas), deepcopy(self.channels), records)

    def write(self, out: Path, spoil: Callable[[Any], object] = lambda _: None, **options: Any) -> Path:
        """``options`` are mcap's writer's; ``spoil`` gets the writer before it writes its indices."""
        with open(out, "wb") as sink:
            writer = Writer(sink, **{"enable_data_crcs": True, **options})
            writer.start(profile=self.profile)
            for schema in self.schemas.values():
                writer.register_schema(schema.name, schema.encoding, schema.data)
            for c in self.channels.values():
                writer.register_channel(c.topic, c.message_encoding, c.schema_id, c.metadata)
            for r in self.records:
                if isinstance(r, Attachment):
                    writer.add_attachment(r.create_time, r.log_time, r.name, r.media_type, r.data)
                elif isinstance(r, Metadata):
                    writer.add_metadata(r.name, r.metadata)
                else:
                    writer.add_message(r.channel_id, r.log_time, r.data, r.publish_time, r.sequence)
            spoil(writer)
            writer.finish()
        return out

    # Parts.

    def attachment(self, name: str) -> Attachment:
        return next(r for r in self.records if isinstance(r, Attachment) and r.name == name)

    def metadata(self, name: str) -> Metadata:
        return next(r for r in self.records if isinstance(r, Metadata) and r.name == name)

    def drop(self, *names: str) -> None:
        """Attachments and metadata records."""
        held = (Attachment, Metadata)
        self.records = [r for r in self.records if not (isinstance(r, held) and r.name in names)]

    def messages(self, topic: str) -> Iterator[Message]:
        ids = {c.id for c in self.channels.values() if c.topic == topic}
        return (r for r in self.records if isinstance(r, Message) and r.channel_id in ids)

    def each(self, topic: str, change: Callable[[Message], Message | None]) -> None:
        """Of the messages of a topic; None takes one out."""
        chosen = {id(m) for m in self.messages(topic)}
        changed = [change(r) if id(r) in chosen else r for r in self.records]
        self.records = [r for r in changed if r is not None]

    def first(self, topic: str, change: Callable[[Message], Message | None]) -> None:
        one = id(next(self.messages(topic)))
        self.each(topic, lambda m: change(m) if id(m) == one else m)

    def edit(self, name: str, change: Callable[[Any], object]) -> None:
        """A JSON attachment."""
        document = json.loads(self.attachment(name).data)
        change(document)
        self.put(name, to_text(document).encode())

    def put(self, name: str, data: bytes) -> None:
        self.attachment(name).data = data

    # What a more careful forger does afterwards.

    def seal(self) -> None:
        """The outcome's inventory and the digest of its end, as they would be of the records that there are now."""
        inventory = Inventory()
        for c in self.channels.values():
            kind = self.schemas[c.schema_id]
            inventory.channel(c.topic, c.message_encoding, c.metadata, (kind.name, kind.encoding, kind.data))
        topics = {c.id: c.topic for c in self.channels.values()}
        for r in self.records:
            if isinstance(r, Attachment) and r.name != OUTCOME:
                inventory.attachment(r.name, r.media_type, r.log_time, r.data)
            elif isinstance(r, Metadata) and r.name not in AFTER_THE_END:
                inventory.metadata(r.name, r.metadata)
            elif isinstance(r, Message):
                inventory.message(topics[r.channel_id], r.log_time, r.publish_time, r.data)
        self.edit(OUTCOME, lambda o: o.update(contents=inventory.document()))
        self.end()

    def end(self) -> None:
        digest = hashlib.sha256(self.attachment(OUTCOME).data).hexdigest()
        self.metadata(END).metadata = {"name": OUTCOME, "sha256": digest}


def at(time_ns: int) -> Callable[[Message], Message]:
    """The message so much later, its content the same."""
    return lambda m: replace(m, log_time=m.log_time + time_ns, publish_time=m.publish_time + time_ns)
