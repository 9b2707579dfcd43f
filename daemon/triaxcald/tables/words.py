"""The words that programs call columns by, in lower case, and the units that
they write behind them."""

from __future__ import annotations

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
ERRORS = frozenset(("se", "sem", "std", "sd", "stderr", "stdev", "sigma", "error", "err", "unc", "uncertainty", "var"))
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
