"""EDS and DCF as people and tools write them: what a TPDO holds is read from each, or its fault is named."""

import struct

import numpy as np
import pytest

from triaxcal_drivers.can.driver import CanDecoder
from triaxcal_drivers.can.eds import EDS_MOST, number
from triaxcal_drivers.can.layout import Layout, stream_layout
from triaxcal_drivers.can.model import PdoStream
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.interface import RawBatch

NODE = 5
READINGS = [(1000, -2000, 30000), (-32768, 32767, 0)]
STREAM = PdoStream(layout="pdo", eds="a.eds", channels={f"u{x}": f"0x6010:0{i}" for i, x in enumerate("xyz", 1)})
HEAD = "[FileInfo]\nFileName=a.eds\n[DeviceInfo]\nVendorName=ACME\n"


def section(name: str, *entries: str, kind: int = 7, data_type: int = 7) -> str:
    head = [f"[{name}]", f"ParameterName={name}", f"ObjectType=0x{kind:X}"]
    return "\n".join([*head, *([f"DataType=0x{data_type:04X}", "AccessType=rw"] if kind == 7 else []), *entries, ""])


def tpdo(number_: int, cob_id: str, mapped: list[str], *, key: str = "DefaultValue", base: int = 0x6010) -> str:
    """TPDO 1 … and the three int16 that it maps."""
    comm, mapping = f"{0x17FF + number_:04X}", f"{0x19FF + number_:04X}"
    text = section(comm, "SubNumber=2", kind=9) + section(f"{comm}sub1", cob_id)
    text += section(mapping, "SubNumber=4", kind=9) + section(f"{mapping}sub0", f"{key}={len(mapped)}", data_type=5)
    text += "".join(section(f"{mapping}sub{i}", f"{key}={word}") for i, word in enumerate(mapped, 1))
    text += section(f"{base:04X}", "SubNumber=4", kind=9)
    return text + "".join(section(f"{base:04X}sub{i}", data_type=3) for i in (1, 2, 3))


MAPPED = ["0x60100110", "0x60100210", "0x60100310"]
COB_ID = "DefaultValue=$NODEID+0x180"
PLAIN = HEAD + tpdo(1, COB_ID, MAPPED)
COMPACT = (
    HEAD
    + section("1800", "SubNumber=2", kind=9)
    + section("1800sub1", COB_ID)
    + "[1A00]\nParameterName=m\nObjectType=8\nDataType=7\nAccessType=rw\nCompactSubObj=3\n"
    + "[1A00Value]\nNrOfEntries=3\n"
    + "".join(f"{i}={word}\n" for i, word in enumerate(MAPPED, 1))
    + "[6010]\nParameterName=a\nObjectType=8\nDataType=3\nAccessType=ro\nCompactSubObj=3\n"
)


def layout(text: str | bytes) -> Layout:
    data = text.encode() if isinstance(text, str) else text
    return stream_layout(STREAM, {"a.eds": data}, where="test")


def decoded(found: Layout, identifier: int) -> list[list[float]]:
    rows = [(k * 10**7, identifier, 0, struct.pack("<3h", *row)) for k, row in enumerate(READINGS)]
    readings: list[list[float]] = CanDecoder(found, rate_hz=100.0).feed(RawBatch.of(rows)).readings.tolist()
    return readings


def reordered(text: str) -> str:
    head, *rest = text.split("[")
    return head + "[" + "[".join(reversed(rest))


@pytest.mark.parametrize(
    "text",
    [
        pytest.param(PLAIN, id="plain"),
        pytest.param(PLAIN + "[DummyUsage]\n", id="no Dummy keys"),
        pytest.param(PLAIN + "[DummyUsage]\nDummy0005=1\nDummy0002=\n", id="some Dummy keys"),
        pytest.param(PLAIN + "[Comments]\n", id="comments without Lines"),
        pytest.param(PLAIN.replace("VendorName=ACME", "NrOfTXPDO=\nBaudRate_125=yes\nGranularity="), id="device info"),
        pytest.param(PLAIN.replace("[DeviceInfo]\nVendorName=ACME\n", ""), id="no device info"),
        pytest.param(PLAIN.replace("$NODEID", "$NodeID"), id="$NodeID"),
        pytest.param(PLAIN.replace("$NODEID", "$nodeid"), id="$nodeid"),
        pytest.param(PLAIN.replace("$NODEID+0x180", " 0x180 + $NODEID "), id="node last"),
        pytest.param(PLAIN.replace("$NODEID+0x180", "$NODEID+384"), id="decimal"),
        pytest.param(PLAIN.replace("$NODEID+0x180", "$NODEID+0600"), id="octal"),
        pytest.param(PLAIN.replace("$NODEID+0x180", "$NodeId+0x40000180"), id="no RTR"),
        pytest.param(HEAD + tpdo(1, "ParameterValue=$NodeID+0x180\nDefaultValue=0x80000000", MAPPED), id="DCF, COB-ID"),
        pytest.param(HEAD + tpdo(1, "ParameterValue=\n" + COB_ID, MAPPED), id="DCF, empty value"),
        pytest.param(HEAD + tpdo(1, COB_ID, MAPPED, key="ParameterValue"), id="DCF, mapping"),
        pytest.param(
            PLAIN.replace("DefaultValue=0x6010", "DefaultValue=0x60110110\nParameterValue=0x6010"), id="DCF, both"
        ),
        pytest.param(PLAIN.lower().replace("$nodeid", "$NODEID"), id="lower case"),
        pytest.param(PLAIN.replace("sub", "SUB").replace("1A00", "1a00"), id="section names"),
        pytest.param(PLAIN.replace("\n", "\r\n").replace("[1800]", "[ 1800 ]").replace("=", " = "), id="blanks"),
        pytest.param(b"\xef\xbb\xbf" + PLAIN.encode(), id="byte order mark"),
        pytest.param(PLAIN.replace("ACME", "M\xfcller").encode("cp1252"), id="cp1252"),
        pytest.param(reordered(PLAIN), id="another order"),
        pytest.param(PLAIN.replace("ObjectType=0x9\n", ""), id="no object type"),
        pytest.param(
            PLAIN.replace("ParameterName=6010sub2\n", "").replace("AccessType=rw\n", ""), id="no name, access"
        ),
        pytest.param(
            PLAIN + section("1F50", kind=2) + "[0040]\nParameterName=t\nObjectType=6\n[0040sub1]\nDefaultValue=5\n",
            id="domain and record type",
        ),
        pytest.param(PLAIN + tpdo(3, "PDOMapping=0", ["0x60200110"], base=0x6020), id="another has no COB-ID"),
        pytest.param(PLAIN + tpdo(3, "DefaultValue=0x80000000", ["0x70000110"], base=0x6020), id="another disabled"),
        pytest.param(COMPACT, id="compact storage"),
    ],
)
def test_the_readings_of_a_node_are_decoded(text: str | bytes) -> None:
    found = layout(text)
    (message,) = found.messages
    assert (message.identifier_of(NODE), message.extended) == (0x180 + NODE, False)
    np.testing.assert_array_equal(decoded(found, 0x180 + NODE), READINGS)


def test_a_dcf_for_one_node_keeps_its_identifier() -> None:
    found = layout(HEAD + tpdo(1, "DefaultValue=$NODEID+0x180\nParameterValue=0x2A3", MAPPED))
    assert [m.identifier_of(node) for m in found.messages for node in (1, 7)] == [0x2A3, 0x2A3]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD + tpdo(1, "DefaultValue=$NODEID+0x80000180", MAPPED), ["'0x6010:01'", "TPDO1 is disabled", "bit 31"]),
        (HEAD + tpdo(2, COB_ID + "\nParameterValue=0xC0000285", MAPPED), ["TPDO2 is disabled", "0x1801:01"]),
        (PLAIN + section("6010sub3", data_type=3), ["[6010sub3] a second time", "first in line"]),
        (PLAIN + section("6010SUB3", data_type=3), ["[6010SUB3] a second time"]),
        (PLAIN + section("6010sub03", data_type=3), ["0x6010:03 a second time"]),
        (PLAIN + section("1A00", kind=9), ["[1A00] a second time"]),
        (PLAIN.replace(COB_ID, f"{COB_ID}\ndefaultvalue=0x200"), ["defaultvalue of [1800sub1] a second time"]),
        (PLAIN.replace("$NODEID+0x180", "$NODE+0x180"), ["0x1800:01", "'$NODE+0x180'"]),
        (PLAIN.replace("$NODEID+0x180", "$NODEID+$NODEID"), ["0x1800:01", "expected a number"]),
        (PLAIN.replace("DefaultValue=$NODEID+0x180", "DefaultValue="), ["0x1800:01 has no default value"]),
        (PLAIN.replace("DefaultValue=0x60100210\n", ""), ["0x1A00:02 has no default value"]),
        (HEAD, ["no object"]),
        ("ParameterName=a\n" + PLAIN, ["line 1: expected [section]"]),
        (PLAIN + "[1A01Name]\nNrOfEntries=4000000000\n", ["NrOfEntries=4000000000"]),
        (PLAIN + " " * EDS_MOST, ["larger than"]),
        (
            HEAD + "".join(f"[{i:04X}]\nObjectType=8\nCompactSubObj=64\nDataType=7\n" for i in range(0x1A00, 0x1B00)),
            ["CompactSubObj", "more than 5000"],
        ),
    ],
)
def test_what_is_wrong_is_named_in_one_line(text: str, said: list[str]) -> None:
    with pytest.raises(ProfileError) as caught:
        layout(text)
    message = str(caught.value)
    assert message.startswith("a.eds")
    assert "\n" not in message
    assert [part for part in said if part not in message] == []


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("0x1A", (26, False)),
        ("0X1a", (26, False)),
        ("010", (8, False)),
        ("09", (9, False)),
        ("0", (0, False)),
        ("$NODEID", (0, True)),
        ("$nodeid + 0x200 + 1", (513, True)),
        ("", None),
        ("-1", None),
        ("0x", None),
        ("1e3", None),
        ("²", None),
    ],
)
def test_numbers(text: str, found: tuple[int, bool] | None) -> None:
    assert number(text) == found
