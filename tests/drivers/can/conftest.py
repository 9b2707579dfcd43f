from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.drivers.can.played import Played
from triaxcal_drivers.can import line as can_line
from triaxcal_drivers.can.driver import CanDecoder
from triaxcal_drivers.can.layout import stream_layout
from triaxcal_drivers.can.model import BusSettings, DbcStream, PdoStream
from triaxcal_drivers.catalogue import BUILT_IN, load_bundle, parse_bundle
from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcal_drivers.profile import Bundle

EDS = "triax-ref-can.eds"
PDO_CHANNELS: dict[str, Any] = {
    "ux": {"object": "0x2300:01", "scale": 10 / 2**23},
    "uy": {"object": "0x2300:02", "scale": 10 / 2**23},
    "uz": {"object": "0x2300:03", "scale": 10 / 2**23},
    "temp_c": {"object": "0x2300:05", "scale": 0.01},
    "status": "0x2300:06",
}


@pytest.fixture(scope="session")
def profiles() -> Path:
    return BUILT_IN


@pytest.fixture(scope="session")
def bundle() -> Bundle:
    return load_bundle(Path("triax-ref-can"))


@pytest.fixture(scope="session")
def edited(bundle: Bundle) -> Callable[..., Bundle]:
    """The reference profile with pieces of its text, or of its DBC, replaced."""

    def edit(*changes: tuple[str, str], dbc: Sequence[tuple[str, str]] = ()) -> Bundle:
        text, held = bundle.text.decode(), bundle.files["triax-ref-can.dbc"].decode()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        for old, new in dbc:
            assert old in held
            held = held.replace(old, new)
        return parse_bundle(text.encode(), {"triax-ref-can.dbc": held.encode()}, where="unit.toml")

    return edit


@pytest.fixture
def decoder(bundle: Bundle) -> CanDecoder:
    """Of the reference unit's readings, 100 samples a second."""
    stream = bundle.profile.streams["readings"]
    assert isinstance(stream, DbcStream)
    return CanDecoder(stream_layout(stream, bundle.files, where="test"), rate_hz=100.0)


@pytest.fixture
def pdo_decoder(profiles: Path) -> CanDecoder:
    stream = PdoStream(layout="pdo", eds=EDS, counter="0x2300:04", channels=PDO_CHANNELS)
    return CanDecoder(stream_layout(stream, {EDS: (profiles / EDS).read_bytes()}, where="test"), rate_hz=100.0)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Played]:
    """The adapters that were opened, in order."""
    made: list[Played] = []

    def open_bus(_: BusSettings) -> Played:
        made.append(Played())
        return made[-1]

    monkeypatch.setattr(can_line, "open_bus", open_bus)
    return made


COUNTS = ("missing", "duplicates", "incomplete", "errors", "malformed", "invalid")


def joined(blocks: Sequence[SampleBlock]) -> dict[str, Any]:
    """Everything that several blocks say, as one; for comparison."""
    channels: Mapping[str, Any] = {
        name: np.concatenate([b.channels[name] for b in blocks]).tolist() for name in blocks[0].channels
    }
    return {
        "time_ns": np.concatenate([b.time_ns for b in blocks]).tolist(),
        "counter": np.concatenate([b.counter for b in blocks]).tolist(),
        "readings": np.concatenate([b.readings for b in blocks]).tolist(),
        **channels,
        **{n: sum(getattr(b, n) for b in blocks) for n in COUNTS},
    }


@pytest.fixture(scope="session")
def decode_all() -> Callable[..., dict[str, Any]]:
    def decode(
        decoder: CanDecoder, records: Sequence[tuple[int, int, int, bytes]], cuts: Sequence[int] = ()
    ) -> dict[str, Any]:
        edges = [0, *sorted(cuts), len(records)]
        batches = [RawBatch.of(records[a:b]) for a, b in pairwise(edges)]
        return joined([decoder.feed(batch) for batch in batches])

    return decode
