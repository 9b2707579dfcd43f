"""A receiver of results on the loopback that answers as it is told."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass
class Got:
    """A request that came."""

    headers: dict[str, str]
    data: bytes

    @property
    def document(self) -> dict[str, Any]:
        return dict(json.loads(self.data))

    @property
    def run(self) -> str:
        return str(self.document["run"])


@dataclass
class Answer:
    """``body`` is sent after the headers; ``held`` keeps it back until it is set, ``silent`` all of the answer."""

    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""
    held: threading.Event | None = None
    silent: bool = False


class HttpReceiver:
    """Gives the ``answers`` in turn, then 200. ``port`` is free for another that is started at it later."""

    def __init__(self, *answers: Answer | int) -> None:
        self._answers: Iterator[Answer] = iter([Answer(a) if isinstance(a, int) else a for a in answers])
        self.got: list[Got] = []
        self._changed = threading.Condition()
        self._server: ThreadingHTTPServer | None = None
        self.port = 0

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/results"

    def wait(self, count: int) -> None:
        """Until so many requests came."""
        with self._changed:
            assert self._changed.wait_for(lambda: len(self.got) >= count, timeout=180)

    @contextmanager
    def listening(self) -> Iterator[HttpReceiver]:
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                data = self.rfile.read(int(self.headers["Content-Length"]))
                answer = next(receiver._answers, Answer())
                with receiver._changed:
                    receiver.got.append(Got({k.lower(): v for k, v in self.headers.items()}, data))
                    receiver._changed.notify_all()
                if answer.silent and answer.held is not None:
                    answer.held.wait(60)
                self.close_connection = True
                try:
                    self.send_response(answer.status)
                    for name, value in answer.headers.items():
                        self.send_header(name, value)
                    self.send_header("Content-Length", str(len(answer.body) + (answer.held is not None)))
                    self.end_headers()
                    self.wfile.write(answer.body)
                    self.wfile.flush()
                    if answer.held is not None:
                        answer.held.wait(60)
                except OSError:
                    pass  # the sender is gone

            def log_message(self, format: str, *args: object) -> None:
                pass

        server = ThreadingHTTPServer(("127.0.0.1", self.port), Handler)
        server.daemon_threads = True
        self.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            server.shutdown()
            server.server_close()
            thread.join()
