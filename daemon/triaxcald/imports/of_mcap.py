"""MCAP files that others recorded, through a profile of the driver ``mcap``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.imports.importing import Imported, Importing, Record, Times, no_samples, write_recording

# Whose messages those of a topic are, where several publish on it: an MCAP file has
# a channel for each.

CHANNELS_SHOWN = 8  # channels in a message


@dataclass
class Channels:
    """Takes the messages of a profile's ``topics``, of one channel each.
    ``only`` is the one that the user asked for, which says nothing of other
    topics than its own."""

    topics: Collection[str]
    only: td.mcap.Channel | None = None
    elsewhere: int = 0  # messages of other channels of its topic
    _seen: Counter[td.mcap.Channel] = field(default_factory=Counter)
    _latest: dict[str, int] = field(default_factory=dict)  # channel by topic
    _mixed: set[str] = field(default_factory=set)  # topics

    def takes(self, channel: td.mcap.Channel) -> bool:
        topic, number = channel.topic, channel.number
        if self.only is not None and topic == self.only.topic and number != self.only.number:
            self.elsewhere += 1
            return False
        if self._latest.get(topic) != number:
            if channel in self._seen:
                self._mixed.add(topic)
            self._latest[topic] = number
        self._seen[channel] += 1
        return True

    def settle(self, name: str) -> bool:
        """Whether a topic's messages come on one channel after another, once
        all have been seen, as where a publisher is started anew. Raises
        InputError where they come on several in turn."""
        if self._mixed:
            topic = min(self._mixed)
            its = listed((channel, count) for channel, count in self._seen.items() if channel.topic == topic)
            raise InputError(
                f"{name}: topic '{td.hints.clipped(topic)}' comes on the channels {its}; --channel says which "
                "is the unit's"
            )
        return len(self._seen) > len(self._latest)


def listed(counted: Iterable[tuple[td.mcap.Channel, int]]) -> str:
    """Channels by number, each with what its publisher says of itself and no
    other does, and how many messages it has."""
    counts = list(counted)
    common = set.intersection(*(set(channel.metadata) for channel, _ in counts)) if counts else set()
    shown = []
    for channel, count in counts[:CHANNELS_SHOWN]:
        own = [
            f"{td.hints.clipped(key)} {td.hints.clipped(value)}"
            for key, value in channel.metadata
            if (key, value) not in common
        ]
        shown.append(f"{channel.number} ({', '.join([*own[:1], tc.number_format.number_of(count, 'message')])})")
    return ", ".join(shown) + (", …" if len(counts) > CHANNELS_SHOWN else "")


MESSAGE_MOST = 65535  # bytes of a raw record
STAMPS_LOOKED_AT = 10_000  # messages by whose stamps it is told whether they move
SHOWN = 12  # topics in a message


def import_mcap(log: td.logs.Log, bundle: td.Bundle, out: Path, *, channel: str | None = None) -> Imported:
    """Raises InputError, RecordingError, LogError, ProfileError."""
    whole, work, still = work_on(log, bundle, channel=channel)

    def describe(importing: Importing) -> dict[str, Any]:
        return work.described(importing, still)

    detail, seconds = write_recording(out, whole, work.records(), Path(log.name), describe)
    return Imported(out, detail, seconds)


def work_on(log: td.logs.Log, bundle: td.Bundle, *, channel: str | None) -> tuple[td.Bundle, Work, bool]:
    """For one log: the bundle with the definitions of its messages, the work, and
    whether the messages' own stamps stand still. Raises InputError, ProfileError."""
    profile = cast(td.mcap.McapProfile, bundle.profile)
    only = None if channel is None else _asked_for(log, profile, channel)
    schemas = _schemas(log, profile, only)
    files = {td.mcap.schema_file(name): schema.to_bytes() for name, schema in schemas.items()}
    still = any(schema.stamp_stands_still for schema in schemas.values())
    return replace(bundle, files={**bundle.files, **files}), Work(profile, log, only), still


def _asked_for(log: td.logs.Log, profile: td.mcap.McapProfile, number: str) -> td.mcap.Channel:
    """The channel of that number. Raises InputError where none of the profile's
    topics has it."""
    topics = {stream.topic for stream in profile.streams.values()}
    channels = (message.channel for message in td.mcap.McapFile(log.stream, td.logs.Account()).messages())
    counted = Counter(channel for channel in channels if channel.topic in topics)
    for channel in counted:
        if str(channel.number) == number:
            return channel
    there = listed(counted.items()) or "no message of the profile's topics"
    raise InputError(f"--channel {number}: {log.name} has {there}")


def _schemas(
    log: td.logs.Log, profile: td.mcap.McapProfile, only: td.mcap.Channel | None
) -> dict[str, td.mcap.MessageSchema]:
    """Of each stream whose topic is there, from the log's first messages.
    Raises InputError."""
    file = td.mcap.McapFile(log.stream, td.logs.Account())
    first: dict[str, td.mcap.LoggedMessage] = {}
    heads: dict[str, list[bytes]] = {}
    topics = {stream.topic for stream in profile.streams.values()}
    chosen = Channels(topics, only)
    for message in file.messages():
        topic = message.channel.topic
        if topic not in topics or not chosen.takes(message.channel):
            continue
        first.setdefault(topic, message)
        heads.setdefault(topic, [])
        if len(heads[topic]) < STAMPS_LOOKED_AT and len(message.data) <= MESSAGE_MOST:
            heads[topic].append(message.data)
        if len(heads) == len(topics) and all(len(head) == STAMPS_LOOKED_AT for head in heads.values()):
            break
    found = {}
    for name, stream in profile.streams.items():
        if stream.topic in first:
            schema = _schema(first[stream.topic].channel, log.name)
            found[name] = replace(schema, stamp_stands_still=_stands_still(profile, name, schema, heads[stream.topic]))
        elif name == "readings":
            there = list(file.topics)
            shown = ", ".join(map(td.hints.clipped, there[:SHOWN])) or "none"
            hint = td.hints.nearest(stream.topic, there) or f"; there are {shown}"
            raise InputError(f"{log.name}: no message on topic '{stream.topic}'{hint}")
    return found


def _schema(channel: td.mcap.Channel, name: str) -> td.mcap.MessageSchema:
    schema = channel.schema
    if schema is None and channel.encoding != "json":
        raise InputError(
            f"{name}: topic '{td.hints.clipped(channel.topic)}' has no schema, and is encoded as {channel.encoding}"
        )
    if schema is None:
        return td.mcap.MessageSchema("", channel.encoding, "", b"")
    return td.mcap.MessageSchema(schema.name, channel.encoding, schema.encoding, schema.data)


def _stands_still(profile: td.mcap.McapProfile, name: str, schema: td.mcap.MessageSchema, head: list[bytes]) -> bool:
    """Raises ProfileError where the messages do not hold what the profile
    names."""
    read = td.mcap.stream_reader(profile, name, schema)
    if profile.streams[name].time is None:
        return False
    stamps = set()
    for data in head:
        try:
            stamps.add(read(data)[1])
        except (ValueError, OverflowError):
            continue
        if len(stamps) > 1:
            return False
    return len(head) > 1


class Work:
    """One log on its way into raw records, and what is counted of it."""

    def __init__(self, profile: td.mcap.McapProfile, log: td.logs.Log, only: td.mcap.Channel | None) -> None:
        self._profile, self._log = profile, log
        self.account = td.logs.Account()
        self._times = Times(1e9 / profile.sampling.rate_hz)
        self._numbers = {stream.topic: i for i, stream in enumerate(profile.streams.values())}
        self._readings = list(profile.streams).index(td.READINGS)
        self.channels = Channels(self._numbers, only)
        self._first: dict[str, td.mcap.Channel] = {}  # by topic
        self._messages = self._taken = self._others = 0

    def records(self) -> Iterator[Record]:
        """Raises LogError."""
        for message in td.mcap.McapFile(self._log.stream, self.account).messages():
            self._messages += 1
            topic = message.channel.topic
            if topic not in self._numbers:
                self._others += 1
                continue
            if not self.channels.takes(message.channel):
                continue
            first = self._first.setdefault(topic, message.channel)
            if first.schema != message.channel.schema:
                says = "" if first.number == message.channel.number else "; --channel says which is the unit's"
                raise td.LogError(
                    f"{self._log.name}: topic '{td.hints.clipped(topic)}' has messages of two definitions, on "
                    "the channels"
                    f" {first.number} and {message.channel.number}{says}"
                )
            where = f"message {self._messages}"
            if len(message.data) > MESSAGE_MOST:
                self.account.note(where, f"{len(message.data)} bytes, expected at most {MESSAGE_MOST}")
            elif message.log_time_ns >= td.logs.LONGEST_NS:
                self.account.note(where, f"a time of {message.log_time_ns} ns")
            else:
                self._taken += 1
                if self._numbers[topic] == self._readings:
                    self._times.note(message.log_time_ns)
                yield message.log_time_ns, self._numbers[topic], 0, message.data

    def described(self, importing: Importing, still: bool) -> dict[str, Any]:
        """Raises InputError."""
        follow = self.channels.settle(self._log.name)
        counts = importing.counts
        if not counts["samples"]:
            why = ", ".join(no_samples(counts)) or "none is of the readings"
            raise InputError(
                f"{self._log.name}: no sample in its {tc.number_format.number_of(self._taken, 'message')} of "
                f"the profile: {why}"
            )
        return {
            "kind": td.logs.MCAP_KIND,
            "channels": list(self._numbers),
            "node": None,
            "frames": self._messages,
            "taken": self._taken,
            "error_frames": 0,
            "elsewhere": self.channels.elsewhere,
            "other_frames": self._others,
            "other_records": dict(self.account.others),
            "damaged": self.account.damaged,
            "damage": self.account.damage,
            "remarks": ["channels_follow"] * follow
            + ["stamp_stands_still"] * still
            + ["two_senders"] * importing.two_senders,
            "seconds_by_log": self._times.seconds,
            "times": importing.times.document(),
        }
