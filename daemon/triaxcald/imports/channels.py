"""Whose messages those of a topic are, where several publish on it: an MCAP file
has a channel for each."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

import triaxcal as tc
from triaxcal_drivers.hints import clipped
from triaxcal_drivers.mcap.container import Channel
from triaxcald.errors import InputError

SHOWN = 8  # channels in a message


@dataclass
class Channels:
    """Takes the messages of a profile's ``topics``, of one channel each.
    ``only`` is the one that the user asked for, which says nothing of other
    topics than its own."""

    topics: Collection[str]
    only: Channel | None = None
    elsewhere: int = 0  # messages of other channels of its topic
    _seen: Counter[Channel] = field(default_factory=Counter)
    _latest: dict[str, int] = field(default_factory=dict)  # channel by topic
    _mixed: set[str] = field(default_factory=set)  # topics

    def takes(self, channel: Channel) -> bool:
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
                f"{name}: topic '{clipped(topic)}' comes on the channels {its}; --channel says which is the unit's"
            )
        return len(self._seen) > len(self._latest)


def listed(counted: Iterable[tuple[Channel, int]]) -> str:
    """Channels by number, each with what its publisher says of itself and no
    other does, and how many messages it has."""
    counts = list(counted)
    common = set.intersection(*(set(channel.metadata) for channel, _ in counts)) if counts else set()
    shown = []
    for channel, count in counts[:SHOWN]:
        own = [f"{clipped(key)} {clipped(value)}" for key, value in channel.metadata if (key, value) not in common]
        shown.append(f"{channel.number} ({', '.join([*own[:1], tc.number_format.number_of(count, 'message')])})")
    return ", ".join(shown) + (", …" if len(counts) > SHOWN else "")
