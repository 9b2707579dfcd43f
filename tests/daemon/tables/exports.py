"""One recording as forty programs write it: the layout of each is its program's, the numbers are the same."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np
import pandas as pd
import polars as pl
from numpy.typing import NDArray

from triaxcald.tables.samples import Reading

N, RATE = 40, 100.0
MS = np.arange(N) * 10
"""Milliseconds from the first sample."""
_RNG = np.random.default_rng(4)
LEVELS = np.repeat([[0.98, 0.03, -0.11], [-0.05, 0.94, 0.22], [0.12, -0.31, -0.89], [0.55, 0.61, 0.58]], N // 4, axis=0)
U = np.round(LEVELS + _RNG.normal(0, 0.004, (N, 3)), 4)
GYRO = np.round(_RNG.normal(0, 0.02, (N, 3)), 4)
MAGNET = np.round(_RNG.normal(20, 3, (N, 3)), 2)
TEMPERATURE = np.round(24 + np.arange(N) * 0.004, 2)
START = datetime(2024, 3, 9, 14, 5, 0, tzinfo=UTC)


@dataclass(frozen=True)
class Export:
    """``hint`` is what a user has to say, and ``asked`` the option that the message has to name, where the file by
    itself does not tell; ``u`` (n,3) are the outputs as the file has them, ``t_ms`` (n,) the times."""

    program: str
    data: bytes
    hint: Reading | None = None
    asked: str = ""
    u: NDArray[np.float64] = None  # type: ignore[assignment]
    t_ms: NDArray[np.int64] = None  # type: ignore[assignment]
    suffix: str = ".csv"
    channels: tuple[str, ...] | None = None

    def outputs(self) -> NDArray[np.float64]:
        return U if self.u is None else self.u

    def times_ms(self) -> NDArray[np.int64]:
        return MS if self.t_ms is None else self.t_ms


def text(
    columns: Sequence[Sequence[object]],
    header: Sequence[str] | None = None,
    separator: str = ",",
    decimal: str = ".",
    end: str = "\n",
    before: str = "",
    encoding: str = "utf-8",
    trailing: bool = False,
    quote: bool = False,
) -> bytes:
    """Lines of the columns under the header."""

    def cell(value: object) -> str:
        shown = value if isinstance(value, str) else f"{value:.4f}" if isinstance(value, float) else str(value)
        shown = shown.replace(".", decimal) if not isinstance(value, str) else shown
        return f'"{shown}"' if quote else shown

    rows = [separator.join(map(cell, row)) for row in zip(*columns, strict=True)]
    if header is not None:
        rows.insert(0, separator.join(f'"{h}"' if quote else h for h in header))
    return (before + "".join(row + (separator if trailing else "") + end for row in rows)).encode(encoding)


def floats(values: NDArray[np.float64]) -> list[float]:
    return [float(v) for v in values]


def whole(values: NDArray[np.int64]) -> list[int]:
    return [int(v) for v in values]


SECONDS = floats(MS / 1000)
X, Y, Z = (floats(U[:, i]) for i in range(3))
G = [floats(GYRO[:, i]) for i in range(3)]
M = [floats(MAGNET[:, i]) for i in range(3)]
T = floats(TEMPERATURE)
EMPTY = [""] * N


def moments(form: Callable[[datetime], str]) -> list[str]:
    return [form(START + timedelta(milliseconds=int(ms))) for ms in MS]


ISO = moments(lambda d: d.isoformat(sep=" ", timespec="milliseconds").removesuffix("+00:00"))
ISO_Z = moments(lambda d: d.isoformat(timespec="microseconds").replace("+00:00", "Z"))
CLOCK = moments(lambda d: d.strftime("%H:%M:%S.%f")[:-3])
DOTTED = moments(lambda d: d.isoformat().replace(":", "."))
MIXED = [[v for pair in zip(a, g, strict=True) for v in pair] for a, g in zip((X, Y, Z), G, strict=True)]
EPOCH_NS = [1_709_993_100_000_000_000 + int(ms) * 1_000_000 for ms in MS]
FRAME = pd.DataFrame(
    {"time": MS / 1000, "acc_x": U[:, 0], "acc_y": U[:, 1], "acc_z": U[:, 2], "temperature": TEMPERATURE}
)


def _parquet(frame: pd.DataFrame) -> bytes:
    out = io.BytesIO()
    frame.to_parquet(out)
    return out.getvalue()


def _polars() -> bytes:
    out = io.BytesIO()
    pl.DataFrame({"t": MS / 1000, "x": U[:, 0], "y": U[:, 1], "z": U[:, 2]}).write_parquet(out)
    return out.getvalue()


def _savetxt(header: str) -> bytes:
    out = io.BytesIO()
    np.savetxt(out, np.column_stack([MS / 1000, U]), header=header)
    return out.getvalue()


def said(**columns: str) -> Reading:
    return Reading(columns)


BY_NUMBER = said(t="1", ux="2", uy="3", uz="4")
LVM = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t{0}\n"
    "***End_of_Header***\t\n\t\nChannels\t3\t\t\t\nSamples\t40\t40\t40\t\n"
    "Date\t2024/03/09\t2024/03/09\t2024/03/09\t\nX_Dimension\tTime\tTime\tTime\t\nDelta_X\t0{0}010000\t0{0}010000\t"
    "0{0}010000\t\n***End_of_Header***\t\t\t\t\nX_Value\tacc x\tacc y\tacc z\tComment\n"
)
ACTIGRAPH = (
    "------------ Data File Created By ActiGraph GT3X+ ActiLife v6.13.3 Firmware v3.2.1 date format M/d/yyyy at 100 Hz "
    " Filter Normal -----------\nSerial Number: MOS2A0000000\nStart Time 14:05:00\nStart Date 3/9/2024\n"
    "Epoch Period (hh:mm:ss) 00:00:00\nDownload Time 10:00:00\nDownload Date 3/10/2024\n"
    "Current Memory Address: 0\nCurrent Battery Voltage: 4.20     Mode = 12\n"
    "--------------------------------------------------\n"
)
X16 = (
    ";Title, http://www.gcdataconcepts.com, X16-1D, ADXL345\n;Version, 1106, Build date, Feb  5 2016\n"
    ";Start_time, 2024-03-09, 14:05:00.000\n;Temperature, 24.00, deg C,  Vbat, 1600, mv\n;SampleRate, 100,Hz\n"
    ";Deadband, 0, counts\n;DeadbandTimeout, 0,sec\n;Time, Ax, Ay, Az\n"
)
STAMPED = FRAME.drop(columns="time").set_index(pd.to_datetime(ISO_Z).rename("stamp"))
RUNS = [0.01 * i + 1e-4 * (i % 3) for i in range(N)]
COUNTS = np.rint(U * 2048).astype(np.int64)
LINEAR = [floats(U[:, i] * 0) for i in range(3)]
NAMES = ("time", "ax", "ay", "az")

EXPORTS = [
    Export("pandas, to_csv without index", FRAME.to_csv(index=False).encode(), channels=("temp_c",)),
    Export("pandas, to_csv with its index", FRAME.to_csv().encode(), channels=("temp_c",)),
    Export("pandas, German", FRAME.to_csv(index=False, sep=";", decimal=",").encode(), channels=("temp_c",)),
    Export("pandas, indexed by datetimes", STAMPED.to_csv().encode(), channels=("temp_c",)),
    Export("pandas, an array's columns", FRAME.set_axis(range(5), axis=1).to_csv(index=False).encode(),
           said(t="0", ux="1", uy="2", uz="3", temp_c="4"), "--columns", channels=("temp_c",)),
    Export("pandas, Parquet", _parquet(FRAME), suffix=".parquet", channels=("temp_c",)),
    Export("pandas, Parquet indexed by datetimes", _parquet(STAMPED), suffix=".parquet", channels=("temp_c",)),
    Export("polars, Parquet", _polars(), suffix=".parquet"),
    Export("R, write.csv", text([[str(i + 1) for i in range(N)], SECONDS, X, Y, Z], ["", "t", "x", "y", "z"],
           quote=True)),
    Export("R, write.table", text([[f'"{i + 1}"' for i in range(N)], SECONDS, X, Y, Z], separator=" ",
           before='"time" "ax" "ay" "az"\n')),
    Export("R, write.csv2", text([SECONDS, X, Y, Z], NAMES, ";", ",")),
    Export("MATLAB, writetable", text([SECONDS, X, Y, Z], ["Time", "AccX", "AccY", "AccZ"], end="\r\n")),
    Export("MATLAB, writematrix", text([SECONDS, X, Y, Z]), BY_NUMBER, "--columns"),
    Export("MATLAB Mobile", text([ISO, X, Y, Z], ["Timestamp", "X", "Y", "Z"])),
    Export("numpy, savetxt", _savetxt(""), BY_NUMBER, "--columns"),
    Export("numpy, savetxt with a header", _savetxt("t ax ay az")),
    Export("Excel, English, UTF-8", b"\xef\xbb\xbf" + text([SECONDS, X, Y, Z], ["Time (s)", "X (g)", "Y (g)", "Z (g)"],
                                                            end="\r\n")),
    Export("Excel, German, Windows-1252", text([SECONDS, X, Y, Z], ["Zeit [s]", "a_x [m/s²]", "a_y [m/s²]",
           "a_z [m/s²]"],                                               ";", ",", "\r\n", encoding="cp1252")),
    Export("Excel, French, Unicode text", b"\xff\xfe" + text([SECONDS, X, Y, Z], ["Temps (s)", "Accélération X (m/s²)",
           "Accélération Y (m/s²)", "Accélération Z (m/s²)"], "\t", ",", "\r\n", encoding="utf-16-le")),
    Export("Excel, sep=", text([SECONDS, X, Y, Z], NAMES, ";", ",", "\r\n", before="sep=;\r\n")),
    Export("Excel, trailing separators", text([SECONDS, X, Y, Z], NAMES, ";", trailing=True)),
    Export("LibreOffice, quoted decimal commas", text([SECONDS, X, Y, Z], NAMES, ",", ",", quote=True)),
    Export("LabVIEW, .lvm", text([SECONDS, X, Y, Z], None, "\t", before=LVM.format(".")), suffix=".lvm"),
    Export("LabVIEW, .lvm, decimal comma", text([SECONDS, X, Y, Z], None, "\t", ",", before=LVM.format(",")),
           suffix=".lvm"),
    Export("LabVIEW, spreadsheet", text([SECONDS, X, Y, Z], None, "\t"), BY_NUMBER, "--columns", suffix=".txt"),
    Export("ROS, rostopic echo -p", text([EPOCH_NS, whole(MS), *G, X, Y, Z], ["%time", "field.header.seq",
           *(f"field.angular_velocity.{a}" for a in "xyz"), *(f"field.linear_acceleration.{a}" for a in "xyz")]),
           Reading(time_unit="ns"), "--time-unit"),
    Export("ROS, seconds and nanoseconds", text([[1_709_993_100 + int(ms) // 1000 for ms in MS],
           [int(ms) % 1000 * 1_000_000 for ms in MS], X, Y, Z, *G], ["header.stamp.secs", "header.stamp.nsecs",
           *(f"linear_acceleration.{a}" for a in "xyz"), *(f"angular_velocity.{a}" for a in "xyz")])),
    Export("ROS, PlotJuggler", text([SECONDS, *G, X, Y, Z], ["__time",
           *(f"/imu/data/angular_velocity/{a}" for a in "xyz"),
           *(f"/imu/data/linear_acceleration/{a}" for a in "xyz")])),
    Export("Arduino, millis()", text([whole(MS), X, Y, Z], ["millis", "ax", "ay", "az"], "\t")),
    Export("Arduino, a time in milliseconds", text([whole(MS), X, Y, Z], NAMES), Reading(time_unit="ms"),
           "--time-unit"),
    Export("Arduino, a time in microseconds", text([whole(MS * 1000), X, Y, Z], NAMES), Reading(time_unit="us"),
           "--time-unit"),
    Export("Arduino, no time", text([*(whole(COUNTS[:, i]) for i in range(3))], ["x", "y", "z"]), Reading(rate=RATE),
           "--rate", u=COUNTS.astype(float)),
    Export("Arduino, a sample index", text([list(range(N)), X, Y, Z], ["sample", "ax", "ay", "az"]), Reading(rate=RATE),
           "--rate"),
    Export("phyphox", text([SECONDS, X, Y, Z, floats(np.linalg.norm(U, axis=1))], ["Time (s)",
           *(f"Acceleration {a} (m/s^2)" for a in "xyz"), "Absolute acceleration (m/s^2)"], quote=False), channels=()),
    Export("phyphox, without gravity too", text([SECONDS, *LINEAR, X, Y, Z], ["Time (s)",
           *(f"Linear Acceleration {a} (m/s^2)" for a in "xyz"), *(f"Acceleration {a} (m/s^2)" for a in "xyz")]),
           said(ux="Acceleration x (m/s^2)", uy="Acceleration y (m/s^2)", uz="Acceleration z (m/s^2)"), "--columns",
           channels=()),
    Export("Physics Toolbox", text([SECONDS, X, Y, Z, *G], ["time", "gFx", "gFy", "gFz", "wx", "wy", "wz"], ";", ",")),
    Export("Sensor Logger", text([EPOCH_NS, SECONDS, Z, Y, X], ["time", "seconds_elapsed", "z", "y", "x"])),
    Export("SensorLog, iOS", text([ISO_Z, SECONDS, X, Y, Z, *G], ["loggingTime(txt)",
           "accelerometerTimestamp_sinceReboot(s)", *(f"accelerometerAcceleration{a}(G)" for a in "XYZ"),
           *(f"gyroRotation{a}(rad/s)" for a in "XYZ")])),
    Export("SensorLog, iOS, user acceleration beside", text([SECONDS, X, Y, Z, *LINEAR], ["motionTimestamp(s)",
           *(f"accelerometerAcceleration{a}(G)" for a in "XYZ"), *(f"motionUserAcceleration{a}(G)" for a in "XYZ")]),
           said(**{f"u{a.lower()}": f"accelerometerAcceleration{a}(G)" for a in "XYZ"}), "--columns", channels=()),
    Export("AndroSensor", text([X, Y, Z, *LINEAR, *G, whole(MS)], [*(f"ACCELEROMETER {a} (m/s²)" for a in "XYZ"),
           *(f"LINEAR ACCELERATION {a} (m/s²)" for a in "XYZ"), *(f"GYROSCOPE {a} (rad/s)" for a in "XYZ"),
           "Time since start in ms"], ";"),
           said(**{f"u{a.lower()}": f"ACCELEROMETER {a} (m/s²)" for a in "XYZ"}), "--columns"),
    Export("several sensors below each other", text([
           [t for t in SECONDS for _ in range(2)], ["ACC", "GYR"] * N, *MIXED], ["time", "sensor", "x", "y", "z"]),
           Reading(where={"sensor": "ACC"}), "--where sensor=ACC"),
    Export("ActiGraph", text([X, Y, Z], ["Accelerometer X", "Accelerometer Y", "Accelerometer Z"], before=ACTIGRAPH)),
    Export("Axivity", text([ISO, X, Y, Z]), BY_NUMBER, "--columns"),
    Export("MetaWear", text([[1_709_993_100_000 + int(ms) for ms in MS], DOTTED,
           SECONDS, X, Y, Z], ["epoc (ms)", "timestamp (+0000)", "elapsed (s)", *(f"{a}-axis (g)" for a in "xyz")])),
    Export("Shimmer", text([[1_709_993_100_000.0 + float(ms) for ms in MS], X, Y, Z, *G], ["Shimmer_Timestamp_Unix_CAL",
           *(f"Shimmer_Accel_LN_{a}_CAL" for a in "XYZ"), *(f"Shimmer_Gyro_{a}_CAL" for a in "XYZ")], "\t",
           before='"sep=\t"\n').replace(b"_CAL\n", b"_CAL\nms\tm/(s^2)\tm/(s^2)\tm/(s^2)\tdeg/s\tdeg/s\tdeg/s\n", 1)),
    Export("Xsens DOT", text([list(range(N)), whole(MS * 1000), X, Y, Z, *G], ["PacketCounter", "SampleTimeFine",
           *(f"Acc_{a}" for a in "XYZ"), *(f"Gyr_{a}" for a in "XYZ")], before="DeviceTag:,A1\nFirmware:,2\n\n"),
           Reading(time_unit="us"), "--time-unit"),
    Export("Xsens MTw", text([list(range(500, 500 + N)), X, Y, Z], ["PacketCounter", "Acc_X", "Acc_Y", "Acc_Z"], "\t",
           before="// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human\n"), suffix=".txt"),
    Export("Gulf Coast X16", text([RUNS, *(whole(COUNTS[:, i]) for i in range(3))], None, before=X16),
           u=COUNTS.astype(float), t_ms=np.array(RUNS) * 1000),
    Export("enDAQ", text([ISO_Z, X, Y, Z], ["utc", '"X (100g)"', '"Y (100g)"', '"Z (100g)"'])),
    Export("ST evaluation tool", text([whole(MS), *(whole(np.rint(U[:, i] * 1000).astype(int)) for i in range(3)), *M],
           ["T [ms]", *(f"ACC_{a} [mg]" for a in "XYZ"), *(f"MAG_{a} [mG]" for a in "XYZ")]), u=np.rint(U * 1000)),
    Export("PX4, ulog2csv", text([whole(MS * 1000 + 5_000_000), X, Y, Z], ["timestamp",
           *(f"accelerometer_m_s2[{i}]" for i in range(3))]), Reading(time_unit="us"), "--time-unit"),
    Export("an oscilloscope", text([SECONDS, X, Y, Z], ["Second", "Volt", "Volt", "Volt"]), BY_NUMBER, "--columns"),
    Export("a row of units", text([SECONDS, X, Y, Z], NAMES).replace(b"\n", b"\ns,g,g,g\n", 1)),
    Export("the time of day", text([CLOCK, X, Y, Z], ["Time", "X", "Y", "Z"], "\t"), suffix=".txt"),
    Export("two sensors", text([SECONDS, X, Y, Z, *G], ["t", "x1", "y1", "z1", "x2", "y2", "z2"]),
           said(ux="x1", uy="y1", uz="z1"), "--columns", channels=()),
    Export("German dates", text([moments(lambda d: d.strftime("%d.%m.%Y %H:%M:%S,%f")[:-3]), X, Y, Z],
           ["Zeitstempel", "X", "Y", "Z"], ";", ",")),
    Export("American dates, twelve hours", text([moments(lambda d: d.strftime("%m/%d/%Y 2:%M:%S.%f PM")),
           X, Y, Z], ["Timestamp", "X", "Y", "Z"])),
    Export("MATLAB, datetimes", text([moments(lambda d: d.strftime("%d-%b-%Y %H:%M:%S.%f")[:-3]), X, Y, Z],
           ["Timestamp", "X", "Y", "Z"])),
    Export("pandas, indexed by time differences", text([[f"0 days 00:00:{s:09.6f}" for s in SECONDS], X, Y, Z],
           ["", "ax", "ay", "az"])),
    Export("GENEActiv", text([moments(lambda d: d.strftime("%Y-%m-%d %H:%M:%S:%f")[:-3]), X, Y, Z, T],
           before="Device Type,GENEActiv\nMeasurement Frequency,100.0 Hz\n\n"), BY_NUMBER, "--columns"),
    Export("Empatica", text([X, Y, Z], before="1709993100.0, 1709993100.0, 1709993100.0\n"),
           Reading({"ux": "1", "uy": "2", "uz": "3"}, rate=RATE, skip_bad=True), "--columns"),
    Export("Betaflight", text([list(range(N)), whole(MS * 1000), X, Y, Z, *G], ["loopIteration", " time (us)",
           *(f" accSmooth[{i}]" for i in range(3)), *(f" gyroADC[{i}]" for i in range(3))])),
    Export("DATAQ", text([SECONDS, X, Y, Z], before="Rate: 100\nRelative Time,CH1,CH2,CH3\n,Volt,Volt,Volt\n")),
    Export("a spreadsheet's days", text([[f"{45360 + ms / 86_400_000:.9f}" for ms in MS], X, Y, Z], NAMES),
           Reading(rate=RATE), "--rate"),
    Export("minutes", text([[f"{ms / 60000:.9f}" for ms in MS], X, Y, Z], ["Time (min)", "X", "Y", "Z"]),
           Reading(rate=RATE), "--rate"),
]  # fmt: skip
