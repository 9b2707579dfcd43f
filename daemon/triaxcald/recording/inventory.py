"""What a recording holds, as digests: so that an outcome can name it, and an
audit can miss nothing. No I/O."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from typing import Any

Document = dict[str, Any]


class Inventory:
    """Grows with a recording, record by record, in the order of the file."""

    def __init__(self) -> None:
        self._attachments: list[Document] = []
        self._metadata: list[Document] = []
        self._topics: dict[str, tuple[int, hashlib._Hash]] = {}
        self._declared: dict[str, set[str]] = {}

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], kind: tuple[str, str, bytes]) -> None:
        """A topic as it is declared; ``kind`` is its schema's name, encoding
        and data. Each way counts once."""
        said = [topic, encoding, *(f"{key}\0{value}" for key, value in sorted(metadata.items())), *kind[:2]]
        text = "\0".join(said).encode() + b"\0" + kind[2]
        self._declared.setdefault(topic, set()).add(hashlib.sha256(text).hexdigest())

    def attachment(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        self._attachments.append(
            {"name": name, "media_type": media_type, "time_ns": time_ns, "sha256": hashlib.sha256(data).hexdigest()}
        )

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        text = "".join(f"{key}\0{value}\0" for key, value in sorted(record.items()))
        self._metadata.append({"name": name, "sha256": hashlib.sha256(text.encode()).hexdigest()})

    def message(self, topic: str, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        count, digest = self._topics.get(topic) or (0, hashlib.sha256())
        digest.update(struct.pack("<QQQ", log_time_ns, publish_time_ns, len(data)))
        digest.update(data)
        self._topics[topic] = count + 1, digest

    def document(self) -> Document:
        """Attachments in the order of the file, metadata by name, messages by
        topic."""
        topics = sorted(self._topics.items())
        return {
            "attachments": list(self._attachments),
            "metadata": sorted(self._metadata, key=lambda m: str(m["name"])),
            "topics": [
                {"name": name, "messages": n, "sha256": d.hexdigest(), "declared": self._declaration(name)}
                for name, (n, d) in topics
            ],
        }

    def _declaration(self, topic: str) -> str:
        return hashlib.sha256("".join(sorted(self._declared.get(topic, ()))).encode()).hexdigest()
