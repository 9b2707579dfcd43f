"""Files written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from triaxcald.errors import InputError


def write_text(path: Path, text: str) -> Path:
    """Through a temporary file beside it; what exists and is no file (a pipe, /dev/null) is written to as it is.

    Raises InputError, one line.
    """
    try:
        if path.exists() and not path.is_file():
            with open(path, "w", encoding="utf-8") as f:
                f.write(text)
        else:
            _replace(path.resolve(), text)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e
    return path


def _replace(path: Path, text: str) -> None:
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as f:
            f.write(text)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
