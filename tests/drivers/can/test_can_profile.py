"""Profiles and the files they name: what is wrong is said in one line, with the nearest right name."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from canopen.objectdictionary import datatypes

from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.eds import object_dictionary, pdo_messages
from triaxcal_drivers.can.layout import stream_layout
from triaxcal_drivers.can.model import CanBus, CanProfile, PdoStream, object_address
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.toml_text import validate

Edited = Callable[..., Bundle]
EDS = "triax-ref-can.eds"


def refusal(action: Callable[[], object]) -> str:
    with pytest.raises(ProfileError) as caught:
        action()
    message = str(caught.value)
    assert "\n" not in message
    return message


def opened(bundle: Bundle) -> Callable[[], object]:
    return lambda: CanDriver().decoder(bundle, "readings")


def test_a_missing_signal_is_named_with_the_nearest_one(edited: Edited) -> None:
    message = refusal(opened(edited(('"Ux"', '"Uxx"'))))
    assert message == (
        "triax-ref-can.dbc (profile triax-ref-can, streams.readings): no signal 'Uxx'; did you mean 'Ux'?"
    )


def test_a_missing_message_is_named_with_the_nearest_one(edited: Edited) -> None:
    message = refusal(opened(edited(('"Ux"', '"ReadingXY.Ux"'))))
    assert "triax-ref-can.dbc" in message
    assert "no message 'ReadingXY'; did you mean 'ReadingsXY'?" in message


def test_a_message_without_the_counter_is_named(edited: Edited) -> None:
    changed = edited(dbc=[("Counter : 48", "Count : 48")])
    message = refusal(opened(changed))
    assert "no signal 'Counter' (the counter) in message 'ReadingsXY'; did you mean 'Count'?" in message


def test_a_counter_of_differing_width_is_refused(edited: Edited) -> None:
    message = refusal(opened(edited(dbc=[("Counter : 48|16@1+", "Counter : 48|8@1+")])))
    assert "counter 'Counter' is 8 and 16 bits wide" in message


def test_a_sample_of_several_messages_needs_a_counter(edited: Edited) -> None:
    message = refusal(opened(edited(('counter = "Counter"\n', ""))))
    assert message.endswith(
        "a sample made of several messages (ReadingsXY, ReadingsZ) needs a counter, "
        'together = { begins = "…" } or together = "time"'
    )


@pytest.mark.parametrize(
    ("valid", "words"),
    [
        ('"Stat"', "no signal 'Stat'; did you mean 'Status'?"),
        ('"CorrectedZ.Status"', "valid: 'CorrectedZ.Status' is in no message of the sample (ReadingsXY, ReadingsZ)"),
        ('{ signal = "Status", values = [] }', "values"),
    ],
)
def test_a_signal_of_validity_belongs_to_the_sample(edited: Edited, valid: str, words: str) -> None:
    assert words in refusal(
        lambda: opened(edited(('counter = "Counter"\n', f'counter = "Counter"\nvalid = {valid}\n')))()
    )


def test_a_signal_in_several_messages_must_be_told_apart(edited: Edited) -> None:
    signals = [(f'{u} = "{s}"', f'{u} = "Temperature"') for u, s in (("ux", "Ux"), ("uy", "Uy"), ("uz", "Uz"))]
    rest = [('temp_c = "Temperature"\n', ""), ('status = "Status"\n', "")]
    message = refusal(opened(edited(*signals, *rest)))
    assert "'Temperature' is in several messages (ReadingsZ, CorrectedZ); name one of them" in message
    qualified = edited(*[(old, new.replace('"T', '"CorrectedZ.T')) for old, new in signals], *rest)
    assert opened(qualified)()


TWICE = [("BO_ 901 CorrectedXY", "BO_ 901 ReadingsXY")]


def test_a_message_whose_name_is_given_twice_goes_by_its_identifier_too(edited: Edited) -> None:
    signals = [(f'{u} = "{s}"', f'{u} = "ReadingsXY{{at}}.{s}"') for u, s in (("ux", "Ux"), ("uy", "Uy"))]

    def named(at: str) -> Callable[[], object]:
        return opened(edited(*((old, new.format(at=at)) for old, new in signals), dbc=TWICE))

    assert named("@0x185")()
    assert "no signal 'Ux' in message 'ReadingsXY@0x385'" in refusal(named("@0x385"))
    assert "no message 'ReadingsXY@0x186'; known: ReadingsXY@0x185, ReadingsXY@0x385" in refusal(named("@0x186"))
    assert "'ReadingsXY@185': expected an identifier as in ReadingsXY@0x19" in refusal(named("@185"))
    both = [("BO_ 901 CorrectedXY", "BO_ 901 ReadingsXY"), (" SG_ Ax ", " SG_ Ux "), (" SG_ Ay ", " SG_ Uy ")]
    message = refusal(opened(edited(dbc=both)))
    assert "'Ux' is in several messages (ReadingsXY@0x185, ReadingsXY@0x385); name one of them" in message


def test_identifiers_too_close_to_shift_with_the_node_are_refused(edited: Edited) -> None:
    message = refusal(opened(edited(dbc=[("BO_ 645", "BO_ 400"), ("CM_ SG_ 645", "CM_ SG_ 400")])))
    assert "'ReadingsXY' and 'ReadingsZ' are less than 127 identifiers apart" in message


def test_a_malformed_dbc_is_refused_with_its_line(edited: Edited) -> None:
    message = refusal(opened(edited(dbc=[("BO_ 645 ReadingsZ:", "BO_ 645 ReadingsZ")])))
    assert message.startswith("triax-ref-can.dbc: not a DBC file: ")
    assert "line 14" in message


def test_a_signal_that_its_message_cannot_hold_is_refused(edited: Edited) -> None:
    message = refusal(opened(edited(dbc=[("ReadingsXY: 8", "ReadingsXY: 7")])))
    assert message == "triax-ref-can.dbc: signal 'Counter' does not fit the 7 bytes of message 'ReadingsXY'"


def test_a_message_that_j1939_sends_in_several_frames_is_in_no_stream(edited: Edited) -> None:
    said = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
    said += 'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\nCM_ BO_ 901 '
    number = 2**31 + 389
    changed = edited(dbc=[("BO_ 389 ReadingsXY: 8", f"BO_ {number} ReadingsXY: 100"), ("CM_ BO_ 901 ", said)])
    message = refusal(opened(changed))
    assert "message 'ReadingsXY' has 100 bytes, which J1939 sends in several frames" in message


def test_a_stream_that_the_profile_lacks_is_named_with_the_nearest_one(bundle: Bundle) -> None:
    message = refusal(lambda: CanDriver().decoder(bundle, "correct"))
    assert message == "profile triax-ref-can: no stream 'correct'; did you mean 'corrected'?"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('layout = "dbc"', 'layout = "arxml"', "layout"),
        ('ux = "Ux"\n', "", "channels.ux is missing"),
        ("base_node_id = 5", "base_node_id = 200", "less than or equal to 127"),
        ("base_node_id = 5", "base_node = 5", "did you mean 'base_node_id'?"),
        ('object = "0x2106:00"', 'object = "2106"', "registers.reference_temperature.object"),
        ('ux = "Ux"', 'ux = { signal = "Ux", scale = 0.0 }', "scale must not be zero"),
    ],
)
def test_a_wrong_profile_is_refused(edited: Edited, old: str, new: str, said: str) -> None:
    message = refusal(lambda: edited((old, new)))
    assert message.startswith("unit.toml, line ")
    assert said in message


def test_a_profile_whose_dbc_is_not_there_is_refused(bundle: Bundle) -> None:
    message = refusal(lambda: parse_bundle(bundle.text, {}, where="unit.toml"))
    assert message == "unit.toml: the file 'triax-ref-can.dbc' that it names is missing"


@pytest.mark.parametrize("node_id", [0, 128])
def test_a_node_outside_1_to_127_is_refused(node_id: int) -> None:
    settings = {"interface": "virtual", "channel": "a", "node_id": node_id}
    assert "node_id" in refusal(lambda: validate(CanBus, settings, b"", where="station.toml"))


def test_register_bytes_are_least_significant_first(bundle: Bundle) -> None:
    profile = bundle.profile
    assert profile.encode("scale_factor_x", -2.4) == bytes.fromhex("9a9919c0")
    assert profile.decode("calibration_crc", bytes.fromhex("3412")) == 0x1234


def test_every_register_of_the_profile_is_an_object_of_the_eds(bundle: Bundle, profiles: Path) -> None:
    objects = object_dictionary((profiles / EDS).read_bytes(), node_id=5, where=EDS)
    kinds = {datatypes.UNSIGNED16: "uint16", datatypes.UNSIGNED32: "uint32", datatypes.REAL32: "float32"}
    assert isinstance(bundle.profile, CanProfile)
    assert len(bundle.profile.registers) == 51
    for name, register in bundle.profile.registers.items():
        variable = objects.get_variable(*object_address(register.object))
        assert variable is not None, name
        assert (kinds[variable.data_type], variable.access_type) == (register.type, register.access), name


def test_the_eds_maps_the_same_messages_as_the_dbc_describes(bundle: Bundle, profiles: Path) -> None:
    objects = object_dictionary((profiles / EDS).read_bytes(), node_id=0, where=EDS)
    tpdos = pdo_messages(objects)
    assert [(m.name, m.identifier, m.per_node) for m in tpdos] == [
        ("TPDO1", 0x180, True), ("TPDO2", 0x280, True), ("TPDO3", 0x380, True), ("TPDO4", 0x480, True),
    ]  # fmt: skip
    for stream, numbers in (("readings", (0, 1)), ("corrected", (2, 3))):
        layout = stream_layout(bundle.profile.streams[stream], bundle.files, where="test")
        for message, tpdo in zip(layout.messages, [tpdos[n] for n in numbers], strict=True):
            assert message.identifier == tpdo.identifier
            assert sorted((s.start, s.length, s.signed) for s in message.signals.values()) == sorted(
                (s.start, s.length, s.signed) for s in tpdo.signals.values()
            )


PDO: dict[str, Any] = {
    "layout": "pdo",
    "eds": EDS,
    "counter": "0x2300:04",
    "channels": {"ux": "0x2300:01", "uy": "0x2300:02", "uz": "0x2300:03"},
}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[1A00sub3]", "[1A00subx]", "object 0x1A00:03 has no default value"),
        ("DefaultValue=0x23000118", "DefaultValue=0x23000110", "TPDO1 maps 16 bits of 0x2300:01"),
        (
            "DefaultValue=0x23000118",
            "DefaultValue=0x24000118",
            "TPDO1 maps 0x2400:01, which is not an object",
        ),
        ("DefaultValue=0x23000318", "DefaultValue=0x23000218", "no signal '0x2300:03'; did you mean"),
        ("[DeviceInfo]", "DeviceInfo", "not an EDS file"),
        ("DefaultValue=$NODEID+0x40000180", "DefaultValue=", "object 0x1800:01 has no default value"),
    ],
)
def test_a_wrong_eds_is_refused(profiles: Path, old: str, new: str, said: str) -> None:
    text = (profiles / EDS).read_text()
    assert old in text
    files = {EDS: text.replace(old, new).encode()}
    message = refusal(lambda: stream_layout(PdoStream(**PDO), files, where="test"))
    assert message.startswith(EDS)
    assert said in message


def test_a_tpdo_that_is_switched_off_is_not_there(profiles: Path) -> None:
    text = (profiles / EDS).read_text().replace("$NODEID+0x40000180", "$NODEID+0x80000180")
    files = {EDS: text.encode()}
    assert "no signal '0x2300:01'" in refusal(lambda: stream_layout(PdoStream(**PDO), files, where="test"))


def test_the_crc_covers_what_the_reference_unit_covers(bundle: Bundle) -> None:
    assert bundle.profile.crc is not None
    covered = bundle.profile.crc.over
    assert len(covered) == 20
    assert (covered[0], covered[3], covered[-1]) == ("scale_factor_x", "misalignment_x", "calibration_date")
    zeros = {n: struct.pack("<f", 0.0) for n in covered}
    assert all(bundle.profile.decode(n, raw) == 0 for n, raw in zeros.items())
