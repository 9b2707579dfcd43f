"""Samples from arrays, or from a DataFrame of pandas or polars; neither package is
needed."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.errors import InvalidData, MissingChannel
from triaxcal.model.samples import Samples
from triaxcal.poses.arrivals import RATE_SAMPLES

UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "µs": 1_000, "ns": 1}
"""Nanoseconds in a unit of time (SI prefixes)."""
TIME_COLUMN, OUTPUTS = "t_s", ("ux", "uy", "uz")
NO_ROLES = frozenset(
    ("x", "y", "z", "ax", "ay", "az", "u_x", "u_y", "u_z", "acc_x", "acc_y", "acc_z", "time", "timestamp", "time_s")
)
"""Names that mean time or outputs, and would count as channels."""
_UNIT_IN_NAME = re.compile(
    r"(?:^|[^a-z])(ms|msecs?|millis\w*|[uµ]s|usecs?|micros\w*|ns|nsecs?|nanos\w*)[^a-z]*$", re.IGNORECASE
)
SECONDS_MOST = 9.2e9
"""The largest time in seconds that 64 bits of nanoseconds hold, from 1970 or from the
first sample."""


def is_table(value: object) -> bool:
    """Whether a value has named columns, as a DataFrame has. Raises InvalidData for a
    lazy one."""
    if hasattr(value, "collect") and not hasattr(value, "__len__"):
        raise InvalidData("a lazy table: collect it first")
    return hasattr(value, "columns") and hasattr(value, "__getitem__") and not isinstance(value, np.ndarray)


def names_of(table: Any) -> list[str]:
    """The names of the columns. Raises InvalidData for equal ones."""
    names = [str(name) for name in _keys(table)]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InvalidData(f"the table has two columns {twice}")
    return names


def column(table: Any, name: str) -> Any:
    """The column of that name, or the index, as an array (n,). Raises InvalidData if
    there is none."""
    if name not in names_of(table):
        if str(getattr(getattr(table, "index", None), "name", "")) == name:
            return np.asarray(table.index)
        raise InvalidData(
            f"the table has no column {name}; it has {', '.join(names_of(table))}"
            + ("; say by columns how it is called" if name in (TIME_COLUMN, *OUTPUTS) else "")
        )
    return np.asarray(table[next(key for key in _keys(table) if str(key) == name)])


def _keys(table: Any) -> Iterable[Any]:
    """The keys of the columns. An Arrow table has other ``columns``, their values."""
    return table.column_names if hasattr(table, "column_names") else table.columns  # type: ignore[no-any-return]


def called(columns: Mapping[str, str] | None) -> dict[str, str]:
    """The table's names of t_s, ux, uy, uz and of the channels in ``columns``, by our
    names. Raises InvalidData for a name in `NO_ROLES`."""
    if unknown := next((ours for ours in columns or {} if ours in NO_ROLES), None):
        raise InvalidData(f"columns: {unknown} is no role; expected t, ux, uy, uz, or the name a channel is to have")
    return {name: name for name in (TIME_COLUMN, *OUTPUTS)} | {
        TIME_COLUMN if ours == "t" else ours: theirs for ours, theirs in (columns or {}).items()
    }


SLOW_S = 1.0
"""Interval of samples that is too long for still poses: such times are probably
milliseconds of a fast logger."""


def samples_of_table(table: Any, columns: Mapping[str, str] | None = None, time_unit: str | None = None) -> Samples:
    """The samples of a table with the columns t_s, ux, uy, uz; ``columns`` gives other
    names. All other columns of finite numbers are channels with their own names,
    except row numbers. Raises InvalidData."""
    by_ours = called(columns)
    # The channels with a given name, then all others.
    channels = {ours: column(table, theirs) for ours, theirs in by_ours.items() if ours not in (TIME_COLUMN, *OUTPUTS)}
    for name in names_of(table):
        values = column(table, name)
        if name in by_ours.values() or values.dtype.kind not in "fiu":
            continue
        if _counts(values):
            warnings.warn(f"column {name} left out: it numbers the rows", MissingChannel, stacklevel=4)
        elif np.isfinite(values).all():
            channels[name] = values
        else:
            gaps = int(np.count_nonzero(~np.isfinite(values)))
            warnings.warn(
                f"channel {name} left out: {gaps} of {len(values)} values missing", MissingChannel, stacklevel=4
            )
    # The outputs, and the times from a column or from the index.
    u = np.stack([_numbers(column(table, by_ours[name]), by_ours[name]) for name in OUTPUTS], axis=1)
    name = by_ours[TIME_COLUMN]
    index = np.asarray(table.index) if name not in names_of(table) and hasattr(table, "index") else np.empty(0)
    if name == TIME_COLUMN and index.dtype.kind in "Mm":  # the times label the rows
        return samples_of(index, u, channels, time_unit, "the index")
    return samples_of(column(table, name), u, channels, time_unit, name)


def _counts(values: Any) -> bool:
    """Whether each value is the previous one plus 1: such a channel would repeat the
    time."""
    return len(values) > 2 and bool((np.diff(values) == 1).all())


def samples_of(
    t: Any, u: Any, channels: Mapping[str, Any] | None = None, time_unit: str | None = None, name: str = "t"
) -> Samples:
    """The samples of arrays.

    ``t`` (n,) has floats in seconds or in ``time_unit``, datetimes, or integers with a
    ``time_unit``. Floats that would be `SLOW_S` apart need a unit, too. ``u`` (n,3) is
    in output units; ``channels`` (n,) each. Raises InvalidData."""
    readings = readings_of(u)
    if readings.ndim != 2:
        raise InvalidData(f"u: expected shape (n, 3), one row a sample, not {readings.shape}")
    time_ns = _time_ns(t, time_unit, name)
    if len(time_ns) != len(readings):
        raise InvalidData(f"{name} has {len(time_ns)} times, and u has {len(readings)} samples")
    if channels is not None and not isinstance(channels, Mapping):
        raise InvalidData("channels: expected values by name, as in {'temp_c': temperature}")
    found = {n: channel_of_samples(n, v, len(readings)) for n, v in (channels or {}).items()}
    for channel, values in found.items():
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise InvalidData(f"channel {channel}: value {row} is not a finite number")
    step_s = float(np.median(np.diff(time_ns))) * 1e-9 if len(time_ns) > 1 else 0.0
    if time_unit is None and np.asarray(t).dtype.kind == "f" and step_s >= SLOW_S and len(time_ns) >= RATE_SAMPLES:
        raise InvalidData(
            f"{name}: floats count as seconds, and these are {step_s:g} apart: say their unit by time_unit, one of s, "
            "ms, us, ns"
        )
    return Samples(time_ns, readings, found)


def readings_of(u: Any) -> Floats:
    """Readings (3,) or (n,3) as floats, from an array or from the columns ux, uy, uz of
    a table. Raises InvalidData."""
    if is_table(u) and set(OUTPUTS) <= set(names_of(u)):
        u = np.stack([np.asarray(column(u, name)) for name in OUTPUTS], axis=1)
    readings = _numbers(u, "u")
    if readings.ndim not in (1, 2) or readings.shape[-1] != 3:
        hint = "; transpose it" if readings.ndim == 2 and readings.shape[0] == 3 else ""
        raise InvalidData(f"u: expected shape (n, 3) or (3,), not {readings.shape}{hint}")
    return readings


def channel_of_samples(name: str, values: Any, n: int) -> Floats:
    """A channel (n,) from one number or (n,). Raises InvalidData."""
    found = _numbers(values, f"channel {name}")
    if values is None or found.shape not in ((), (n,)):
        raise InvalidData(f"channel {name}: expected one number or {n}, not shape {found.shape}")
    return np.broadcast_to(found, (n,))


def like(table: Any, columns: Mapping[str, Floats]) -> Any:
    """A DataFrame of the table's library with these columns and the table's index."""
    kind = type(table)
    found = kind.from_pydict(dict(columns)) if hasattr(kind, "from_pydict") else kind(dict(columns))
    if hasattr(table, "index") and hasattr(found, "index"):
        found.index = table.index
    return found


def seconds(t: Any, time_unit: str | None = None) -> Floats:
    """Times (n,) in seconds from those that `samples_of` accepts, without a shift.
    Raises InvalidData."""
    return np.asarray(_time_ns(np.atleast_1d(np.asarray(t)), time_unit, "t") * 1e-9)


def _time_ns(t: Any, time_unit: str | None, name: str) -> Ints:
    times = np.asarray(t)
    if times.ndim != 1:
        raise InvalidData(f"{name}: expected shape (n,), not {times.shape}")
    if time_unit is not None and time_unit not in UNITS_NS:
        raise InvalidData(f"time_unit: expected {', '.join(u for u in UNITS_NS if u != 'µs')}, not '{time_unit}'")
    if times.dtype.kind in "OU":
        times = _datetimes(times, name)
    if times.dtype.kind == "M":
        if np.isnat(times).any():
            raise InvalidData(f"{name}: sample {int(np.flatnonzero(np.isnat(times))[0])} has no time")
        return times.astype("datetime64[ns]").astype(np.int64)
    if times.dtype.kind == "m":
        return times.astype("timedelta64[ns]").astype(np.int64)
    if times.dtype.kind in "iu":
        if time_unit is None:
            raise InvalidData(f"{name} are integers: say their unit by time_unit, one of s, ms, us, ns")
        scale = UNITS_NS[time_unit]
        if len(times) and max(abs(int(times.min())), abs(int(times.max()))) > SECONDS_MOST * 1e9 / scale:
            raise InvalidData(f"{name} goes to {int(times.max()):d} {time_unit}, beyond what can be counted in ns")
        return times.astype(np.int64) * scale
    found = _numbers(times, name)
    if not np.isfinite(found).all():
        raise InvalidData(f"{name}: sample {int(np.flatnonzero(~np.isfinite(found))[0])} has no finite time")
    if time_unit is None and (stated := _UNIT_IN_NAME.search(name)):
        unit = next(unit for unit in ("ms", "us", "ns") if stated[1].lower().replace("µ", "u")[0] == unit[0])
        raise InvalidData(f"{name}: floats count as seconds; if they are in {unit}: time_unit='{unit}'")
    scaled = found * (UNITS_NS[time_unit or "s"] / UNITS_NS["s"])
    if np.abs(scaled).max(initial=0.0) > SECONDS_MOST:
        raise InvalidData(f"{name} goes to {found.max():.6g}, too much for seconds: say its unit by time_unit")
    whole = np.floor(scaled)  # separate, to keep the nanoseconds of seconds since 1970 as far as a float has them
    ns = whole.astype(np.int64) * UNITS_NS["s"] + np.round((scaled - whole) * 1e9).astype(np.int64)
    return np.asarray(ns)


def _datetimes(times: Any, name: str) -> Any:
    """datetime64[ns] from datetimes of Python, of pandas with a zone, or from ISO text.
    Times with a zone become UTC."""
    utc = [t.replace(tzinfo=None) - t.utcoffset() if getattr(t, "tzinfo", None) else t for t in times.tolist()]
    try:
        return np.array(utc, dtype="datetime64[ns]")
    except (TypeError, ValueError):
        raise InvalidData(f"{name}: expected seconds or datetimes, not {_kind(times)}") from None


def _numbers(values: Any, name: str) -> Floats:
    if np.ma.is_masked(values):
        raise InvalidData(f"{name}: some values are masked; leave them out first")
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise InvalidData(f"{name}: expected numbers, not {_kind(values)}") from None


def _kind(values: Any) -> str:
    kinds: Iterable[str] = {type(v).__name__ for v in np.ravel(np.asarray(values, dtype=object))[:10]}
    return " and ".join(sorted(kinds)) or "nothing"
