"""The recordings of a document that was made from several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath

from triaxcald.report.figures import clean, number
from triaxcald.report.untrusted import mapping


@dataclass(frozen=True)
class OfRecording:
    """How well the magnitude comes out in the poses of one recording, rms in
    the unit of the reference."""

    name: str
    poses: float | None
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None


def file_names(paths: Sequence[str]) -> dict[str, str]:
    """What to call recordings, by path: by their files' names where these tell
    them apart."""
    names = [PurePath(path).name or path for path in paths]
    counts = Counter(names)
    return {path: clean(name if counts[name] == 1 else path) for path, name in zip(paths, names, strict=True)}


def by_recording(value: object, names: Mapping[str, str]) -> Iterator[OfRecording]:
    for known in map(mapping, value if isinstance(value, (list, tuple)) else ()):
        name = names.get(str(known.get("recording")), "")
        keys = ("poses", "before_rms_g", "after_rms_g", "noise_floor_g")
        yield OfRecording(name, *(number(known.get(key)) for key in keys))
