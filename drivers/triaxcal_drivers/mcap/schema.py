"""How a stream's messages are encoded, as the log said: the file beside the
profile in a recording."""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass

from triaxcal_drivers.errors import ProfileError

FORMAT = "triaxcal.messages/1"
DEFINITION_MOST = 256 * 2**10  # bytes; a sensor's message with all that it is made of has some ten thousand


@dataclass(frozen=True)
class MessageSchema:
    """``encoding`` of the messages (cdr, json, protobuf), ``language`` of their
    definition (ros2msg, ros2idl, protobuf, jsonschema). Where the
    ``stamp_stands_still``, it is no time."""

    name: str
    encoding: str
    language: str
    definition: bytes
    stamp_stands_still: bool = False

    def to_bytes(self) -> bytes:
        document = {
            "format": FORMAT,
            "name": self.name,
            "encoding": self.encoding,
            "language": self.language,
            "definition": base64.b64encode(self.definition).decode(),
            "stamp_stands_still": self.stamp_stands_still,
        }
        return (json.dumps(document, indent=1) + "\n").encode()

    @staticmethod
    def of(data: bytes, where: str) -> MessageSchema:
        """Raises ProfileError."""
        try:
            held = json.loads(data)
            if held["format"] != FORMAT:
                raise ValueError(held["format"])
            name, encoding, language = (held[key] for key in ("name", "encoding", "language"))
            if not all(isinstance(text, str) for text in (name, encoding, language)):
                raise TypeError("texts")
            definition = base64.b64decode(held["definition"], validate=True)
            return MessageSchema(name, encoding, language, definition, bool(held["stamp_stands_still"]))
        except (ValueError, KeyError, TypeError, RecursionError, binascii.Error) as e:
            raise ProfileError(f"{where}: expected a description of messages ({FORMAT})") from e
