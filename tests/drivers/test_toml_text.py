"""TOML is bounded before it is parsed, by what the parser takes long for; honest text never meets a bound."""

from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triaxcal_drivers.catalogue import BUILT_IN
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.toml_text import DEPTH_MOST, PARTS_MOST, SIZE_MOST, parse_toml


def refusal(text: str) -> str:
    with pytest.raises(ProfileError) as caught:
        parse_toml(text.encode(), where="x.toml")
    return str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        'a = "' + "[" * 100 + '"',
        "a = '" + "{" * 100 + "'",
        "# " + "[" * 100,
        'a = """' + '[" ""[' * 100 + '"""',
        "a = '''" + "[' ''[" * 100 + "'''",
        'a = """b""""" # ends with two quotes of its own\n' + "[[c]]\n" * 100,
        "\n".join(f"a{i} = 1.5" for i in range(100)),
        "a = [" + "1.5, " * 100 + "]",
        '"a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t" = 1',
    ],
)
def test_what_stands_in_texts_and_comments_and_numbers_does_not_count(text: str) -> None:
    assert isinstance(parse_toml(text.encode(), where="x.toml"), dict)


def test_the_bounds_are_where_they_are_said_to_be() -> None:
    nested = "[" * DEPTH_MOST + "]" * DEPTH_MOST
    assert parse_toml(f"a = {nested}".encode(), where="x.toml")
    assert refusal(f"\n\na = [{nested}]") == f"x.toml, line 3: brackets nested more than {DEPTH_MOST} deep"
    key = ".".join("a" * PARTS_MOST)
    assert parse_toml(f"{key} = 1".encode(), where="x.toml")
    for text in (f"{key}.a = 1", f"[{key}.a]", f"[[{key}.a]]", f"b = {{ {key}.a = 1 }}", f"{key} . 'a' = 1"):
        assert refusal(text) == f"x.toml, line 1: a key of more than {PARTS_MOST} parts"
    assert "expected at most 128" in refusal("a = " + "1" * 129)
    assert f"expected at most {SIZE_MOST}" in refusal("#" * (SIZE_MOST + 1))


def test_a_profile_of_a_thousand_registers_is_within_them() -> None:
    text = (BUILT_IN / "triax-ref-modbus.toml").read_text()
    registers = "".join(
        f'r{i} = {{ address = 0x{i:04X}, type = "float32", access = "ro", description = "one of a thousand" }}\n'
        for i in range(1000)
    )
    assert len(parse_toml((text + registers).encode(), where="x.toml")["registers"]) > 1000


@settings(deadline=None)
@given(st.text(alphabet="[]{}\"'#.=\\ \nab1,", max_size=200))
def test_any_text_is_toml_or_an_error_of_ours(text: str) -> None:
    with suppress(ProfileError):
        parse_toml(text.encode(), where="x.toml")


@pytest.mark.parametrize("piece", ['"', "'", '"""', "\\", '\\"', '"\\', "'''", "#", "[", "a.", "''x"])
def test_no_text_keeps_the_bound_itself_busy(piece: str) -> None:
    """What goes with the square of such a text would take an hour."""
    for text in (piece, '"' + piece, '"""' + piece):
        with suppress(ProfileError):
            parse_toml((text + piece * (200_000 // len(piece))).encode(), where="x.toml")
