"""A few hundred of the devices that `benchmarks.faulty_devices` draws."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.faulty_devices import results_of


@pytest.mark.slow
@pytest.mark.parametrize("hundred", range(4))
async def test_nothing_false_is_said_of_devices_and_lines_with_random_faults(tmp_path: Path, hundred: int) -> None:
    for seed in range(100 * hundred, 100 * (hundred + 1)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        assert not [result for result in await results_of(seed, folder) if result.false]
