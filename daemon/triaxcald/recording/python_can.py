"""Recordings for python-can's own tools: `can_logger -f x.mcap`, `can_player
x.mcap`, `can_logconvert x.blf x.mcap`.

python-can imports this module whenever it looks for any format. What does the
work is imported when a recording is opened.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from can.io.generic import MessageReader, SizedMessageWriter

from triaxcald.errors import DaemonError

if TYPE_CHECKING:
    from can import Message

BATCH = 1024  # messages; what a batch costs by itself is little beside them
LATEST_S = 1.0  # so long a message waits for others at most


class RecordingMessageWriter(SizedMessageWriter):
    """Writes all messages that it is given into a new recording of a bus.

    As python-can's other writers do it, it waits where the disk is slow. Raises
    RecordingError: the file exists already, which no recording overwrites, or
    the disk has failed; ValueError where it is to ``append``, or ``file`` is
    no path.
    """

    def __init__(self, file: Any, append: bool = False, **_: Any) -> None:
        import can

        from triaxcald.recording.bus import FIELDS, batches_of, bus_record, row_of
        from triaxcald.recording.schema import BUS_RECORD
        from triaxcald.recording.writer import RecordingWriter

        if not isinstance(file, str | os.PathLike):
            raise ValueError(f"a recording is written to a path, not to {file!r}")
        path = Path(file)
        if append and path.exists():
            raise ValueError(f"{path}: a recording that exists is never changed, and cannot be appended to")
        by = f"python-can {can.__version__}"
        self._writer = RecordingWriter(
            path,
            metadata={BUS_RECORD: bus_record("", recorded_by=by)},
            preview_channels=None,
            waits=True,
            of_the_past=True,
        )
        self._row_of, self._batches_of, self._most = row_of, batches_of, BATCH * FIELDS
        self._held: deque[Any] = deque()
        self._order = threading.Lock()
        self._stopped = threading.Event()
        self._failure: Exception | None = None
        self._clock = threading.Thread(target=self._tick, name=f"messages for {path.name}", daemon=True)
        self._clock.start()

    def on_message_received(self, msg: Message) -> None:
        self._held.extend(self._row_of(msg))  # at once: the clock's thread never sees a part of a message
        if len(self._held) >= self._most:
            self._pass_on()

    def file_size(self) -> int:
        return self._writer.size

    def stop(self) -> None:
        self._stopped.set()
        self._clock.join()
        try:
            if not self._writer.closed:
                self._pass_on()
        finally:
            self._writer.close()

    def _tick(self) -> None:
        while not self._stopped.wait(LATEST_S) and self._failure is None:
            try:
                self._pass_on()
            except (DaemonError, ValueError, TypeError, ArithmeticError) as e:
                self._failure = e  # whoever gives the next message is told

    def _pass_on(self) -> None:
        with self._order:
            if self._failure is not None:
                raise self._failure
            values = [self._held.popleft() for _ in range(len(self._held))]
            for phase, batch in self._batches_of(values):
                self._writer.raw(phase, batch)


class RecordingMessageReader(MessageReader):
    """The frames of a recording of a bus, or of a unit on CAN. Raises
    RecordingError: damaged, not finished, or no recording."""

    def __init__(self, file: str | os.PathLike[str] | BinaryIO, **_: Any) -> None:
        from triaxcald.recording.reader import Recording

        if isinstance(file, str | os.PathLike):
            self._recording = Recording.open(Path(file))
        else:
            self._recording = Recording(file, str(getattr(file, "name", "recording")))

    def __iter__(self) -> Iterator[Message]:
        from triaxcald.recording.bus import messages_of

        return messages_of(self._recording)

    def stop(self) -> None:
        self._recording.close()
