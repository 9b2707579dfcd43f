"""Which columns of a table are its time and its three outputs: as the user
says, or as everybody calls them.

Nothing is guessed where two guesses are possible: `Unclear` says what, and the
message names the option that settles the question. No number of the table is
looked at here."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto

import triaxcal_drivers as td

# The words that programs call columns by, in lower case, and the units that they
# write behind them.

UNITS_OF_TIME = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden", "secondes", "segundos"), "s"),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "usecs", "micros", "microsec", "microsecond", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"), "ns"),
}
"""As `--time-unit` has them."""
OTHER_UNITS_OF_TIME = frozenset(
    ("min", "mins", "minute", "minutes", "minuten", "h", "hr", "hrs", "hour", "hours", "stunden", "day", "days", "tage")
)
TIMES = frozenset((
    "t", "ts", "time", "times", "timestamp", "timestamps", "zeit", "zeitstempel", "uhrzeit", "temps", "tiempo", "tempo",
    "elapsed", "date", "datetime", "epoch", "epoc", "clock", "heure", "hora", "stamp", "uptime", "utc",
    "datum", "fecha", "zeitpunkt", "czas", "čas", "tijd", "tijdstip", "tidpunkt", "aika", "zaman", "дата", "время",
    "时间", "時間", "日時", "시간",
    *(word for word in UNITS_OF_TIME if len(word) > 3),
))  # fmt: skip
INDICES = frozenset((
    "index", "idx", "sample", "samples", "count", "counter", "n", "no", "nr", "num", "number", "nummer", "id", "row",
    "frame", "packet", "pose", "poses", "seq", "sequence", "record", "unnamed", "level", "lfd", "i", "k",
))  # fmt: skip
ACCELERATION = frozenset((
    "a", "acc", "accel", "accelero", "acceleration", "accelerometer", "accelerations", "accelerometers", "gforce", "gf",
    "beschleunigung", "beschl", "acel", "aceler", "aceleracion", "aceleración", "accélération", "accelerazione",
))  # fmt: skip
UNITS_OF_ACCELERATION = frozenset(
    ("g", "mg", "ug", "µg", "m/s2", "m/s^2", "m/s**2", "m/s²", "m/s/s", "m*s^-2", "ms-2", "g0", "gn")
)
OTHER_SENSORS = frozenset((
    "g", "gyr", "gyro", "gyros", "gyroscope", "w", "omega", "rotation", "rot", "rate", "angular", "angvel", "drehrate",
    "m", "mag", "magn", "magnet", "magnetometer", "magnetic", "b", "field", "compass", "geomagnetic",
))  # fmt: skip
UNITS_OF_OTHERS = frozenset((
    "deg/s", "°/s", "dps", "mdps", "rad/s", "ut", "µt", "μt", "nt", "mt", "t", "gauss", "mgauss", "m/s", "m", "°",
    "deg", "rad",
))  # fmt: skip
OTHER_UNITS = frozenset(("v", "mv", "uv", "µv", "a", "ma", "hz", "counts", "count", "lsb", "raw", "pa", "hpa", "%"))
COMPUTED = frozenset((
    "gravity", "grav", "quat", "quaternion", "q", "orientation", "attitude", "euler", "roll", "pitch", "yaw", "heading",
    "azimuth", "tilt", "inclination", "angle", "norm", "magnitude", "absolute", "abs", "total", "resultant", "svm",
    "vm", "enmo", "vel", "velocity", "pos", "position", "displacement", "jerk", "delta", "dt",
))  # fmt: skip
"""Of columns that are computed from the outputs, or from the motion of the
whole."""
TURNED = frozenset(("earth", "world", "global", "ned", "enu", "nav", "geo"))
"""Of readings that were turned into another frame than the sensor's."""
NOT_CELSIUS = frozenset(("f", "fahrenheit", "k", "kelvin", "raw", "mv", "v", "adc", "counts", "lsb", "code"))
UNCERTAINTIES = frozenset(
    ("se", "sem", "std", "sd", "stderr", "stdev", "sigma", "error", "err", "unc", "uncertainty", "var")
)
STANDARD_ERRORS = frozenset(("se", "sem", "stderr"))
"""Of means, and not the spread of samples."""
WITHOUT_GRAVITY = frozenset(
    ("linear", "lin", "linacc", "linaccel", "user", "useracceleration", "free", "freeacc", "dynamic")
)
BESIDE_AN_AXIS = frozenset(
    ("axis", "achse", "axe", "eje", "asse", "value", "cal", "calibrated", "raw", "data", "sensor", "imu")
)
"""Words that say nothing of the quantity."""
NUMBERED = frozenset(
    ("a", "acc", "accel", "ch", "chan", "channel", "adc", "ain", "ai", "in", "u", "v", "axis", "out", "kanal", "c")
)
"""Before the numbers of an ADC's channels."""
TEMPERATURE = frozenset(("temp", "temperature", "temperatur", "température", "temperatura"))
ELSEWHERE = frozenset(("gps", "location", "motion", "altimeter"))
"""Sensors that have times of their own, and no three axes."""


OUTPUTS = ("ux", "uy", "uz")
ERRORS = ("se_ux", "se_uy", "se_uz")
"""Standard errors of pose means."""
TIME = "t"
BY_NUMBER = "--columns t=1,ux=2,uy=3,uz=4"
AXES = "xyz"
NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
ISO, INDEX = "iso", "index"
TIME_UNITS = (*NANOSECONDS, INDEX, ISO)
"""As `--time-unit` takes them."""
_BRACKETS = re.compile(r"[\[(<{]([^\])>}]*)[\])>}]")
_SLASH = re.compile(r"(?:\s*/\s*|\s+in\s+)([^\s/\[(]\S*)\s*$")
_WORD = re.compile(r"[^\W\d_]+|\d+")
_CAMEL = re.compile(r"(?<=[a-zà-ÿ])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")


class Kind(Enum):
    ACCELERATION = auto()
    WITHOUT_GRAVITY = auto()
    OTHER_SENSOR = auto()
    COMPUTED = auto()
    NOT_KNOWN = auto()


@dataclass(frozen=True)
class Name:
    """A column's name taken apart: its words in lower case, and the unit that
    stands in it, or in the row of units."""

    text: str
    words: tuple[str, ...]
    unit: str
    in_brackets: str = ""

    @classmethod
    def of(cls, text: str, unit: str = "") -> Name:
        bare = bare_name(text)
        stated = _BRACKETS.findall(bare)
        without = _BRACKETS.sub(" ", bare)
        if not any(s.strip() for s in stated) and (slash := _SLASH.search(without)) and _is_unit(slash[1]):
            stated, without = [slash[1]], without[: slash.start()]
        words = [w.lower() for w in _WORD.findall(_CAMEL.sub(" ", without).replace("_", " "))]
        unit = next((s.strip() for s in reversed(stated) if _is_unit(s.strip())), "") or _in_brackets(unit)
        if not unit and len(words) > 1 and words[-1] in {*UNITS_OF_TIME, *OTHER_UNITS_OF_TIME}:
            unit = words.pop()
        return cls(bare, tuple(words), unit, next((s.strip() for s in reversed(stated) if s.strip()), ""))

    @property
    def is_time(self) -> bool:
        if self.is_celsius and self.unit:
            return False
        called = {w for w in self.words if len(w) > 2 or len(self.words) == 1} & TIMES
        return bool(called) or self.words == ("x", "value") or self.time_unit is not None

    @property
    def is_index(self) -> bool:
        counts = all(w in INDICES or w.isdecimal() for w in self.words) and bool(set(self.words) & INDICES)
        last = self.words[-1] if self.words else ""
        return not self.is_time and (counts or not self.words or (len(last) > 2 and last in INDICES - {"number"}))

    @property
    def time_unit(self) -> str | None:
        """As `--time-unit` has it, where the name states one; ``t_s`` is what
        anybody calls a time."""
        if self.text == "t_s":
            return None
        stated = UNITS_OF_TIME.get(self.unit.lower())
        if stated or len(self.words) == 1:
            return stated or UNITS_OF_TIME.get(self.words[0])
        return next((UNITS_OF_TIME[w] for w in self.words if len(w) > 1 and w in UNITS_OF_TIME), None)

    @property
    def unknown_unit(self) -> bool:
        """Whether brackets behind the name hold what is no unit that anybody
        uses: ticks, or 10 ms."""
        return bool(self.in_brackets) and not self.unit

    @property
    def other_time_unit(self) -> str | None:
        """Minutes, hours and days, which no logger means and spreadsheets do."""
        return self.unit if self.unit.lower() in OTHER_UNITS_OF_TIME else None

    @property
    def is_of_another_sensor(self) -> bool:
        return bool(set(self.words) & (OTHER_SENSORS | COMPUTED | ELSEWHERE))

    @property
    def is_without_gravity(self) -> bool:
        return bool(set(self.words) & WITHOUT_GRAVITY)

    @property
    def is_computed(self) -> bool:
        return "angular" not in self.words and bool(set(self.words) & (COMPUTED | TURNED | UNCERTAINTIES))

    @property
    def is_uncertainty(self) -> bool:
        return bool(set(self.words) & UNCERTAINTIES)

    @property
    def is_standard_error(self) -> bool:
        return bool(set(self.words) & STANDARD_ERRORS) or {"standard", "error"} <= set(self.words)

    @property
    def is_either(self) -> bool:
        """T is a temperature as well as a time: it is a time only where no
        other column is, and where it rises."""
        return self.words == ("t",) and self.text.startswith("T") and self.time_unit is None

    @property
    def is_celsius(self) -> bool:
        """A temperature whose unit is no other than the degree Celsius."""
        called = (set(self.words) & TEMPERATURE and not set(self.words) & NOT_CELSIUS) or self.is_either
        return bool(called) and self.unit.lower().lstrip("°º").removeprefix("deg").strip() in ("", "c", "celsius")


@dataclass(frozen=True)
class Triple:
    """Three columns, 0-based, that differ by x, y, z alone, or by a number.
    ``letter`` is all that they are called by beside that, where that is one
    letter and no unit: a quantity's, or a label."""

    columns: tuple[int, int, int]
    kind: Kind
    plain: bool
    letter: str = ""


@dataclass(frozen=True)
class Roles:
    """Columns, 0-based. ``time`` are those that may be the time, the likeliest
    first; ``channels`` what the user names as such; ``said`` are roles that the
    user gave. ``rivals`` are triples of what may be the same quantity."""

    outputs: tuple[int, int, int]
    time: tuple[int, ...]
    indices: tuple[int, ...]
    channels: Mapping[str, int] = field(default_factory=dict)
    said: frozenset[str] = frozenset()
    rivals: tuple[int, ...] = ()


class Unclear(Exception):
    """Two ways to read the names, or none. The text says what to add to the
    command."""


def bare_name(text: str) -> str:
    """Without blanks, quotes and a leading # or %."""
    return text.strip().lstrip("#%;").strip().strip("\"'").strip()


def parse_columns(text: str) -> dict[str, str]:
    """Of ``t=time,ux=Acc X (g),…``: a comma parts only where a role and an
    equals sign follow. Raises ValueError."""
    found: dict[str, str] = {}
    for part in re.split(r",(?=\s*\w+\s*=)", text):
        role, equals, column = (p.strip() for p in part.partition("="))
        if not equals or not column or not re.fullmatch(r"\w+", role):
            raise ValueError(f"expected ROLE=COLUMN as in t=time,ux=ax,uy=ay,uz=az, not '{part.strip()}'")
        role = TIME if role == "t_s" else role
        if role in found:
            raise ValueError(f"{role} is given twice")
        found[role] = column
    return found


def roles_of(
    names: Sequence[str], units: Sequence[str], said: Mapping[str, str], *, named: bool, suggested: str = BY_NUMBER
) -> Roles:
    """``named`` is False where the table has no header and ``names`` are
    numbers; ``suggested`` is what the user could say then. Raises Unclear."""
    given = {role: column_of(names, column, named=named) for role, column in said.items()}
    by_column: dict[int, str] = {}
    for role, column in given.items():
        if column in by_column:
            raise Unclear(f"--columns: {by_column[column]} and {role} are the same column {names[column]}")
        by_column[column] = role
    parsed = [Name.of(n, u) for n, u in zip(names, units or [""] * len(names), strict=True)]
    free = [i for i in range(len(names)) if i not in by_column]
    triples = _triples(parsed, free) if named else []
    if all(axis in given for axis in OUTPUTS):
        outputs = (given["ux"], given["uy"], given["uz"])
    elif any(axis in given for axis in OUTPUTS):
        lacking = ", ".join(axis for axis in OUTPUTS if axis not in given)
        raise Unclear(f"--columns names no {lacking}; name all three outputs")
    else:
        if not named:
            raise Unclear(f"no header over {len(names)} columns; name the columns by number: {suggested}")
        outputs = _outputs(parsed, triples)
    alike = [t for t in triples if t.kind in (Kind.ACCELERATION, Kind.NOT_KNOWN) and t.columns != outputs]
    rivals = tuple(i for t in alike for i in t.columns)
    others = [i for i in free if i not in outputs]
    indices = tuple(i for i in others if named and parsed[i].is_index)
    if TIME in given:
        time: tuple[int, ...] = (given[TIME],)
    else:
        called = [i for i in others if named and parsed[i].is_time and i not in indices]
        called = [i for i in called if not parsed[i].is_either] or called
        time = tuple(sorted(called, key=lambda i: parsed[i].is_of_another_sensor))
    channels = {role: i for role, i in given.items() if role not in (TIME, *OUTPUTS)}
    if named:
        channels |= _standard_errors(parsed, others, parsed[outputs[0]].unit)
    return Roles(outputs, time, indices, channels, frozenset(said), rivals)


def _standard_errors(names: Sequence[Name], columns: Sequence[int], unit: str) -> dict[str, int]:
    """The columns of standard errors of pose means, by their roles: those with our
    own names, else three in the ``unit`` of the outputs that are called so and
    differ by the axis, as se_x or stderr ay."""
    own = {names[i].text: i for i in columns if names[i].text in ERRORS}
    if own:
        return own
    found: dict[str, int] = {}
    for i in columns:
        axes = {word[-1] for word in names[i].words if len(word) <= 2 and word[-1] in AXES}
        if names[i].is_standard_error and len(axes) == 1 and names[i].unit in ("", unit):
            role = ERRORS[AXES.index(axes.pop())]
            if role in found:
                return {}
            found[role] = i
    return found if len(found) == len(ERRORS) else {}


def seconds_and_rest(names: Sequence[str]) -> Iterator[tuple[int, int]]:
    """The columns of whole seconds and of the nanoseconds behind them, as
    header.stamp.secs and header.stamp.nsecs."""
    bare = [bare_name(n) for n in names]
    rests = {m[1]: j for j, n in enumerate(bare) if (m := re.fullmatch(r"(.*?)(?:nsecs?|nanosecs?)", n))}
    for i, name in enumerate(bare):
        if (m := re.fullmatch(r"(.*?)secs?", name)) and m[1] in rests:
            yield i, rests[m[1]]


def column_of(names: Sequence[str], wanted: str, *, named: bool) -> int:
    """The column, 0-based, that ``wanted`` names. Raises Unclear."""
    bare = [bare_name(n) for n in names]
    for held, sought in ((list(names), wanted), (bare, bare_name(wanted)), (_folded(bare), bare_name(wanted).lower())):
        found = [i for i, n in enumerate(held) if n == sought] if named else []
        if len(found) == 1:
            return found[0]
        if len(found) > 1:
            numbers = ", ".join(str(i + 1) for i in found)
            raise Unclear(f"--columns: {len(found)} columns are called {wanted}; name them by number ({numbers})")
    if wanted.isdecimal() and 1 <= int(wanted) <= len(names):
        return int(wanted) - 1
    has = f"it has {', '.join(n for n in bare if n)}" if named else f"it has no header and {len(names)} columns"
    raise Unclear(f"--columns: the table has no column {wanted}; {has}")


def _folded(names: Sequence[str]) -> list[str]:
    return [n.lower() for n in names]


def _outputs(names: Sequence[Name], triples: Sequence[Triple]) -> tuple[int, int, int]:
    own = [next((i for i, n in enumerate(names) if n.text == axis), None) for axis in OUTPUTS]
    if None not in own and len([n.text for n in names if n.text in OUTPUTS]) == len(OUTPUTS):
        return own[0], own[1], own[2]  # type: ignore[return-value]
    accelerations = [t for t in triples if t.kind is Kind.ACCELERATION]
    others = [t for t in triples if t.kind is Kind.NOT_KNOWN]
    without = [t for t in triples if t.kind is Kind.WITHOUT_GRAVITY]
    labelled = [t for t in triples if t.letter in ("a", "b")]
    if {t.letter for t in labelled} == {"a", "b"}:  # sensors A and B, or an acceleration and a magnetic field
        others += [t for t in labelled if t not in (*accelerations, *others)]
        raise Unclear(_several(names, [*accelerations, *others, *without], without))
    if len(accelerations) == 1 and not without and not any(t.plain for t in others):
        return accelerations[0].columns
    if not accelerations and len(others) == 1 and not without:
        return others[0].columns
    if not accelerations and not others and len(without) == 1 and _is_ros(names, without[0]):
        return without[0].columns
    several = [*accelerations, *others, *without]
    if len(several) > 1:
        raise Unclear(_several(names, several, without))
    if without:
        raise Unclear(
            f"{_called(names, without[0])} seem to be without gravity, which the fit needs; if they have it: "
            f"{_option(names, without[0])}"
        )
    sensors = [t for t in triples if t.kind is Kind.OTHER_SENSOR]
    if sensors:
        raise Unclear(
            f"no column that is called as an accelerometer's output; if {_called(names, sensors[0])} are meant: "
            f"{_option(names, sensors[0])}"
        )
    seen = td.hints.clipped(", ".join(n.text for n in names if n.text))
    raise Unclear(f"no three outputs among the columns {seen}; name them: --columns ux=NAME,uy=NAME,uz=NAME")


def _several(names: Sequence[Name], several: Sequence[Triple], without: Sequence[Triple]) -> str:
    return (
        f"{len(several)} triples of outputs ({'; '.join(_called(names, t) for t in several)}); choose by "
        f"{_option(names, several[0])}" + ("; gravity has to be in them" if without else "")
    )


def _called(names: Sequence[Name], triple: Triple) -> str:
    return ", ".join(names[i].text for i in triple.columns)


def _option(names: Sequence[Name], triple: Triple) -> str:
    texts = [n.text for n in names]
    shown = [names[i].text if texts.count(names[i].text) == 1 else str(i + 1) for i in triple.columns]
    option = ",".join(f"{axis}={text}" for axis, text in zip(OUTPUTS, shown, strict=True))
    return f'--columns "{option}"' if re.search(r"[\s()\[\]<>&;|$*#]", option) else f"--columns {option}"


def _is_ros(names: Sequence[Name], triple: Triple) -> bool:
    """sensor_msgs/Imu calls the specific force linear_acceleration, beside
    angular_velocity."""
    linear = {"linear", "acceleration"} <= set(names[triple.columns[0]].words)
    return linear and any({"angular", "velocity"} <= set(n.words) for n in names)


def _triples(names: Sequence[Name], free: Sequence[int]) -> list[Triple]:
    found: dict[tuple[int, str], dict[str, list[int]]] = {}
    for i in free:
        text = names[i].text.lower()
        for at, letter in enumerate(text):
            if letter in AXES:
                found.setdefault((at, text[:at] + "*" + text[at + 1 :]), {}).setdefault(letter, []).append(i)
    triples = []
    for (at, _), by_axis in found.items():
        if set(by_axis) == set(AXES):
            for columns in zip(*(by_axis[axis] for axis in AXES), strict=False):
                triples.append(_triple(names, columns, at))
    return [*triples, *_numbered(names, [i for i in free if all(i not in t.columns for t in triples)])]


def _triple(names: Sequence[Name], columns: tuple[int, ...], at: int) -> Triple:
    """``at`` is where the axis stands in the names."""
    first = names[columns[0]]
    words = set(Name.of(first.text[:at] + " " + first.text[at + 1 :]).words) - BESIDE_AN_AXIS
    kind = _kind(words, first.unit.lower().replace(" ", ""))
    alone = next(iter(words)) if len(words) == 1 and not first.unit else ""
    return Triple((columns[0], columns[1], columns[2]), kind, not words, alone if len(alone) == 1 else "")


def _kind(words: set[str], unit: str) -> Kind:
    if words & UNCERTAINTIES:
        return Kind.COMPUTED
    if words & WITHOUT_GRAVITY:
        return Kind.WITHOUT_GRAVITY
    if (
        words & TURNED
        or (words & (COMPUTED - {"velocity", "total"}))
        or ("velocity" in words and "angular" not in words)
    ):
        return Kind.COMPUTED
    if words & ACCELERATION or {"g", "force"} <= words or {"g", "f"} <= words:
        return Kind.ACCELERATION
    if any(len(w) > 1 for w in words & OTHER_SENSORS):  # its mG are milligauss
        return Kind.OTHER_SENSOR
    if unit in UNITS_OF_ACCELERATION:
        return Kind.ACCELERATION
    if words & OTHER_SENSORS or unit in UNITS_OF_OTHERS:
        return Kind.OTHER_SENSOR
    return Kind.NOT_KNOWN


def _numbered(names: Sequence[Name], free: Sequence[int]) -> list[Triple]:
    """Three columns with one name and three numbers in a row, as of an ADC or a
    vector: the first is x."""
    found: dict[str, list[tuple[int, int]]] = {}
    for i in free:
        text = re.sub(r"[\[(<{]\D*[\])>}]", "", names[i].text).strip()
        if m := re.fullmatch(r"(.*\D)[\[(]?(\d+)[\])]?", text):
            found.setdefault(m[1].strip(" _-.[("), []).append((int(m[2]), i))
    triples = []
    for stem, numbered in found.items():
        numbers, columns = [n for n, _ in numbered], [i for _, i in numbered]
        in_order = len(numbers) == len(AXES) and numbers == list(range(numbers[0], numbers[0] + len(AXES)))
        words = set(Name.of(stem).words)
        if in_order and (stem.lower() in NUMBERED or words & ACCELERATION):
            kind = _kind(words, names[columns[0]].unit.lower())
            triples.append(Triple((columns[0], columns[1], columns[2]), kind, not words))
    return triples


def _is_unit(text: str) -> bool:
    folded = text.strip().lower().replace(" ", "")
    return (
        folded in UNITS_OF_TIME
        or folded in OTHER_UNITS_OF_TIME
        or folded in UNITS_OF_ACCELERATION
        or folded in UNITS_OF_OTHERS
        or folded.lstrip("°º").removeprefix("deg") in ("c", "f", "k", "celsius", "fahrenheit", "kelvin")
        or folded in OTHER_UNITS
    )


def _in_brackets(unit: str) -> str:
    found = _BRACKETS.fullmatch(unit.strip())
    return (found[1] if found else unit).strip()
