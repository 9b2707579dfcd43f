"""How fast the channels of a recording go, and how late they are."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.poses.covariates import InStream, followed

T = np.arange(0.0, 120.0, 0.01)


def in_stream(values: np.ndarray, *wanted: str) -> dict[str, np.ndarray]:
    return InStream.of([(T, {"temp_c": values})], wanted, 4.0).at(T)


def test_a_straight_channel_has_one_rate_at_all_times() -> None:
    rate = in_stream(20 + 0.03 * T, "temp_c.rate")["temp_c.rate"]
    assert rate == pytest.approx(np.full(len(T), 0.03), abs=1e-9)


def test_noise_of_the_channel_is_averaged_over_the_time_of_a_pose() -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, len(T))
    rate = in_stream(20 + 0.03 * T + noise, "temp_c.rate")["temp_c.rate"]
    of_a_line = 0.05 / np.sqrt(400) / (4 / np.sqrt(12))  # 4 s of 100 Hz
    assert np.std(rate[1000:-1000]) == pytest.approx(of_a_line, rel=0.3)


def test_a_lag_of_a_ramp_becomes_the_time_constant_times_its_rate() -> None:
    lag = in_stream(20 + 0.03 * T, "temp_c.lag:10")["temp_c.lag:10"]
    assert lag[-1] == pytest.approx(-0.3, rel=1e-3)
    assert lag[1000] == pytest.approx(-0.3 * -np.expm1(-1.0), rel=0.03)


def test_what_no_channel_here_shows_is_left_out() -> None:
    assert in_stream(T, "before_x", "supply_v.rate") == {}
    alone = InStream.of([(T[:1], {"temp_c": T[:1]})], ["temp_c.rate", "temp_c.lag:10"], 4.0)
    assert alone.at(T[:1]) == {}
    assert [followed(n) for n in ("temp_c.rate", "temp_c.lag:10", "temp_c")] == ["temp_c", "temp_c", ""]


def test_a_recording_in_pieces_shows_what_it_shows_as_a_whole_weeks_after_its_start() -> None:
    values, wanted = 20 + np.sin(T / 20), ("temp_c.rate", "temp_c.lag:10")
    whole = in_stream(values, *wanted)
    late = T + 3e6
    pieces = [(late[at : at + 700], {"temp_c": values[at : at + 700]}) for at in range(0, len(T), 700)]
    found = InStream.of(pieces, wanted, 4.0).at(late)
    for name in wanted:
        assert found[name] == pytest.approx(whole[name], abs=2e-3 * np.abs(whole[name]).max())
