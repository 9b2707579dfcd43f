"""A short look at a device's readings and its corrected output at the same
moments."""

from __future__ import annotations

import asyncio
from contextlib import aclosing, closing, suppress
from typing import Any, cast

import numpy as np

from triaxcal_drivers.attention import Attention
from triaxcal_drivers.catalogue import driver_named
from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.interface import Device, SampleBlock
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcald.provision.corrected import departure_g, doubt_of_departure
from triaxcald.provision.plausible import Doubt
from triaxcald.provision.snapshot import Snapshot

SAMPLES = 20
"""Their median is not moved by a knock, and at the slowest usual rate they take
two seconds."""


async def doubts_of_live_output(device: Device, bundle: Bundle, snapshot: Snapshot) -> list[Doubt]:
    """None where the device has no corrected output, or where it does not come."""
    if CORRECTED not in bundle.profile.streams:
        return []
    blocks: dict[str, list[SampleBlock]] = {READINGS: [], CORRECTED: []}
    with suppress(DriverError, TimeoutError):
        await _collect(device, bundle, blocks)
    readings, outputs = (_joined(blocks[name]) for name in (READINGS, CORRECTED))
    _, mine, theirs = np.intersect1d(readings[0], outputs[0], return_indices=True)
    channels = {name: values[mine] for name, values in readings[2].items()}
    off_g = departure_g(bundle.profile, snapshot, readings[1][mine], outputs[1][theirs], channels)
    return doubt_of_departure(off_g)


async def _collect(device: Device, bundle: Bundle, blocks: dict[str, list[SampleBlock]]) -> None:
    driver, sampling = driver_named(bundle.profile.driver), bundle.profile.sampling
    decoders = {name: driver.decoder(bundle, name) for name in blocks}
    # So long even if one of the two never comes.
    limit_s = sampling.silence_timeout_s + 2 * SAMPLES / sampling.rate_hz
    with closing(Attention(asyncio.get_running_loop())) as attention:
        async with attention.timeout(limit_s), aclosing(cast(Any, device.stream(list(blocks)))) as stream:
            async for batch in stream:
                for name, decoder in decoders.items():
                    blocks[name].append(decoder.feed(batch))
                if min(sum(map(len, held)) for held in blocks.values()) >= SAMPLES:
                    return


def _joined(blocks: list[SampleBlock]) -> tuple[Any, Any, dict[str, Any]]:
    """Counters (n,), readings (n,3) and channels of all blocks."""
    if not blocks:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), {}
    channels = {name: np.concatenate([b.channels[name] for b in blocks]) for name in blocks[0].channels}
    return np.concatenate([b.counter for b in blocks]), np.concatenate([b.readings for b in blocks]), channels
