"""Messages to samples: one each, in the order in which they were logged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from triaxcal_drivers.interface import RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.logs.times import LONGEST_NS
from triaxcal_drivers.mcap.fields import Read
from triaxcal_drivers.mcap.model import READING_CHANNELS, MessageStream


class MessageDecoder:
    """Decodes one stream.

    **Time.** That at which the first message was logged, plus the time that has
    gone by since on its own stamp; where there is none, the time of logging.

    Records of the other streams are passed over: ``source`` is the number of
    the stream in the profile. A message that is not as it is defined counts as
    malformed.
    """

    def __init__(self, stream: MessageStream, read: Read, source: int) -> None:
        self._read, self._source = read, source
        self._names = tuple(stream.channels)
        self._scale = np.array([c.scale for c in stream.channels.values()])
        self._offset = np.array([c.offset for c in stream.channels.values()])
        self._count = 0
        self._origin_ns: int | None = None  # on the host's clock, less that of the stamp

    def feed(self, batch: RawBatch) -> SampleBlock:
        times: list[int] = []
        rows: list[list[float]] = []
        errors = malformed = at = 0
        bad = int(RawFlag.ERROR | RawFlag.INVALID)
        columns: Any = zip(
            batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist(), batch.length.tolist(), strict=True
        )
        for time_ns, source, flags, length in columns:
            data, at = batch.payload[at : at + length], at + length
            if flags & bad:
                errors += 1
            elif source == self._source:
                try:
                    found, stamp_ns = self._read(data)
                    times.append(self._time_ns(time_ns, stamp_ns))
                except ValueError:
                    malformed += 1
                    continue
                rows.append(found)
        return replace(self._block(times, rows), errors=errors, malformed=malformed)

    def _time_ns(self, logged_ns: int, stamp_ns: int | None) -> int:
        """Raises ValueError where the stamps are too far apart."""
        if stamp_ns is None:
            return logged_ns
        if self._origin_ns is None:
            self._origin_ns = logged_ns - stamp_ns
        time_ns = self._origin_ns + stamp_ns
        if not -LONGEST_NS < time_ns < LONGEST_NS:
            raise ValueError("a time beyond all measure")
        return time_ns

    def _block(self, times: list[int], rows: list[list[float]]) -> SampleBlock:
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(self._names)) * self._scale + self._offset
        counter = self._count + np.arange(len(rows))
        self._count += len(rows)
        columns = [self._names.index(name) for name in READING_CHANNELS]
        auxiliary = {n: values[:, i] for i, n in enumerate(self._names) if n not in READING_CHANNELS}
        return SampleBlock(np.array(times, dtype=np.int64), counter, values[:, columns], auxiliary)
