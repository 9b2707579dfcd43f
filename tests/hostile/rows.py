"""A table of hostile inputs: what each is, the command that is given it, and how that has to end."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode

from tests.hostile.mcap_bytes import attachment, channel, chunk, message, metadata, raw, record, whole
from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.recording import schema

RECORDING = Path(__file__).parents[2] / "recordings" / "can-second-order.mcap"
SECRET = "root:$6$secret:19000:0:99999:7:::"
STATION = 'format = "triaxcal.station/1"\nname = "bench"\n[[units]]\nname = "a"\nprofile = "{profile}"\nbus = {bus}\n'
BUS = '{ interface = "none", channel = 0, node_id = 5 }'
DEVICE = 'format = "triaxcal.device/1"\nprofile = "triax-ref-modbus"\nbus = { host = "127.0.0.1", port = 0 }\n'
DBC_HEAD = 'VERSION ""\n\nBU_: A\n\nBO_ 389 M: 8 A\n'
SIGNAL = ' SG_ {name} : {place} (1,0) [0|0] "" A\n'
HEADER = "t_s,ux,uy,uz\n"
LINEAR = '"format": "triaxcal.calibration/1", "scale_factor": [1, 1, 1], "misalignment": [0, 0, 0], "bias": [0, 0, 0]'


@dataclass(frozen=True)
class Row:
    """``make`` puts files into a folder and gives the command's words."""

    what: str
    make: Callable[[Path], list[str]]
    code: int
    words: str


# TOML: stations, devices and profiles


def station(text: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        (folder / "station.toml").write_bytes(text.encode("utf-8", "surrogateescape"))
        return ["run", "station.toml"]

    return make


def device(text: str) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        (folder / "device.toml").write_text(DEVICE + text)
        return ["sim", "device.toml"]

    return make


def profile(
    old: str, new: str, *, name: str = "triax-ref-can", dbc: Callable[[Path], None] | None = None
) -> Callable[[Path], list[str]]:
    """A station whose unit has a built-in profile with one thing changed, in a folder of its own."""

    def make(folder: Path) -> list[str]:
        own = folder / "profile"
        own.mkdir()
        for file in BUILT_IN.glob("triax-ref-can.*"):
            shutil.copy(file, own)
        text = (BUILT_IN / f"{name}.toml").read_text()
        assert old in text
        (own / f"{name}.toml").write_text(text.replace(old, new, 1))
        (folder / "secret").write_text(SECRET + "\n")
        if dbc is not None:
            dbc(own / "triax-ref-can.dbc")
        bus = BUS if name == "triax-ref-can" else '{ host = "127.0.0.1", port = 1 }'
        (folder / "station.toml").write_text(STATION.format(profile=f"profile/{name}.toml", bus=bus))
        return ["run", "station.toml"]

    return make


def named(file: str, put: Callable[[Path], None] | None = None) -> Callable[[Path], list[str]]:
    """A profile that names another file as its DBC."""
    return profile('file = "triax-ref-can.dbc"', f'file = "{file}"', dbc=put)


def put(content: str | bytes) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())

    return write


def dbc(content: str | bytes) -> Callable[[Path], list[str]]:
    return profile("[", "[", dbc=put(content))


def _vehicle(path: Path) -> None:
    line = "".join(SIGNAL.format(name=f"S{k}", place=f"{8 * k}|8@1+") for k in range(8))
    path.write_text("".join(f"BO_ {2**31 + i} M{i}: 8 A\n{line}" for i in range(20_000)))


def _huge(path: Path) -> None:
    with open(path, "r+b") as file:
        file.truncate(2**32)


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(target: str) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        path.unlink()
        path.symlink_to(target)

    return make


def eds(old: str, new: str) -> Callable[[Path], list[str]]:
    """A profile laid out by an EDS in which one thing is changed."""

    def make(folder: Path) -> list[str]:
        words = named("triax-ref-can.dbc")(folder)
        own = folder / "profile"
        text = (own / "triax-ref-can.toml").read_text()
        head, tail = text.split("[streams.readings]", 1)
        rest = tail[tail.index("[streams.corrected]") :]
        channels = ", ".join(f'u{axis} = "0x2300:0{i}"' for i, axis in enumerate("xyz", 1))
        stream = f'layout = "pdo"\neds = "triax-ref-can.eds"\ncounter = "0x2300:04"\nchannels = {{ {channels} }}\n'
        (own / "triax-ref-can.toml").write_text(f"{head}[streams.readings]\n{stream}{rest}")
        file = own / "triax-ref-can.eds"
        held = file.read_text()
        assert old in held
        file.write_text(held.replace(old, new, 1))
        return words

    return make


def unit_profile(path: str, make: Callable[[Path], None] | None = None) -> Callable[[Path], list[str]]:
    """A station that names this file as its unit's profile."""

    def write(folder: Path) -> list[str]:
        (folder / "secret").write_text(SECRET)
        if make is not None:
            (folder / path).touch()
            make(folder / path)
        (folder / "station.toml").write_text(STATION.format(profile=path, bus=BUS))
        return ["run", "station.toml"]

    return write


EDS_OBJECT = "[3000]\nParameterName=x\nObjectType=0x8\n[3000sub1]\nParameterName=x\nDataType=0x7\nAccessType=rw\n"
STEPS = 'unlock = [{ write = "unlock_key", value = 0x5A17 }]'
TOML = [
    Row("100,000 arrays in each other", station("a = " + "[" * 100_000), 2, "nested more than 16 deep"),
    Row("inline tables in each other", station("a = " + "{a=" * 50_000), 2, "nested more than 16 deep"),
    Row("a key of 100,000 parts", station("a" + ".a" * 100_000 + " = 1"), 2, "a key of more than 16 parts"),
    Row("a key of quoted parts", station('"a" ' + ". 'a' " * 30_000 + " = 1"), 2, "a key of more than 16 parts"),
    Row("a header of 100,000 parts", station("[a" + ".a" * 100_000 + "]"), 2, "a key of more than 16 parts"),
    Row("an integer of 100,000 digits", station("a = " + "9" * 100_000), 2, "a word or number of 100000 characters"),
    Row("a hexadecimal one", device("seed = 0x" + "f" * 100_000), 2, "a word or number of 100002 characters"),
    Row("an integer of 5000 digits", device("speed = " + "9" * 5000), 2, "a word or number of 5000 characters"),
    Row("a gigabyte", lambda f: (put("")(f / "s.toml"), _huge(f / "s.toml"), ["run", "s.toml"])[2], 2, "larger than"),
    Row("an array of empty tables", station(STATION.split("[[")[0] + "units = [" + "{}," * 80_000 + "]"), 2, "units"),
    Row("steps that are none", profile(STEPS, f"unlock = [{'{},' * 80_000}]"), 2, "sequences.unlock"),
    Row("30,000 unknown keys", station("".join(f"a{i}=1\n" for i in range(29_000))), 2, "unknown key"),
    Row("30,000 registers that are none", profile("[crc]", "".join(f"a{i}=1\n" for i in range(27_000)) + "[crc]"), 2,
        "registers.a0"),
    Row("a date for a number", profile("rate_hz = 100.0", "rate_hz = 1979-05-27"), 2, "sampling.rate_hz"),
    Row("a NUL", station("a = \0"), 2, "not TOML"),
    Row("a byte order mark", station("\ufeffa = 1"), 2, "not TOML"),
    Row("no UTF-8", station("a = \udcff"), 2, "not UTF-8"),
    Row("a text without an end", station('"' + '\\"' * 100_000), 2, "not TOML"),
    Row("a line that would be two", station('format = "a\\nb\\u001b[2J"'), 2, "a\\nb\\x1b[2J"),
    Row("a driver of 200,000 letters", profile('driver = "can"', f'driver = "{"x" * 200_000}"'), 2, "no driver named"),
]  # fmt: skip
PATHS = [
    Row("a DBC above the profile", named("../secret"), 2, "outside the profile's folder"),
    Row("an absolute DBC", named("/etc/hostname"), 2, "outside the profile's folder"),
    Row("a device", named("/dev/zero"), 2, "outside the profile's folder"),
    Row("a link to a file above", named("triax-ref-can.dbc", _link("../secret")), 2, "outside the profile's folder"),
    Row("a link to a device", named("triax-ref-can.dbc", _link("/dev/zero")), 2, "outside the profile's folder"),
    Row("a link to itself", named("triax-ref-can.dbc", _link("triax-ref-can.dbc")), 2, "symbolic links"),
    Row("a pipe", named("triax-ref-can.dbc", _fifo), 2, "a device or a pipe, expected a file"),
    Row("a folder", named("triax-ref-can.dbc", _folder), 2, "Is a directory"),
    Row("a DBC of 4 GiB", named("triax-ref-can.dbc", _huge), 2, "larger than the 16 MiB"),
    Row("a name with a NUL", named("a\\u0000b"), 2, "no file has such a name"),
    Row("a pipe for a profile", unit_profile("p.toml", _fifo), 2, "p.toml: a device or a pipe, expected a file"),
    Row("a device for a profile", unit_profile("/dev/zero"), 2, "/dev/zero: a device or a pipe, expected a file"),
    Row("a foreign file for a profile", unit_profile("secret"), 2, "secret: not TOML"),
    Row("a pipe for an EEPROM", lambda f: (os.mkfifo(f / "e"), device('eeprom = "e"')(f))[1], 2, "a device or a pipe"),
    Row("a long file for an EEPROM", lambda f: (put("x" * 9999)(f / "e"), device('eeprom = "e"')(f))[1], 2, "larger"),
]
DESCRIPTIONS = [
    Row("a start bit of 2^32", dbc(DBC_HEAD + SIGNAL.format(name="Ux", place="4294967296|8@1+")), 2, "does not fit"),
    Row("a length of 2^32", dbc(DBC_HEAD + SIGNAL.format(name="Ux", place="0|4294967296@1+")), 2, "expected 1 to 64"),
    Row("a message of 2^32 bytes", dbc(DBC_HEAD.replace(": 8", ": 4294967295")), 2, "expected at most 64"),
    Row("160,000 signals", profile("[", "[", dbc=_vehicle), 2, "more than 100000 messages and signals"),
    Row("2^32 multiplexer values", dbc(DBC_HEAD + "\nSG_MUL_VAL_ 389 S M 0-4294967295;\n"), 2, "no signal 'Ux'"),
    Row("16 million quotes", dbc('"' * (2**24 - 1)), 2, "more than 1000000 statements"),
    Row("a text without an end in a DBC", dbc(DBC_HEAD + '"' + '\\"' * 2**22), 2, "no signal 'Ux'"),
    Row("a number of a million digits", dbc(DBC_HEAD + " SG_ S : 0|8@1+ (" + "9" * 10**6), 2, "line 6: expected SG_"),
    Row("a foreign file for a DBC", dbc(SECRET), 2, "not a DBC file: line 1"),
    Row("a foreign file for an EDS", eds("[FileInfo]", f"{SECRET}\n[FileInfo]"), 2, "not an EDS file: line 1"),
    Row("4e9 entries of an array", eds("[1000]", f"{EDS_OBJECT}[3000Name]\nNrOfEntries=4000000000\n[1000]"), 2, "3000"),
    Row("4e9 lines of comment", eds("[Comments]", "[Comments]\nLines=4000000000\n[x]"), 2, "not an EDS file"),
    Row(
        "4e9 mapped objects",
        eds("DefaultValue=3\nPDOMapping=0\n\n[1A00sub1]", "DefaultValue=4000000000\n\n[1A00sub1]"),
        2,
        "object 0x1A00:04 has no default value",
    ),
    Row("100,000 sections", eds("[1000]", "".join(f"[s{i}]\n" for i in range(100_000)) + "[1000]"), 2, "30000 lines"),
    Row("500 kB of lines that are none", eds("[1000]", "[a]\n" + "x\n" * 25_000 + "[1000]"), 2, "not an EDS file"),
    Row("a line of blanks", eds("[1000]", f"[a]\nx{' ' * 900_000}y=1\ny\n[1000]"), 2, "not an EDS file"),
]

# Documents


def verify(content: str | bytes) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        put(content)(folder / "cal.json")
        return ["verify", "cal.json", str(RECORDING)]

    return make


def linear(**changed: str) -> Callable[[Path], list[str]]:
    return verify(json.dumps(json.loads("{" + LINEAR + "}")).removesuffix("}") + "".join(
        f', "{key}": {value}' for key, value in changed.items()
    ) + "}")  # fmt: skip


DOCUMENTS = [
    Row("100,000 lists in each other", verify("[" * 100_000), 2, "nested too deeply"),
    Row("objects in each other", verify('{"a":' * 100_000), 2, "nested too deeply"),
    Row("five million lists", verify("[" + "[]," * 5_000_000 + "[]]"), 2, "larger than the 4 MiB"),
    Row("a million lists", verify("[" + "[]," * 1_390_000 + "[]]"), 2, "more than 400000 lists and objects"),
    Row("a million lists in an object", verify('{"a": [' + "[]," * 1_390_000 + "[]]}"), 2, "more than 400000 lists"),
    Row("a list", verify("[" + "1," * 1000 + "1]"), 2, "expected a JSON object"),
    Row("an integer of 100,000 digits", linear(reference="9" * 100_000), 2, "not JSON that can be read"),
    Row("an integer of 4000 digits", linear(reference="9" * 4000), 2, "not numbers where numbers belong"),
    Row("NaN", linear(reference="NaN"), 2, "reference: expected a positive number"),
    Row("a key given twice", linear(bias="[1, 2, 3]"), 2, "the key 'bias' is given twice"),
    Row("half a surrogate pair", linear(units='{"reference": "\\ud800"}'), 2, "half of a surrogate pair"),
    Row("a list for an effect", linear(effects="[1]"), 2, "not numbers where numbers belong"),
    Row("100,000 effects", linear(effects=json.dumps({f"e{i}": {} for i in range(100_000)})), 2, "no effect of that"),
    Row("a number beyond all others", linear(effects=json.dumps({"temperature_bias": {a: {"value": 7} for a in "xyz"}})
        .replace("7", "1e400")), 2, "expected finite numbers"),
    Row("a pipe that nobody writes to", lambda f: (os.mkfifo(f / "p"), ["verify", "p", "x.csv"])[1], 2, "not JSON"),
    Row("a device for a document", lambda f: ["verify", "/dev/zero", "x.csv"], 2, "a device or a pipe"),
    Row("100,000 attitudes", lambda f: (put("label\n" + "+X\n" * 100_000)(f / "a.csv"),
        ["fit", str(RECORDING), "--attitudes", "a.csv"])[1], 2, "expected at most 10000"),
]  # fmt: skip

# Logs of others


def log(content: bytes, profile: str = "triax-ref-can") -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        put(content)(folder / "a.log")
        return ["log", "import", "a.log", "--profile", profile, "-o", "r.mcap"]

    return make


def mdf(*blocks: bytes) -> bytes:
    return b"MDF     4.11    " + bytes(12) + struct.pack("<H", 411) + bytes(34) + b"".join(blocks)


def mdf_block(kind: bytes, link: int, body: bytes = b"") -> bytes:
    return b"##" + kind + bytes(4) + struct.pack("<QQQ", 32 + len(body), 1, link) + body


def blf(container: bytes, size: int) -> bytes:
    body = struct.pack("<H6xI4x", 2, size) + container
    return (
        b"LOGG" + struct.pack("<I", 144) + bytes(136) + b"LOBJ" + struct.pack("<HHII", 16, 1, 16 + len(body), 10) + body
    )


FRAME = b"(1436509052.249713) can0 7FF#00\n"
NOTHING = "none of the profile's identifiers"
LOGS = [
    Row("a foreign file for a log", log(SECRET.encode()), 2, "no log of a known kind"),
    Row("a gzip bomb of frames", log(gzip.compress(FRAME + b"\n" * 2**26)), 2, "unpacks to more than 64 times"),
    Row("a line of 50 MB in a log", log(FRAME + b"(" * 50_000_000 + b"\n" + FRAME), 2, NOTHING),
    Row("times beyond all clocks", log(b"(999999999999.9) can0 185#0011223344556677\n" * 99), 2, "no sample in its 99"),
    Row("identifiers at random", log(b"".join(b"(1.0) c%d %08X#\n" % (i, i) for i in range(60_000))), 2, NOTHING),
    Row("a BLF container of 4 GiB", log(blf(zlib.compress(bytes(2**20)), 2**32 - 1)), 2, "of 4294967295 bytes"),
    Row("a BLF container of nothing", log(blf(zlib.compress(bytes(2**24)), 2**24)), 2, NOTHING),
    Row("a pcap packet of 4 GiB", log(struct.pack("<IHHiIIIIIII", 0xA1B2C3D4, 2, 4, 0, 0, 0, 227, 0, 0, 2**32 - 1, 0)),
        2, NOTHING),
    Row("an MF4 that leads back to itself", log(mdf(mdf_block(b"HD", 96), mdf_block(b"DG", 96))), 2,
        "byte 96: blocks that lead back to themselves"),
    Row("an MF4 group of 10^12 records", log(mdf(mdf_block(b"HD", 96), mdf_block(b"CG", 0,
        struct.pack("<QQHHIII", 0, 10**12, 0, 0, 0, 22, 0)))), 2, "byte 96: a group of 22000000000000 bytes"),
]  # fmt: skip

# Text tables


def table(content: str | bytes, name: str = "a.csv", options: Sequence[str] = ()) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        put(content)(folder / name)
        return ["poses", name, *options]

    return make


def _wide(columns: int) -> str:
    return ";".join(["n"] * columns) + "\n" + (";".join(["1"] * columns) + "\n") * 3


def _long_line(folder: Path) -> list[str]:
    with open(folder / "a.csv", "wb") as file:
        file.write(HEADER.encode())
        for _ in range(100):
            file.write(b"1" * 2**20)
    return ["poses", "a.csv"]


TABLES = [
    Row("200,000 columns", table(HEADER.strip() + "".join(f",c{i}" for i in range(200_000)) + "\n0\n"), 2,
        "200004 fields in the header, expected at most 1000"),
    Row("a row of 200,000 fields", table(HEADER + "0," * 200_000 + "0\n"), 2, "200001 fields, expected 4"),
    Row("a line of 100 MB", _long_line, 2, "no end of line"),
    Row("a number of 900,000 digits", table(HEADER + "0,1,2," + "1" * 900_000 + "x\n"), 2, "expected a finite number"),
    Row("a gzip bomb of samples", table(gzip.compress((HEADER + "0,1,2,3\n" * 500_000).encode(), 9)
        + gzip.compress(b"0,1,2,3\n" * 500_000, 9) * 100, "a.csv.gz"), 2, "unpacks to more than 200 times its size"),
    Row("a gzip bomb of comments", table(gzip.compress(b"#\n" * 2_000_000, 9) * 100, "a.csv.gz"), 2, "unpacks to more"),
    Row("a gzip bomb of NULs", table(gzip.compress(bytes(2**26)), "a.csv.gz"), 2, "unpacks to more than 200 times"),
    Row("quotes", table('"t_s","ux","uy","uz"\n' + '"' * 100_000 + "0,1,2,3\n0,1,2,3\n"), 2, "a finite number"),
    Row("times 300 years apart", table(HEADER + "".join(f"{i * 9e6!r},1,2,3\n" for i in range(1000)),
        options=("--time-unit", "s")), 0, ""),
    Row("a foreign table of 100,000 columns", table(_wide(100_000)), 2, "100000 fields, expected at most 1000"),
    Row("900 columns with one name", table(_wide(900)), 2, "no three outputs among the columns"),
    Row("a foreign table in one line", table("a;b;c;d;" + "1;" * 5_000_000), 2, "fields, expected at most 1000"),
    Row("a foreign table of quotes", table("t;x;y;z\n0;1;2;3\n" + '"' * 5_000_000 + "\n0,1;1;2;3\n"), 2, ""),
    Row("a foreign table of blanks", table("t x y z\n0 1 2 3\n" + " " * 20_000_000 + "\n0.1 1 2 3\n"), 2, "too short"),
    Row("100,000 words", table("t;x;y;z;w\n" + "".join(f"{i / 100};1;2;3;a{i}\n" for i in range(100_000))), 0, ""),
    Row("a gap after each sample", table(HEADER + "".join(f"{(i + 9 * (i % 3)) / 10!r},1,2,3\n"
        for i in range(0, 60_000, 3))), 0, ""),
    Row("a pipe for a table", lambda f: (os.mkfifo(f / "a.csv"), ["poses", "a.csv"])[1], 2, "empty file"),
    Row("a device for a table", lambda f: ["poses", "/dev/zero"], 2, "a device or a pipe"),
]  # fmt: skip

# Recordings


def recording(*records: bytes, command: tuple[str, ...] = ("log", "info")) -> Callable[[Path], list[str]]:
    def make(folder: Path) -> list[str]:
        (folder / "a.mcap").write_bytes(whole(*records))
        return [*command, "a.mcap"]

    return make


MIB = 2**20
EMPTY = record(0x80, b"")
RECOVER = ("log", "recover")
FLOOD = channel(schema.RAW) + message(raw(phase="calibration")) * 300_000
RECORDINGS = [
    Row("a chunk of empty records", recording(chunk(EMPTY * (15 * MIB // 9))), 2, "in a chunk"),
    Row("a chunk of messages of nothing", recording(chunk(FLOOD)), 2, "more messages than a file of its size"),
    Row("many chunks of nothing", recording(chunk(message(bytes(15 * MIB))) * 100), 2, "more than 64 times the file"),
    Row("a chunk that says 2^40", recording(chunk(b"", says=2**40)), 2, "unreadable chunk"),
    Row("a chunk that says less", recording(chunk(bytes(MIB), says=10)), 2, "fails its CRC"),
    Row("a chunk of lz4", recording(chunk(b"", compression="lz4")), 2, "expected zstd or no compression"),
    Row("a record of 2^63 bytes", recording(record(Opcode.METADATA, b"", 2**63), command=("poses",)), 2,
        "not finished, in the record"),
    Row("a long metadata record", recording(metadata("a", b="x" * 2 * MIB)), 2, "metadata record of"),
    Row("much metadata", recording(*(metadata("a", **{str(i): "x" * 60_000}) for i in range(20))), 2, "of metadata"),
    Row("100,000 attachments", recording(attachment("a", b"") * 2000, *(attachment(str(i), b"") for i in range(2000))),
        2, "more than 1000 attachments"),
    Row("an attachment of 40 MiB", recording(attachment("a", bytes(40 * MIB))), 2, "attachment record of"),
    Row("an index of 16 MiB", recording(record(Opcode.MESSAGE_INDEX, bytes(16 * MIB))), 2, "message index record of"),
    Row("a message of 2 million records", recording(chunk(channel(schema.RAW) + message(
        raw(phase="calibration", time_ns=range(10_000))))), 2, "10000 records in one message"),
    Row("a record of 70,000 bytes", recording(chunk(channel(schema.RAW) + message(
        raw(phase="calibration", time_ns=[0], source=[0], flags=b"\0", length=[70_000])))), 2, "a record of 70000"),
    Row("a packed field that says 2^60", recording(chunk(channel(schema.RAW) + message(
        b"\x1a" + b"\xff" * 8 + b"\x0f"))), 2, "not a message RawBatch"),
    Row("60,000 channels", recording(chunk(b"".join(channel(f"/{i}", i) for i in range(1, 60_000)))), 2,
        "more messages"),
    Row("a million places that look like records", recording(b"\x06\x09\x06\x09\x06\0\0\0\0" * 120_000,
        command=RECOVER), 2, "looks like records"),
    Row("chunks in chunks to be recovered", recording(*(record(Opcode.CHUNK, bytes(60) , 900_000 - 60 * i)
        for i in range(14_000)), command=RECOVER), 2, "looks like records"),
    Row("empty records to be recovered", recording(chunk(EMPTY * (15 * MIB // 9)), command=RECOVER), 3, "nothing to"),
    Row("a profile of 100,000 arrays in a recording", recording(attachment("profile.toml", b"a=" + b"[" * 100_000),
        command=("poses",)), 2, "nested more than 16 deep"),
    Row("a profile in a recording that names a foreign file", recording(attachment("profile.toml",
        (BUILT_IN / "triax-ref-can.toml").read_bytes().replace(b"triax-ref-can.dbc", b"/etc/hostname")),
        command=("poses",)), 2, "'/etc/hostname' that it names is missing"),
    Row("a pipe for a recording", lambda f: (os.mkfifo(f / "a.mcap"), ["poses", "a.mcap"])[1], 2, "a device or a pipe"),
]  # fmt: skip

# Files that are written


def linked(target: str, command: list[str]) -> Callable[[Path], list[str]]:
    """The command's output is a symbolic link."""

    def make(folder: Path) -> list[str]:
        (folder / "target").write_text(SECRET)
        (folder / "out").symlink_to(target)
        return command

    return make


FIT = ["fit", str(RECORDING)]
WRITTEN = [
    Row("a link to a file for a result", linked("target", [*FIT, "-o", "out"]), 2, "a symbolic link"),
    Row("a link to nothing", linked("nothing", [*FIT, "-o", "out"]), 2, "a symbolic link"),
    Row("a link for a report", linked("nothing", [*FIT, "--report", "out"]), 2, "a symbolic link"),
    Row("a link to a link", linked("out", [*FIT, "-o", "out"]), 2, "a symbolic link"),
    Row("a link for an export", linked("nothing", ["log", "export", str(RECORDING), "-o", "out"]), 2, "File exists"),
    Row("a link for a mended recording", linked("nothing", ["log", "recover", str(RECORDING), "-o", "out"]), 2,
        "exists"),
    Row("a link for an EEPROM", lambda f: (linked("nothing", [])(f), device('eeprom = "out"')(f))[1], 2,
        "a symbolic link"),
]  # fmt: skip
ROWS = [*TOML, *PATHS, *DESCRIPTIONS, *DOCUMENTS, *LOGS, *TABLES, *RECORDINGS, *WRITTEN]
