"""Files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from triaxcald.errors import InputError


def write_text(path: Path, text: str) -> Path:
    """Through a temporary file beside it. Raises InputError, one line."""
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "w", encoding="utf-8") as f:
                f.write(text)
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e
    return path
