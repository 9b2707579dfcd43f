"""Profiles: what is wrong is said in one line with the file, the line and the field."""

from pathlib import Path

import pytest

from triaxcal_drivers.catalogue import BUILT_IN, load_bundle, parse_bundle
from triaxcal_drivers.errors import DriverMissing, ProfileError
from triaxcal_drivers.profile import Bundle, PollStep, WriteStep

GOOD = """\
format = "triaxcal.profile/1"
name = "unit"
driver = "modbus"

[identity]
vendor = "v"
product = "p"
serial_register = "serial"

[output]
unit = "V"
nominal_scale_factor = [-2.4, -2.4, -2.4]

[sampling]
rate_hz = 100.0

[streams.readings]
layout = "poll"
address = 0
poll_period_s = 0.1

[streams.readings.channels]
ux = { word = 0, type = "int16" }
uy = { word = 1, type = "int16" }
uz = { word = 2, type = "int16" }

[registers]
serial = { address = 6, type = "uint32", role = "serial_number", access = "ro" }
bias_x = { address = 8, type = "float32", role = "bias.x", minimum = -0.5, maximum = 0.5 }

[registers.bias_y]
address = 10
type = "float32"
role = "bias.y"

[sequences]
unlock = [
    { write = "bias_x", value = 0 },
    { poll = "serial", until = 1 },
]
"""


def line_of(text: str) -> int:
    return GOOD[: GOOD.index(text)].count("\n") + 1


def fault(text: str | bytes) -> str:
    with pytest.raises(ProfileError) as caught:
        parse_bundle(text if isinstance(text, bytes) else text.encode(), {}, where="unit.toml")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_good_profile_is_read():
    bundle = parse_bundle(GOOD.encode(), {}, where="unit.toml")
    profile = bundle.profile
    assert profile.output.nominal_scale_factor == (-2.4, -2.4, -2.4)
    assert profile.by_role("bias.y") == "bias_y"
    assert profile.by_role("bias.z") is None
    assert profile.sequences.unlock == (WriteStep(write="bias_x", value=0), PollStep(poll="serial", until=1))
    assert bundle.text == GOOD.encode()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        # unknown keys
        ('vendor = "v"', 'vendro = "v"', "identity.vendro: unknown key; did you mean 'vendor'?"),
        ("rate_hz", "rate_Hz", "sampling.rate_Hz: unknown key; did you mean 'rate_hz'?"),
        ("poll_period_s", "poll_period_ms",
         "streams.readings.poll_period_ms: unknown key; did you mean 'poll_period_s'?"),
        ('uy = { word = 1, type', 'uy = { word = 1, typ',
         "streams.readings.channels.uy.typ: unknown key; did you mean 'type'?"),
        ("address = 10", "adress = 10", "registers.bias_y.adress: unknown key; did you mean 'address'?"),
        ("minimum = -0.5", "min = -0.5", "registers.bias_x.min: unknown key; did you mean 'minimum'?"),
        ('name = "unit"', 'name = "unit"\ncolour = 1', "colour: unknown key"),
        # missing keys
        ("rate_hz = 100.0", "", "sampling.rate_hz: missing"),
        ('unit = "V"', "", "output.unit: missing"),
        ("address = 0\n", "", "streams.readings.address: missing"),
        ('bias_x = { address = 8, type = "float32"', "bias_x = { address = 8", "registers.bias_x.type: missing"),
        # wrong types
        ("rate_hz = 100.0", 'rate_hz = "100"', "sampling.rate_hz: input should be a valid number, not '100'"),
        ("address = 10", 'address = "10"', "registers.bias_y.address: input should be a valid integer, not '10'"),
        ("address = 10", "address = 10.5", "registers.bias_y.address"),
        ("address = 10", "address = true", "registers.bias_y.address: input should be a valid integer, not True"),
        ('unit = "V"', "unit = 5", "output.unit: input should be a valid string, not 5"),
        ("rate_hz = 100.0", "rate_hz = 0.0", "sampling.rate_hz: input should be greater than 0, not 0"),
        ("rate_hz = 100.0", "rate_hz = nan", "sampling.rate_hz"),
        ('bias_x = { address = 8, type = "float32"', 'bias_x = { address = 8, type = "real"',
         "registers.bias_x.type: input should be 'int8', 'uint8'"),
        ("[-2.4, -2.4, -2.4]", "[-2.4, -2.4]", "output.nominal_scale_factor.2: missing"),
        ("[-2.4, -2.4, -2.4]", "[-2.4, -2.4, -2.4, 1.0]", "output.nominal_scale_factor: tuple should have at most 3"),
        ("minimum = -0.5, maximum = 0.5", "minimum = 0.5, maximum = -0.5",
         "registers.bias_x: minimum 0.5 is above maximum -0.5"),
        ("maximum = 0.5", "maximum = 0.5, scale = 0.0", "registers.bias_x: scale must not be zero"),
        ('name = "unit"', 'name = "My Unit"', "name: string should match pattern"),
        ('format = "triaxcal.profile/1"', 'format = "triaxcal.profile/9"',
         "format: input should be 'triaxcal.profile/1', not 'triaxcal.profile/9'"),
    ],
)  # fmt: skip
def test_a_fault_in_one_place_is_named_with_its_line(old, new, message):
    assert GOOD.count(old) == 1
    said = fault(GOOD.replace(old, new))
    assert said.startswith("unit.toml"), said
    assert message in said, said
    if new and "colour" not in message and not message.endswith("type: missing"):
        assert f"line {line_of(old)}:" in said, said


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('write = "bias_x"', 'write = "bais_x"',
         "sequences.unlock: no register named 'bais_x'; did you mean 'bias_x'?"),
        ('poll = "serial"', 'poll = "status"', "sequences.unlock: no register named 'status'"),
        ('serial_register = "serial"', 'serial_register = "serail"',
         "identity.serial_register: no register named 'serail'; did you mean 'serial'?"),
        ('product = "p"', 'product = "p"\nexpect = { code = 7 }', "identity.expect: no register named 'code'"),
        ("[-2.4, -2.4, -2.4]", "[-2.4, 0.0, -2.4]", "line 10: output: nominal_scale_factor must not be zero"),
        ('role = "bias.y"', 'role = "bias.x"', "registers: role 'bias.x' is given twice"),
        ("[streams.readings", "[streams.raedings", "streams.readings is missing"),
        ("[sequences]", '[crc]\nregister = "bias_x"\nalgorithm = "crc-32"\nover = ["bias_z"]\n[sequences]',
         "crc: no register named 'bias_z'"),
    ],
)  # fmt: skip
def test_names_that_do_not_resolve_are_named_with_the_nearest(old, new, message):
    said = fault(GOOD.replace(old, new))
    assert said.startswith("unit.toml"), said
    assert message in said


FORM = '[correction]\nform = "matrix"\n[registers]'


@pytest.mark.parametrize(
    ("roles", "head", "missing"),
    [
        (["matrix.xx"], "[registers]", ["matrix.yy", "matrix.zz"]),
        (["matrix.xx", "matrix.zz"], FORM, ["matrix.yy"]),
        (["matrix.yx"], "[registers]", ["matrix.zx", "matrix.zy"]),
        (["offset.y"], "[registers]", ["offset.x", "offset.z"]),
        (["offset.x", "offset.y", "offset.z", "offset.z.t1"], FORM, ["offset.x.t1", "offset.y.t1"]),
    ],
)
def test_a_correction_without_all_axes_names_those_that_are_missing(roles, head, missing):
    registers = "".join(f'r{i} = {{ address = {20 + 2 * i}, type = "float32", role = "{r}" }}\n'
                        for i, r in enumerate(roles))  # fmt: skip
    linear = GOOD[GOOD.index("bias_x = {") : GOOD.index("[sequences]")]
    text = GOOD[: GOOD.index("[sequences]")].replace(linear, registers).replace("[registers]", head)
    said = fault(text)
    assert "[correction]" in said
    assert f"without {', '.join(missing)}:" in said


def test_an_unknown_driver_is_named():
    with pytest.raises(DriverMissing, match=r"^unit\.toml: no driver named 'modbas'; did you mean 'modbus'\?$"):
        parse_bundle(GOOD.replace('"modbus"', '"modbas"').encode(), {}, where="unit.toml")


@pytest.mark.parametrize("driver", ["", "driver = 3\n"])
def test_a_driver_must_be_named(driver):
    assert fault(GOOD.replace('driver = "modbus"\n', driver)).startswith("unit.toml: driver: expected the name")


def test_what_is_not_toml_is_refused_with_its_line():
    said = fault(GOOD.replace("rate_hz = 100.0", "rate_hz = = 100"))
    assert said.startswith("unit.toml: not TOML: ")
    assert f"at line {line_of('rate_hz')}" in said


def test_what_is_not_text_is_refused():
    assert fault(b'name = "\xff"').startswith("unit.toml: not UTF-8 text (byte 8); expected a profile")


def test_a_file_that_is_not_there_names_the_built_in_profiles(tmp_path: Path):
    with pytest.raises(ProfileError, match=r"nowhere\.toml: No such file or directory; built-in .*triax-ref-modbus"):
        load_bundle(tmp_path / "nowhere.toml")


def test_a_bare_name_is_a_built_in_profile():
    assert load_bundle(Path("triax-ref-modbus")).profile.name == "triax-ref-modbus"
    assert load_bundle(Path("triax-ref-modbus.toml")).profile.name == "triax-ref-modbus"


def test_a_file_comes_before_a_built_in_profile(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("triax-ref-modbus.toml").write_text(GOOD)
    assert load_bundle(Path("triax-ref-modbus.toml")).profile.name == "unit"


def built_in_modbus() -> list[Path]:
    return [p for p in sorted(BUILT_IN.glob("*.toml")) if 'driver = "modbus"' in p.read_text("utf-8")]


@pytest.mark.parametrize("path", built_in_modbus(), ids=lambda p: p.stem)
def test_every_built_in_modbus_profile_is_sound(path):
    assert load_bundle(path).profile.name == path.stem


def test_a_digest_covers_profile_and_files():
    profile = parse_bundle(GOOD.encode(), {}, where="unit.toml").profile
    texts = [
        Bundle(profile, b"text"),
        Bundle(profile, b"text2"),
        Bundle(profile, b"text", {"a.dbc": b"1"}),
        Bundle(profile, b"text", {"a.dbc": b"2"}),
        Bundle(profile, b"text", {"b.dbc": b"1"}),
        Bundle(profile, b"text", {"a.dbc": b"", "b.dbc": b"1"}),
    ]
    assert len({b.digest() for b in texts}) == len(texts)
    assert Bundle(profile, b"text").digest() == texts[0].digest()
    two = {"a": b"1", "b": b"2"}
    assert Bundle(profile, b"", two).digest() == Bundle(profile, b"", dict(reversed(two.items()))).digest()
