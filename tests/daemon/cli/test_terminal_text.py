"""Nothing that a file says of itself steers the terminal of who reads it."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcald.abort import tell
from triaxcald.cli.bars import Bars
from triaxcald.cli.console import say, show, table
from triaxcald.printable import printable, printable_json
from triaxcald.recording import schema
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.schema.codes import Code

Run = Callable[..., Any]
GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
HOSTILE = "\x1b[2J\x1b]0;owned\x07\x9b31m\r\nforged: line\x08\x7f\u202egpj\u2066\u2028\u200b\x85\U000e0041"
IN_TOML = "".join(f"\\U{ord(c):08x}" for c in HOSTILE)
"""The same in a string of TOML."""


def assert_clean(*texts: str) -> None:
    for text in texts:
        bad = {c for c in text if c != "\n" and not c.isprintable() and unicodedata.category(c) != "Zs"}
        assert not bad, f"{bad!r} in {text[:2000]!r}"
        assert not re.search(r"^\s*forged", text, re.MULTILINE), text[:2000]


# The function


@given(st.text(), st.text())
def test_what_is_printed_is_one_line_of_what_can_be_seen(before: str, after: str) -> None:
    shown = printable(before + HOSTILE + after)
    assert_clean(shown)
    assert "\n" not in shown
    assert printable(shown) == shown


@pytest.mark.parametrize("text", ["plain text, 1.5 µg", "±0.1 °C → g²", "naïve Ω 加速度計 a\u00a0b", "\\x1b"])
def test_what_can_be_seen_is_shown_as_it_is(text: str) -> None:
    assert printable(text) == text


def test_half_a_character_of_a_file_name_is_shown_as_its_escape() -> None:
    assert printable("a\udcffb") == "a\\udcffb"


VALUES = st.text() | st.none() | st.floats(allow_nan=False)


@given(st.recursive(VALUES, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))
def test_json_says_the_same(document: Any) -> None:
    shown = printable_json(json.dumps(document, indent=2, ensure_ascii=False))
    assert json.loads(shown) == document
    assert_clean(shown.replace("forged", ""))


def test_every_way_to_the_terminal_makes_it_printable(capfd: pytest.CaptureFixture[str]) -> None:
    say(HOSTILE)
    show(HOSTILE)
    tell(HOSTILE)
    table(HOSTILE, ["", HOSTILE], [[HOSTILE, (HOSTILE, HOSTILE)]])
    with Bars() as bars:
        bars.note(HOSTILE, HOSTILE)
        bars.lost(HOSTILE, Code.LOST, HOSTILE)
    out, err = capfd.readouterr()
    assert_clean(out, err)
    assert (out.count("owned"), err.count("owned")) >= (4, 4)


# Files of others


def hostile_profile(text: str) -> str:
    text = text.replace('title = "', f'title = "{IN_TOML}').replace('vendor = "', f'vendor = "{IN_TOML}')
    text = text.replace('product = "', f'product = "{IN_TOML}').replace('unit = "V"', f'unit = "V{IN_TOML}"')
    text = text.replace('unit = "g"', f'unit = "g{IN_TOML}"').replace('description = "', f'description = "{IN_TOML}')
    return text.replace("temp_c =", f'"temp_c{IN_TOML}" =').replace("bias_x", f'"bias_x{IN_TOML}"', 1)


def hostile_json(value: Any) -> Any:
    """Every text of a document spoiled, and every name added to with one."""
    if isinstance(value, dict):
        return {k: v if k == "format" else hostile_json(v) for k, v in value.items()} | {HOSTILE: HOSTILE}
    if isinstance(value, list):
        return [hostile_json(v) for v in value]
    return value + HOSTILE if isinstance(value, str) else value


@pytest.fixture(scope="module", params=["described", "profile too"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As the golden one, with every text in it hostile, and its name; with its own profile, or a hostile one."""
    path = tmp_path_factory.mktemp("hostile") / f"rec{HOSTILE}.mcap"
    with Recording.open(GOLDEN) as golden:
        metadata = {
            name: {k: v if k in ("format", "ends_with", "signs") else v + HOSTILE for k, v in record.items()}
            for name, record in golden.metadata.items()
            if name not in ("raw", "end")
        } | {f"more{HOSTILE}": {HOSTILE: HOSTILE}}
        with RecordingWriter(path, metadata=metadata, waits=True) as writer:
            for name, data in golden.attachments.items():
                if name == "profile.toml" and request.param == "profile too":
                    data = hostile_profile(data.decode()).encode()
                elif name == "station.toml":
                    data = data.replace(b'"golden"', f'"golden{IN_TOML}"'.encode(), 1)
                elif name.endswith(".json"):
                    data = json.dumps(hostile_json(json.loads(data))).encode()
                writer.attach(name, "application/x" + HOSTILE, data)
            writer.attach(f"attached{HOSTILE}", HOSTILE, b"")
            for phase, batch in golden.raw_batches():
                writer.raw(phase, batch)
            for access in golden.register_accesses():
                writer.register(access.register + HOSTILE, access.operation, access.raw, HOSTILE)
            writer.event(f"event{HOSTILE}", {HOSTILE: [HOSTILE, {"a": HOSTILE}]})
            writer.event(schema.IMPORTED, {"log": HOSTILE})
            writer.event("ended", {"reason": HOSTILE})
    return path


READING = [
    ["log", "info"], ["log", "export"], ["log", "recover"], ["poses"], ["fit"], ["diagnose"], ["audit"],
    ["plan"], ["log", "info", "--json"], ["poses", "--json"], ["audit", "--json"],
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("command", READING, ids=" ".join)
def test_a_recording_whose_every_text_is_hostile(
    recording: Path, tmp_path: Path, triaxcal: Run, command: list[str]
) -> None:
    out = ["-o", tmp_path / f"out{HOSTILE}.mcap"] if "recover" in command else []
    done = triaxcal(*command, recording, *out)
    assert done.code in (0, 1, 2, 3)
    assert done.out + done.err
    assert_clean(done.out, done.err)
    if command == ["log", "info"]:
        assert (done.code, "owned" in done.out) == (0, True)


def test_a_damaged_recording_with_a_hostile_name(tmp_path: Path, triaxcal: Run) -> None:
    for i, data in enumerate((b"", GOLDEN.read_bytes()[:100_000], HOSTILE.encode())):
        path = tmp_path / f"{i}{HOSTILE}.mcap"
        path.write_bytes(data)
        for command in READING[:8]:
            done = triaxcal(*command, path)
            assert done.code != 0 or "info" in command or "recover" in command
            assert_clean(done.out, done.err)


TABLES = {
    "header": f"t_s,ux,uy,uz,{HOSTILE.replace(chr(10), '').replace(chr(13), '')}\n" + "0,1,2,3,4\n" * 3,
    "columns without a name of ours": "".join(f"{i}{HOSTILE[:12]}," for i in range(4)) + "\n1,2,3,4\n",
    "field": "t_s,ux,uy,uz\n0,1,2,\x1b[2Jthree\u202e\n",
    "comment": f"# unit: {HOSTILE[:12]}\nt_s,ux,uy,uz\n0,1,2\n",
    "prose": HOSTILE * 3,
}


@pytest.mark.parametrize("what", TABLES)
def test_a_table_with_hostile_text(tmp_path: Path, triaxcal: Run, what: str) -> None:
    path = tmp_path / f"table{HOSTILE}.csv"
    path.write_text(TABLES[what], encoding="utf-8")
    for command in ("poses", "fit", "diagnose"):
        done = triaxcal(command, path)
        assert done.code in (2, 3)
        assert_clean(done.out, done.err)


@pytest.fixture(scope="module")
def documents(calibrations: Path) -> list[Any]:
    return [json.loads((calibrations / name).read_text()) for name in ("linear.json", "closed.json")]


@pytest.mark.parametrize("spoil", ["all", "format", "terms", "units", "added"])
def test_a_calibration_with_hostile_text(
    documents: list[Any], exported: Path, tmp_path: Path, triaxcal: Run, spoil: str
) -> None:
    for i, document in enumerate(documents):
        if spoil == "all":
            document = hostile_json(document)
        elif spoil == "added":
            document = document | {HOSTILE: HOSTILE, "warnings": [HOSTILE]}
        else:
            document = document | {spoil: hostile_json(document.get(spoil, "")) if spoil != "format" else HOSTILE}
        path = tmp_path / f"{i}{HOSTILE}.json"
        path.write_text(json.dumps(document))
        for command in (["verify", path, exported], ["apply", path, exported, "-o", tmp_path / f"a{HOSTILE}.csv"]):
            done = triaxcal(*command)
            assert_clean(done.out, done.err)


@pytest.mark.parametrize(
    "text",
    [
        f'"{IN_TOML}" = 1\n',
        f'format = "triaxcal.station/1"\nname = "{IN_TOML}"\n[[units]]\nname = "a{IN_TOML}"\n',
        f'format = "{IN_TOML}"\n',
        f'format = "triaxcal.station/1"\nname = "a"\n[[units]]\nname = "a"\nprofile = "{IN_TOML}"\n'
        f'bus = {{ host = "{IN_TOML}", port = 1 }}\n',
        f'format = "triaxcal.station/1"\nname = "a"\nresults = "{IN_TOML}"\n[[units]]\nname = "a"\n'
        'profile = "triax-ref-modbus"\nbus = { host = "127.0.0.1", port = 1 }\n',
    ],
)
def test_a_station_file_with_hostile_text(tmp_path: Path, triaxcal: Run, text: str) -> None:
    path = tmp_path / f"station{HOSTILE}.toml"
    path.write_text(text)
    for command in (["run", path], ["registers", path], ["record", path, "-o", tmp_path / f"{HOSTILE}.mcap"]):
        done = triaxcal(*command)
        assert done.code != 0
        assert_clean(done.out, done.err)


def test_a_profile_with_hostile_text(tmp_path: Path, triaxcal: Run) -> None:
    with Recording.open(GOLDEN) as golden:
        text = golden.attachments["profile.toml"].decode()
        (tmp_path / "triax-ref-can.dbc").write_bytes(golden.attachments["profile/triax-ref-can.dbc"])
    spoiled = hostile_profile(text), text.replace('"Ux"', f'"{IN_TOML}"'), text + f'"{IN_TOML}" = 1'
    for i, content in enumerate(spoiled):
        profile = tmp_path / f"{i}{HOSTILE}.toml"
        profile.write_text(content)
        log, out = tmp_path / f"log{HOSTILE}.asc", tmp_path / f"out{HOSTILE}.mcap"
        done = triaxcal("log", "import", log, "--profile", profile, "-o", out)
        assert done.code == 2
        assert_clean(done.out, done.err)


@pytest.mark.parametrize(
    "arguments", [[HOSTILE], ["poses"], ["poses", "a.mcap", f"--x{HOSTILE}"], ["fit", "a.csv", "--sign", HOSTILE]]
)
def test_arguments_that_are_hostile(triaxcal: Run, arguments: list[str]) -> None:
    done = triaxcal(*arguments)
    assert done.code == 2
    assert_clean(done.out, done.err)
