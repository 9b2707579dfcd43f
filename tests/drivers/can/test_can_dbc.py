"""A DBC is read for its messages and signals alone; what it says of them is what cantools reads too."""

import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triaxcal_drivers.can.dbc import dbc_messages
from triaxcal_drivers.can.message import Message
from triaxcal_drivers.errors import ProfileError

HEAD = 'VERSION "1.0"\n\nNS_ :\n\tNS_DESC_\n\tCM_\n\nBS_:\n\nBU_: A B\n\n'


def read(text: str) -> list[Message]:
    return dbc_messages(text.encode("cp1252"), base_node_id=None, where="m.dbc")


def refusal(text: str) -> str:
    with pytest.raises(ProfileError) as caught:
        read(text)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@st.composite
def files(draw: st.DrawFn) -> str:
    """Messages with signals next to each other, of any kind that a DBC has, with or without blanks."""
    lines, types, number = [], [], 0
    for m in range(draw(st.integers(1, 4))):
        extended, size = draw(st.booleans()), draw(st.sampled_from([1, 8, 64]))
        identifier = (2**31 if extended else 0) + 100 + m
        lines.append(f"BO_ {identifier} M{m}{draw(st.sampled_from([':', ' : ']))}{size} A")
        for k in range(min(size, 8)):
            number += 1
            order, sign = draw(st.sampled_from("01")), draw(st.sampled_from("+-"))
            scale = draw(st.sampled_from(["1", "-0.5", "1E-06", "1.1920928955078125e-06", "+2"]))
            unit = draw(st.sampled_from(["V", "", "a:b|c@(", 'x\\"y', "BO_ 1 N: 8 A"]))
            blank = draw(st.sampled_from(["", " "]))
            place = f"{8 * k + 7 * (order == '0')}|8@{order}{sign}"
            lines.append(f' SG_ S{number}{blank} :{blank}{place} ({scale},{blank}{k}) [0|0] "{unit}" A,B')
        if size == 64 and draw(st.booleans()):
            lines.append(' SG_ F : 64|32@1- (1,0) [0|0] "" A')
            types.append(f"SIG_VALTYPE_ {identifier} F : 1;")
        lines.append("")
    phantom = 'BO_ 999 Phantom: 8 A\n SG_ P : 0|8@1+ (1,0) [0|0] \\"\\" A'
    comment = draw(st.sampled_from(["", f'CM_ BO_ 100 "two lines\n{phantom}\n";\n']))
    return HEAD + "\n".join(lines) + "\n" + comment + "\n".join(types) + "\n"


@pytest.mark.slow
@settings(deadline=None)
@given(files())
def test_messages_and_signals_are_those_that_cantools_reads(text: str) -> None:
    theirs = cantools.database.load_string(text, "dbc", strict=False)
    ours = read(text)
    assert [(m.name, m.identifier, m.extended) for m in ours] == [
        (m.name, m.frame_id, m.is_extended_frame) for m in theirs.messages
    ]
    for mine, other in zip(ours, theirs.messages, strict=True):
        assert sorted(
            (s.name, s.start, s.length, s.big_endian, s.signed, s.is_float, s.scale, s.offset)
            for s in mine.signals.values()
        ) == sorted(
            (s.name, s.start, s.length, s.byte_order == "big_endian", s.is_signed, s.conversion.is_float,
             float(s.scale), float(s.offset))
            for s in other.signals
        )  # fmt: skip


MULTIPLEXED = (
    "BO_ 100 M: 8 A\n"
    ' SG_ Which M : 0|8@1+ (1,0) [0|0] "" A\n'
    ' SG_ One m0 : 8|8@1+ (1,0) [0|0] "" A\n'
    ' SG_ Two m1M : 8|8@1+ (1,0) [0|0] "" A\n'
    ' SG_ Three m5 : 16|8@1+ (1,0) [0|0] "" A\n'
)


@pytest.mark.parametrize(
    "ranges",
    [
        "",
        "SG_MUL_VAL_ 100 One Which 0-0;\nSG_MUL_VAL_ 100 Two Which 1-1;\nSG_MUL_VAL_ 100 Three Two 5-5;\n",
        "SG_MUL_VAL_ 100 One Which 0-0, 3-3;\nSG_MUL_VAL_ 100 Two Which 1-1;\nSG_MUL_VAL_ 100 Three Two 0-2, 7-9;\n",
        "SG_MUL_VAL_ 100 One Which 0-0,\n 3-3;\nSG_MUL_VAL_ 100 Two Which 1-1;\nSG_MUL_VAL_ 100 Three Two\n 2-7;\n",
    ],
)
def test_multiplexed_signals_are_in_the_frames_in_which_cantools_finds_them(ranges: str) -> None:
    text = HEAD + MULTIPLEXED + "\n" + ranges
    (ours,) = read(text)
    (theirs,) = cantools.database.load_string(text, "dbc", strict=False).messages
    assert list(ours.signals) == ["Which", "One", "Two", "Three"]
    for which in range(6):
        for two in range(10):
            data = bytes([which, two, 0, 0, 0, 0, 0, 0])
            octets = np.frombuffer(data, np.uint8)[None]
            held = {n for n, s in ours.signals.items() if all(each.holds(octets)[0] for each in s.selected)}
            try:
                found = set(theirs.decode(data, decode_choices=False))
            except cantools.database.DecodeError:  # a selector that selects nothing
                found = None
            assert found is None or held == found


def test_long_names_take_the_place_of_short_ones_as_in_cantools() -> None:
    text = HEAD + 'BO_ 100 Short: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" A\n\n'
    for kind, what in (("BO_", "Message"), ("SG_", "Signal")):
        text += f'BA_DEF_ {kind} "System{what}LongSymbol" STRING ;\nBA_DEF_DEF_ "System{what}LongSymbol" "";\n'
    text += 'BA_ "SystemMessageLongSymbol" BO_ 100 "A_long_name";\n'
    text += 'BA_ "SystemSignalLongSymbol" SG_ 100 S "Longer";\n'
    (theirs,) = cantools.database.load_string(text, "dbc").messages
    (ours,) = read(text)
    assert (ours.name, [*ours.signals]) == (theirs.name, [s.name for s in theirs.signals])
    assert (ours.name, [*ours.signals]) == ("A_long_name", ["Longer"])


def test_signals_of_no_message_are_passed_over() -> None:
    loose = 'BO_ 3221225472 VECTOR__INDEPENDENT_SIG_MSG: 0 A\n SG_ Loose : 0|8@1+ (1,0) [0|0] "" A\n'
    assert [m.name for m in read(HEAD + loose + "\nBO_ 1 M: 8 A\n")] == ["M"]


def test_lines_of_other_tools_that_cantools_refuses_are_passed_over() -> None:
    text = HEAD.replace("BS_:", "BS_: 1000000 : 0,0") + 'BO_ 100 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|0] "" A\n\n'
    text += 'BA_DEF_ BO_ "x" ENUM "false","true";\nBA_DEF_DEF_ "x" true;\n'
    with pytest.raises(cantools.database.UnsupportedDatabaseFormatError):
        cantools.database.load_string(text, "dbc", strict=False)
    assert [(m.name, [*m.signals]) for m in read(text)] == [("M", ["S"])]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "there is no message in it (BO_)"),
        ("root:x:0:0:root:/root:/bin/bash\n", "line 1: expected a keyword of DBC"),
        (HEAD + ' SG_ S : 0|8@1+ (1,0) [0|0] "" A\n', "line 11: a signal (SG_) of no message"),
        (HEAD + "BO_ 1 M 8 A\n", "line 11: expected BO_ identifier name: bytes sender"),
        (HEAD + "BO_ 1 M: 8 A\n SG_ S : 0|8@1+ 1\n", "line 12: expected SG_ name : start|length@order sign"),
        (HEAD + "BO_ 1 M: 8 A\n SG_ S : 0|8@1+ (1e999,0)\n", "line 12: signal 'S': expected a finite scale"),
        (HEAD + "BO_ 2048 M: 8 A\n", "message 'M' has the identifier 2048, which CAN has not"),
        (HEAD + "BO_ 1 M: 8 A\nSIG_VALTYPE_ 1 S : 9;\n", "line 12: expected SIG_VALTYPE_"),
    ],
)
def test_what_is_wrong_is_told_with_its_line_and_not_shown(text: str, words: str) -> None:
    message = refusal(text)
    assert words in message
    assert "root" not in message


def test_a_vehicle_of_tens_of_thousands_of_signals_is_read() -> None:
    per = "".join(f' SG_ S{k} : {8 * k}|8@1+ (1,0) [0|0] "V" A\n' for k in range(8))
    values = "".join(f'VAL_ {2**31 + i} S0 0 "off" 1 "on" 2 "faulty" ;\n' for i in range(2500))
    messages = read(HEAD + "".join(f"BO_ {2**31 + i} M{i}: 8 A\n{per}\n" for i in range(2500)) + values)
    assert (len(messages), sum(len(m.signals) for m in messages)) == (2500, 20_000)


FORMATS = (
    'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
    'BA_DEF_DEF_ "VFrameFormat" "{default}";\n'
)
PGN = 2**31 + 0x18FEF100


@pytest.mark.parametrize("length", [65, 1785, 1786, 65536, 4294967295, 9999999999])
def test_a_message_that_is_longer_than_a_frame_is_refused_by_its_name(length: int) -> None:
    message = refusal(HEAD + f"BO_ 100 X: {length} A\n")
    assert f"message 'X' has {length} bytes, expected at most 64" in message


@pytest.mark.parametrize("length", [0, 8, 10, 64])
def test_a_message_that_fits_a_frame_is_read(length: int) -> None:
    assert [m.length for m in read(HEAD + f"BO_ 100 X: {length} A\n")] == [length]


@pytest.mark.parametrize("said", ['BA_ "VFrameFormat" BO_ {n} 3;', 'BA_ "VFrameFormat" BO_ {n} "J1939PG";', ""])
@pytest.mark.parametrize("length", [65, 1785, 1786])
def test_a_message_of_j1939_may_have_all_that_its_transport_carries(length: int, said: str) -> None:
    text = HEAD + f"BO_ {PGN} X: {length} A\n"
    text += FORMATS.format(default="StandardCAN" if said else "J1939PG") + said.format(n=PGN) + "\n"
    if length <= 1785:
        assert [m.length for m in read(text)] == [length]
        if "J1939PG" in said:  # cantools takes only the number
            return
        (theirs,) = cantools.database.load_string(text, "dbc", strict=False).messages
        assert theirs.protocol == "j1939"
    else:
        assert "message 'X' has 1786 bytes, expected at most 1785 as a J1939 message" in refusal(text)


@pytest.mark.parametrize(
    "text",
    [
        f"BO_ {PGN} X: 100 A\n" + FORMATS.format(default="J1939PG") + f'BA_ "VFrameFormat" BO_ {PGN} 1;\n',
        f"BO_ {PGN} X: 100 A\n" + FORMATS.format(default="StandardCAN") + f'BA_ "VFrameFormat" BO_ {PGN + 1} 3;\n',
        "BO_ 100 X: 100 A\n" + FORMATS.format(default="J1939PG"),  # an identifier of 11 bits
        f"BO_ {PGN} X: 100 A\n" + 'BA_ "ProtocolType" "J1939";\n',
    ],
)
def test_a_message_that_is_none_of_j1939_may_not(text: str) -> None:
    assert "message 'X' has 100 bytes, expected at most 64" in refusal(HEAD + text)


@pytest.mark.parametrize("at", ["64|8@1+", "63|2@1+", "71|8@0+", "56|2@0+", "4294967295|1@1+", "9999999999|8@0-"])
def test_a_signal_outside_of_its_message_is_refused(at: str) -> None:
    message = refusal(HEAD + f'BO_ 1 M: 8 A\n SG_ S : {at} (1,0) [0|0] "" A\n')
    assert "signal 'S' does not fit the 8 bytes of message 'M'" in message


@pytest.mark.parametrize("length", [0, 65, 4000000000, 9999999999])
@pytest.mark.parametrize("value_type", ["", "SIG_VALTYPE_ 1 S : 1;\n"])
def test_a_signal_of_no_size_that_a_number_has_is_refused(length: int, value_type: str) -> None:
    message = refusal(HEAD + f'BO_ 1 M: 64 A\n SG_ S : 0|{length}@1+ (1,0) [0|0] "" A\n' + value_type)
    assert f"signal 'S' of message 'M' has {length} bits, expected 1 to 64" in message


@pytest.mark.parametrize("at", ["0|64@1+", "63|1@1+", "7|64@0+", "56|1@0+"])
def test_a_signal_at_the_edge_of_its_message_is_read(at: str) -> None:
    (message,) = read(HEAD + f'BO_ 1 M: 8 A\n SG_ S : {at} (1,0) [0|0] "" A\n')
    assert [*message.signals] == ["S"]
