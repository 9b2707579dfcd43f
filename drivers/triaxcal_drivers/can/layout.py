"""Layout of a stream's channels in its CAN messages, out of the DBC or EDS file that
the stream names. No I/O."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

from triaxcal_drivers.can.dbc import FRAME_MOST, dbc_messages
from triaxcal_drivers.can.eds import STANDARD_MOST, object_dictionary, pdo_messages
from triaxcal_drivers.can.message import Message, Selection, Signal, implied
from triaxcal_drivers.can.model import CanStream, DbcStream, Scaling
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import clipped, nearest

if TYPE_CHECKING:
    pass


NODES = 127
SHORTEST_COUNTER = 4
SHORTEST_STAMP = 8  # bits; a shorter one wraps within a few samples
_IDENTIFIER = re.compile("0[xX]([0-9A-Fa-f]{1,8})([xX]?)")


@dataclass(frozen=True)
class Layout:
    """A stream: its messages, the (message, signal) of each channel, and the
    counter in each message.

    The first ``sample`` messages make a sample, all where it is 0; channels of
    the others take the newest value that is no older than ``latest_s``, by
    channel. ``valid`` are (message, signal, values): the signals that have to
    hold one of the values. Where ``by_time``, messages that come within half a
    period are one sample; where there is a message ``begins``, those from one
    such message to the next. There a counter is in one message: ``count``.
    ``stamp`` is (message, signal, seconds of a count).
    """

    messages: tuple[Message, ...]
    channels: Mapping[str, tuple[int, Signal]]
    counters: tuple[Signal, ...] = ()
    valid: tuple[tuple[int, Signal, tuple[int, ...]], ...] = ()
    by_time: bool = False
    begins: int | None = None
    count: tuple[int, Signal] | None = None
    stamp: tuple[int, Signal, float] | None = None
    sample: int = 0
    latest_s: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample", self.sample or len(self.messages))

    @property
    def counter_bits(self) -> int:
        return self.counters[0].length if self.counters else 0

    def size(self, message: int) -> int:
        """Bytes that a message must have to hold what the stream takes of it."""
        signals = [s for m, s in self.channels.values() if m == message]
        signals += self.counters[message : message + 1]
        signals += [s for m, s, _ in self.valid if m == message]
        signals += [m_s[1] for m_s in (self.count, self.stamp) if m_s is not None and m_s[0] == message]
        signals += [selection.selector for selection in self.messages[message].selected]
        return max((s.size for s in signals), default=0)


def arrange(messages: Sequence[Message], stream: CanStream, *, where: str) -> Layout:
    """The layout of ``stream`` in a file's messages.

    A name that several messages hold is taken from one that another channel
    needs in any case. Raises ProfileError (one line: ``where``, the name, the
    nearest right one).
    """
    index = _Index(messages, getattr(stream, "base_node_id", None) or 0)
    wanted = stream.wanted()
    holders = {name: index.holders(w.reference, where) for name, w in wanted.items()}
    needed = {h[0][0] for name, h in holders.items() if len(h) == 1 and wanted[name].latest_s is None}
    chosen: dict[str, tuple[int, Signal]] = {}
    for name, w in wanted.items():
        m, signal = index.one_of(holders[name], needed, w.reference, where)
        chosen[name] = m, _scaled(signal, w.channel)
    # Frames of a sample: of its channels, its begin, its counter and its time stamp.
    parts = _Frames(messages)
    for name, (m, signal) in chosen.items():
        if wanted[name].latest_s is None:
            parts.need(m, signal)
    begins = index.message(stream.begins, where) if stream.begins else None
    if begins is not None:
        parts.need(begins)
    together = stream.together is not None
    once = {"counter": stream.counter} if together and stream.counter else {}
    if (stamp := stream.stamp()) is not None:
        once["time_stamp"] = stamp[0]
    found = {key: index.first_of(index.holders(name, where), parts.used, name, where) for key, name in once.items()}
    for m, signal in found.values():
        parts.need(m, signal)
    sample = parts.settle(where)
    if begins is not None and len(parts.places(begins)) > 1:
        names = ", ".join(f"'{sample[i].title}'" for i in parts.places(begins))
        raise ProfileError(f"{where}: together: which of {names} begins a sample cannot be told; name another message")
    # Frames beside it, which have the newest value of some channels.
    for m, signal in chosen.values():
        if parts.place(m, signal) is None:
            parts.need(m, signal)
    used = parts.settle(where)
    _check_identifiers([messages[m] for m in sorted(parts.used)], where)
    _check_lengths(used, where)
    channels = {name: (parts.place_of(m, signal), signal) for name, (m, signal) in chosen.items()}
    single = {key: (parts.place_of(m, signal), signal) for key, (m, signal) in found.items()}
    for key, (_, signal) in single.items():
        _check_count(signal, key, where)
    return Layout(
        used,
        channels,
        _counters(sample, None if together else stream.counter, together, where),
        _valid(index, parts, sample, stream.validity(), where),
        by_time=stream.together == "time",
        begins=None if begins is None else parts.place_of(begins),
        count=single.get("counter"),
        stamp=(*single["time_stamp"], stamp[1]) if stamp else None,
        sample=len(sample),
        latest_s={name: w.latest_s for name, w in wanted.items() if w.latest_s and channels[name][0] >= len(sample)},
    )


class _Frames:
    """Kinds of frames that a stream takes: messages, of a multiplexed one the frames
    that are selected. A signal that every frame has is taken from those that
    another signal needs in any case."""

    def __init__(self, messages: Sequence[Message]) -> None:
        self._messages = messages
        self._kinds: list[tuple[int, tuple[Selection, ...]]] = []  # number of the message, and which frames of it
        self._settled = 0

    @property
    def used(self) -> set[int]:
        """Numbers of the messages."""
        return {m for m, _ in self._kinds}

    def place(self, m: int, signal: Signal | None = None) -> int | None:
        """The first kind of frame with message ``m`` that holds the signal."""
        return next(iter(self.places(m, signal)), None)

    def places(self, m: int, signal: Signal | None = None) -> list[int]:
        """All such kinds of frame."""
        kinds = enumerate(self._kinds)
        return [i for i, (n, selected) in kinds if n == m and (signal is None or implied(signal, selected))]

    def place_of(self, m: int, signal: Signal | None = None) -> int:
        """The same where it has been needed."""
        found = self.place(m, signal)
        assert found is not None
        return found

    def need(self, m: int, signal: Signal | None = None) -> None:
        if self.place(m, signal) is not None:
            return
        selected = signal.selected if signal else ()
        for i, (n, wider) in enumerate(self._kinds[self._settled :], self._settled):
            if n == m and all(any(each.within(w) for each in selected) for w in wider):
                self._kinds[i] = m, selected
                return
        self._kinds.append((m, selected))

    def settle(self, where: str) -> tuple[Message, ...]:
        """All that were needed; those since the last call in the order of the file."""
        self._kinds[self._settled :] = sorted(self._kinds[self._settled :], key=lambda kind: kind[0])
        self._settled = len(self._kinds)
        used = tuple(replace(self._messages[m], selected=selected) for m, selected in self._kinds)
        for (a, (m, one)), (b, (n, other)) in combinations(enumerate(self._kinds), 2):
            if m == n and not any(x.apart_from(y) for x in one for y in other):
                names = " and ".join(f"'{used[i].title}'" for i in (a, b))
                raise ProfileError(f"{where}: {names} can be the same frame; take the channels from one of them")
        return used


class _Index:
    """Finds signals by name, in files of thousands of messages too. ``node_id``
    is the one for which the identifiers of the file are written."""

    def __init__(self, messages: Sequence[Message], node_id: int) -> None:
        self._messages, self._node_id = messages, node_id
        self._of: dict[str, list[int]] = {}  # numbers of the messages of that name
        self._with: dict[str, list[int]] = {}  # of those that hold a signal of that name
        self._unusable = [m for m in messages if m.fault]
        for i, m in enumerate(messages):
            if m.fault:
                continue
            self._of.setdefault(m.name, []).append(i)
            for name in m.signals:
                self._with.setdefault(name, []).append(i)

    def holders(self, reference: str, where: str) -> list[tuple[int, Signal]]:
        """Which messages hold the signal: ``Signal``, ``Message.Signal``, or
        ``Message@0x19.Signal`` where several have that name."""
        within, _, name = reference.rpartition(".")
        inside = self._named(within, where) if within else range(len(self._messages))
        found = [(i, self._messages[i].signals[name]) for i in self._with.get(name, []) if i in inside]
        if not found:
            at = f" in message '{within}'" if within else ""
            known = (s for i in inside for s in self._messages[i].signals if not self._messages[i].fault)
            raise ProfileError(f"{where}: no signal '{name}'{at}{self._why(name) or nearest(name, known)}")
        return found

    def one_of(
        self, holders: Sequence[tuple[int, Signal]], preferred: set[int], reference: str, where: str
    ) -> tuple[int, Signal]:
        """The only holder, or the only one among the ``preferred`` messages."""
        found = [h for h in holders if len(holders) == 1 or h[0] in preferred]
        if len(found) != 1:
            names = ", ".join(self.place(m) for m, _ in holders)
            raise ProfileError(f"{where}: '{reference}' is in several messages ({names}); name one of them")
        return found[0]

    def first_of(
        self, holders: Sequence[tuple[int, Signal]], preferred: set[int], reference: str, where: str
    ) -> tuple[int, Signal]:
        """The first holder among the ``preferred`` messages, or the only one."""
        found = [h for h in holders if h[0] in preferred]
        return found[0] if found else self.one_of(holders, preferred, reference, where)

    def message(self, name: str, where: str) -> int:
        """The message ``Message`` or ``Message@0x19``."""
        found = self._named(name, where)
        if len(found) != 1:
            raise ProfileError(
                f"{where}: there are several messages '{name}' ({', '.join(map(self.place, found))}); name one of them"
            )
        return found[0]

    def _why(self, name: str) -> str:
        """The fault of a message that holds the signal, else that of one of
        which nobody knows what it holds; empty without one."""
        holding = [m.fault for m in self._unusable if name in m.signals]
        return "".join(f": {fault}" for fault in (holding or [m.fault for m in self._unusable if not m.signals])[:1])

    def _named(self, within: str, where: str) -> Sequence[int]:
        """The messages ``Message`` or ``Message@0x19``."""
        name, at, identifier = within.partition("@")
        if name not in self._of:
            raise ProfileError(f"{where}: no message '{name}'{nearest(name, self._of)}")
        found = self._of[name]
        if not at:
            return found
        if not (wanted := _IDENTIFIER.fullmatch(identifier)):
            raise ProfileError(f"{where}: '{clipped(within)}': expected an identifier as in {name}@0x19")
        value, extended = int(wanted[1], 16), bool(wanted[2])
        held = [
            i
            for i in found
            if self._identifier(i) == value and (value > STANDARD_MOST or self._messages[i].extended == extended)
        ]
        if not held:
            places = ", ".join(map(self.place, found))
            raise ProfileError(f"{where}: no message '{clipped(within)}'; known: {places}")
        return held

    def _identifier(self, i: int) -> int:
        """Identifier of message ``i`` as in the file."""
        m = self._messages[i]
        return m.identifier + (self._node_id if m.per_node else 0)

    def place(self, i: int) -> str:
        """The message's name as a profile has to give it."""
        name = self._messages[i].name
        if len(self._of[name]) == 1:
            return name
        identifier = self._identifier(i)
        short = self._messages[i].extended and identifier <= STANDARD_MOST  # an x tells it from a standard one
        return f"{name}@0x{identifier:X}{'x' if short else ''}"


def _scaled(signal: Signal, scaling: Scaling) -> Signal:
    return replace(
        signal,
        scale=signal.scale if scaling.scale is None else scaling.scale,
        offset=signal.offset if scaling.offset is None else scaling.offset,
    )


def _valid(
    index: _Index,
    frames: _Frames,
    sample: Sequence[Message],
    validity: Sequence[tuple[str, tuple[int, ...]]],
    where: str,
) -> tuple[tuple[int, Signal, tuple[int, ...]], ...]:
    """The signals that say whether a sample is valid, by their message's place
    in the sample."""
    entries = []
    for name, values in validity:
        held = [(place, signal) for m, signal in index.holders(name, where) for place in frames.places(m, signal)]
        found = [(place, signal) for place, signal in held if place < len(sample)]
        if not found:
            names = ", ".join(m.title for m in sample)
            raise ProfileError(f"{where}: valid: '{name}' is in no message of the sample ({names})")
        for place, signal in found:
            if signal.is_float:
                raise ProfileError(f"{where}: valid: '{name}' is a float, expected a whole number")
            entries.append((place, signal, values))
    return tuple(entries)


def _counters(used: Sequence[Message], counter: str | None, together: bool, where: str) -> tuple[Signal, ...]:
    """The counter in each message of the sample."""
    if counter is None:
        if len(used) > 1 and not together:
            names = ", ".join(m.title for m in used)
            raise ProfileError(
                f"{where}: a sample made of several messages ({names}) needs a counter, together = "
                '{ begins = "…" } or together = "time"'
            )
        return ()
    for message in used:
        if counter not in message.signals or not implied(message.signals[counter], message.selected):
            hint = nearest(counter, message.signals)
            raise ProfileError(f"{where}: no signal '{counter}' (the counter) in message '{message.title}'{hint}")
    found = tuple(m.signals[counter] for m in used)
    widths = sorted({s.length for s in found})
    if len(widths) > 1 or widths[0] < SHORTEST_COUNTER or widths[0] > 32 or any(s.is_float for s in found):
        raise ProfileError(
            f"{where}: counter '{counter}' is {' and '.join(map(str, widths))} bits wide, "
            f"expected an integer of the same {SHORTEST_COUNTER} to 32 bits in every message"
        )
    return found


def _check_count(signal: Signal, key: str, where: str) -> None:
    """Of a counter or time stamp that one message of a sample bears."""
    most = 32 if key == "counter" else 64
    least = SHORTEST_COUNTER if key == "counter" else SHORTEST_STAMP
    if signal.is_float or not least <= signal.length <= most:
        kind = "float" if signal.is_float else "whole number"
        raise ProfileError(
            f"{where}: {key} '{signal.name}' is a {kind} of {signal.length} bits, expected an integer of {least} to "
            f"{most} bits"
        )


def _check_lengths(used: Sequence[Message], where: str) -> None:
    for message in used:
        if message.length > FRAME_MOST:
            raise ProfileError(
                f"{where}: message '{clipped(message.name)}' has {message.length} bytes, which J1939 sends in several "
                f"frames; expected one of a single frame, at most {FRAME_MOST} bytes"
            )


def _check_identifiers(used: Sequence[Message], where: str) -> None:
    """Identifiers that shift with the node must tell messages apart whichever
    node sends them."""
    for a, b in combinations([m for m in used if m.per_node], 2):
        if a.extended == b.extended and abs(a.identifier - b.identifier) < NODES:
            raise ProfileError(
                f"{where}: messages '{a.name}' and '{b.name}' are less than {NODES} identifiers apart; "
                "they cannot shift with the node"
            )


def stream_layout(stream: CanStream, files: Mapping[str, bytes], *, where: str) -> Layout:
    """The layout of a stream in the file it names. Raises ProfileError."""
    node_id = stream.base_node_id if isinstance(stream, DbcStream) else None
    messages = _messages(files[stream.file], isinstance(stream, DbcStream), node_id, stream.file)
    layout = arrange(messages, stream, where=f"{stream.file} ({where})")
    if isinstance(stream, DbcStream) and stream.j1939:
        for message in layout.messages:
            if not message.extended:
                raise ProfileError(
                    f"{stream.file} ({where}): message '{clipped(message.name)}' has an identifier of 11 bits, and "
                    "those of J1939 have 29"
                )
        groups = tuple(replace(m, j1939=True) for m in layout.messages)
        for a, b in combinations(groups, 2):
            if a.group == b.group and not any(x.apart_from(y) for x in a.selected for y in b.selected):
                raise ProfileError(
                    f"{stream.file} ({where}): messages '{clipped(a.name)}' and '{clipped(b.name)}' are of one PGN, "
                    "which J1939 does not tell apart; take the channels from one of them"
                )
        return replace(layout, messages=groups)
    return layout


@lru_cache(maxsize=4)
def _messages(data: bytes, dbc: bool, base_node_id: int | None, where: str) -> list[Message]:
    """A file is read once for all streams that it lays out, and once for all
    units of a station."""
    if dbc:
        return dbc_messages(data, base_node_id=base_node_id, where=where)
    return pdo_messages(object_dictionary(data, node_id=0, where=where))
