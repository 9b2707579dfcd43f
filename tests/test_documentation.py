"""The documentation says what is so: links lead somewhere, files are valid, commands exist and run."""

from __future__ import annotations

import argparse
import csv
import ctypes
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel

import triaxcal as tc
from benchmarks.measured import by_group
from benchmarks.session import LISTED_RUNS
from triaxcal_drivers.catalogue import load_bundle
from triaxcald.cli.commands import main, parser
from triaxcald.documents import to_text
from triaxcald.recording.reader import Recording
from triaxcald.schema.run import Run
from triaxcald.simulation.bench import DeviceFile, load_device, simulate
from triaxcald.station.config import StationFile, load_station

PROJECT = Path(__file__).parents[1]
PAGES = sorted(
    p
    for p in [*PROJECT.glob("*.md"), *(PROJECT / "docs").rglob("*.md"), *(PROJECT / "recordings").glob("*.md")]
    if p.is_file()
)
OTHERS_DRIVER = PROJECT / "examples/driver"
EXAMPLES = sorted(p for p in (PROJECT / "examples").rglob("*.toml") if p.parent != OTHERS_DRIVER)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
OPERATORS = {"|", "||", "&", "&&", ";", ">", ">>", "<"}


@dataclass(frozen=True)
class Block:
    """A fenced block; ``note`` is the HTML comment on the line before it, if any."""

    page: Path
    language: str
    text: str
    note: str

    @property
    def commands(self) -> list[str]:
        joined = self.text.replace("\\\n", " ")
        return [line.removeprefix("$ ") for line in joined.splitlines() if line.startswith("$ ")]

    @property
    def file(self) -> str | None:
        return self.note.removeprefix("file:").strip() if self.note.startswith("file:") else None


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text("utf-8")
    for match in FENCE.finditer(text):
        before = text[: match.start()].rstrip("\n").rpartition("\n")[2]
        note = re.fullmatch(r"<!-- (.*) -->", before)
        yield Block(page, match[1], match[2], note[1] if note else "")


def name_of(page: Path) -> str:
    return str(page.relative_to(PROJECT))


def all_blocks() -> list[Block]:
    return [b for page in PAGES for b in blocks(page)]


# Links


def anchors(page: Path) -> set[str]:
    """Of the page's headings, as GitHub makes them."""
    text = FENCE.sub("", page.read_text("utf-8"))
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", re.sub(r"[`*]|\[([^\]]*)\]\([^)]*\)", r"\1", h)).lower() for h in headings]
    return {h.replace(" ", "-") for h in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    lost = []
    for target in LINK.findall(FENCE.sub("", page.read_text("utf-8"))):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        to = (page.parent / path).resolve() if path else page
        if not to.exists() or (anchor and anchor not in anchors(to)):
            lost.append(target)
    assert not lost


def test_every_page_is_reached_from_the_index() -> None:
    reached, todo = set(), [PROJECT / "README.md"]
    while todo:
        page = todo.pop()
        if page in reached or page.suffix != ".md":
            continue
        reached.add(page)
        for target in LINK.findall(FENCE.sub("", page.read_text("utf-8"))):
            if not re.match(r"[a-z]+:|#", target):
                todo.append((page.parent / target.partition("#")[0]).resolve())
    assert {name_of(p) for p in PAGES if p.is_relative_to(PROJECT / "docs")} <= {name_of(p) for p in reached}


TOP = {p.name for p in PROJECT.iterdir()}
LEFT_BEHIND = [
    line.strip("/") for line in (PROJECT / ".gitignore").read_text("utf-8").splitlines() if line.startswith("/")
]
"""What commands of the documentation write: named in the prose, and not in the repository."""


def paths_named(text: str) -> set[str]:
    """The paths of the repository in backticks, outside fenced blocks."""
    named = re.findall(r"`([\w.*-]+(?:/[\w.*-]*)+)(?:::\w+)?`", FENCE.sub("", text))
    return {path for path in named if path.partition("/")[0] in TOP}


def is_there(path: str) -> bool:
    """From the top or from `tests`; NAME stands for any name."""
    made = any(path.rstrip("/") == left or path.startswith(f"{left}/") for left in LEFT_BEHIND)
    pattern = path.rstrip("/").replace("NAME", "*")
    return made or any(any(root.glob(pattern)) for root in (PROJECT, PROJECT / "tests"))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_path_named_in_the_documentation_is_in_the_repository(page: Path) -> None:
    assert sorted(path for path in paths_named(page.read_text("utf-8")) if not is_there(path)) == []


def test_a_path_that_is_not_in_the_repository_would_be_noticed() -> None:
    text = "See `tests/nowhere.py::test_x`, `docs/*.md`, `g/g`, `~/x` and\n```text\n`docs/none`\n```\n"
    assert paths_named(text) == {"tests/nowhere.py", "docs/*.md"}
    assert is_there("docs/*.md")
    assert is_there("docs/how-to/NAME.md")
    assert not is_there("tests/nowhere.py")


# Commands


def arguments_of(command: str) -> list[list[str]]:
    """The arguments of each call of triaxcal in a line of shell."""
    lexer = shlex.shlex(command, posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    calls: list[list[str]] = [[]]
    for word in lexer:
        if word in OPERATORS:
            calls.append([])
        else:
            calls[-1].append(word)
    return [call[1:] for call in calls if call and Path(call[0]).name == "triaxcal"]


COMMANDS = [(b, c) for b in all_blocks() if b.language in ("console", "sh") for c in b.commands]


@pytest.mark.parametrize(("block", "command"), COMMANDS, ids=[f"{name_of(b.page)}: {c}" for b, c in COMMANDS])
def test_every_command_shown_is_one_that_there_is(block: Block, command: str) -> None:
    for arguments in arguments_of(command):
        parser().parse_args(arguments)  # ends with SystemExit, hence fails, where it is none


def test_a_command_that_there_is_not_would_be_noticed() -> None:
    assert arguments_of("gzip -dc x | triaxcal fitt - > out") == [["fitt", "-"]]
    with pytest.raises(SystemExit):
        parser().parse_args(["fitt", "-"])


@pytest.mark.parametrize("make", re.findall(r"^\$ make (\w+)$", "\n".join(b.text for b in all_blocks()), re.MULTILINE))
def test_every_make_target_shown_is_in_the_makefile(make: str) -> None:
    assert re.search(rf"^{make}:", (PROJECT / "Makefile").read_text("utf-8"), re.MULTILINE)


RUNNABLE = [page for page in PAGES if any(b.note.startswith("run") for b in blocks(page))]


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNABLE, ids=name_of)
def test_the_commands_of_a_page_that_are_marked_as_runnable_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Commands and Python in order, in one folder; a block marked as output is what the one before it printed."""
    for folder in ("recordings", "examples"):
        shutil.copytree(PROJECT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("out", "*.eeprom"))
    monkeypatch.chdir(tmp_path)
    ran, printed = 0, ""
    for block in blocks(page):
        if block.file:
            (tmp_path / block.file).write_text(block.text, "utf-8")
        if block.note.startswith("run"):
            capfd.readouterr()
            if block.language == "python":
                exec(compile(block.text, str(page), "exec"), {})
                ran += 1
            for command in block.commands if block.language == "console" else ():
                assert run(command) == int(block.note.partition("exit")[2] or 0), command
                ran += 1
            out, err = capfd.readouterr()
            printed = err + out  # notes come before results
        if block.note == "output":
            assert not_printed(block.text, printed) == []
    assert ran


def not_printed(shown: str, printed: str) -> list[str]:
    """Of the lines shown, those that were not printed, or not in this order; "..." stands for what is left out, and
    lines may break elsewhere, as with the width of a terminal."""
    left, lost = " ".join(printed.split()), []
    for line in shown.splitlines():
        for part in filter(None, (" ".join(p.split()) for p in line.split("..."))):
            _, found, rest = left.partition(part)
            if found:
                left = rest
            else:
                lost.append(part)
    return lost


def test_output_that_is_not_printed_would_be_noticed() -> None:
    printed = "one two\nthree four\nfive\n"
    assert not_printed("one ...\n... four\n...\nfive\n", printed) == []
    assert not_printed("five\none two\n", printed) == ["one two"]
    assert not_printed("one 2\n", printed) == ["one 2"]


def run(command: str) -> int:
    """Exit code of a line of shell; without starting a process where it is one plain call."""
    calls = arguments_of(command)
    if len(calls) == 1 and not OPERATORS & set(shlex.split(command)) and command.startswith("triaxcal "):
        return main(calls[0])
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return subprocess.run(["bash", "-c", command], env=os.environ | {"PATH": path}, check=False, timeout=180).returncode


def subcommands(top: argparse.ArgumentParser, prefix: str = "") -> dict[str, argparse.ArgumentParser]:
    found: dict[str, argparse.ArgumentParser] = {}
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, sub in action.choices.items():
                found |= {f"{prefix}{name}": sub} if sub.get_default("run") else {}
                found |= subcommands(sub, f"{prefix}{name} ")
    return found


PARSERS = subcommands(parser())


def sections(page: Path, *, preface: bool = False) -> dict[str, str]:
    """By heading; what stands before the first one under "", if asked for."""
    before, *parts = re.split(r"^## (.*)$", page.read_text("utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True)) | ({"": before} if preface else {})


@pytest.mark.parametrize("command", PARSERS)
def test_every_command_has_a_section_that_names_all_its_options(command: str) -> None:
    text = sections(PROJECT / "docs/reference/cli.md")[f"triaxcal {command}"]
    options = [o for a in PARSERS[command]._actions for o in a.option_strings if o not in ("-h", "--help")]
    assert [o for o in options if f"{o}" not in re.findall(r"(?<![\w-])--?[a-z][a-z-]*", text)] == []


def test_the_command_line_page_describes_no_command_that_there_is_not() -> None:
    named = {s.removeprefix("triaxcal ") for s in sections(PROJECT / "docs/reference/cli.md") if "triaxcal" in s}
    assert named == set(PARSERS)


def test_the_options_of_the_program_itself_are_named() -> None:
    top = sections(PROJECT / "docs/reference/cli.md", preface=True)[""]
    own = [o for a in parser()._actions for o in a.option_strings if o not in ("-h", "--help")]
    assert own
    assert [o for o in own if f"triaxcal {o}" not in top] == []


# Files


def folder_of(page: Path, folder: Path) -> Path:
    """The page's named blocks as files."""
    for block in blocks(page):
        if block.file:
            (folder / block.file).write_text(block.text, "utf-8")
    return folder


def check_toml(path: Path) -> None:
    """Raises what the loader of that format raises."""
    kind = tomllib.loads(path.read_text("utf-8"))["format"]
    if kind == "triaxcal.station/1":
        load_station(path)
    elif kind == "triaxcal.device/1":
        simulate(load_device(path), where=str(path))
    else:
        assert kind == "triaxcal.profile/1"
        load_bundle(path)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.name)
def test_every_example_is_valid(path: Path) -> None:
    check_toml(path)


@pytest.mark.parametrize("kind", ["can", "modbus-tcp", "modbus-rtu"])
def test_the_station_of_an_example_finds_the_unit_of_its_device(kind: str) -> None:
    device = load_device(PROJECT / "examples" / f"device-{kind}.toml")
    unit = load_station(PROJECT / "examples" / f"station-{kind}.toml").file.units[0]
    assert int(unit.serial or -1) == device.serial
    assert unit.profile == device.profile
    place = {k: v for k, v in unit.bus.items() if k != "parity"}
    assert place == {k: v.removeprefix("pty:") if isinstance(v, str) else v for k, v in device.bus.items()}


WITH_TOML = [p for p in PAGES if any(b.language == "toml" and b.text.startswith("format") for b in blocks(p))]


@pytest.mark.parametrize("page", WITH_TOML, ids=name_of)
def test_every_toml_file_in_the_documentation_is_valid(page: Path, tmp_path: Path) -> None:
    folder_of(page, tmp_path)
    for block in blocks(page):
        if block.language == "toml" and block.text.startswith("format"):
            assert block.file, "a file that cannot be checked: give it a name"
            check_toml(tmp_path / block.file)


@pytest.mark.slow
def test_the_driver_of_the_examples_is_found_and_decodes(tmp_path: Path) -> None:
    """Installed as pip would, by its metadata, in a folder of its own."""
    shutil.copytree(OTHERS_DRIVER, tmp_path, dirs_exist_ok=True)
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text("utf-8"))["project"]
    info = tmp_path / "acme_lines-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = "".join(f"{k} = {v}\n" for k, v in project["entry-points"]["triaxcal.drivers"].items())
    (info / "entry_points.txt").write_text("[triaxcal.drivers]\n" + points)
    (info / "RECORD").write_text("")
    code = """
from pathlib import Path
from triaxcal_drivers.interface import RawBatch
from triaxcald.raw_to_poses import Pipeline
from triaxcald.schema.run import Run
from triaxcald.station.config import load_station
(place,) = load_station(Path("station.toml")).places
pipeline = Pipeline(place.bundle, "readings")
lines = [b"5,1,2,9.5", b"6,1,2,9.25", b"6,1,2,9.25", b"nonsense", b"9,1,2,nan", b"8,1.5,2,9"]
blocks = [pipeline.feed(RawBatch.of([(10**9, 0, 0, line) for line in part])) for part in (lines[:2], lines[2:])]
print([b.readings.tolist() for b in blocks], [b.time_ns.tolist() for b in blocks])
print({k: v for k, v in pipeline.counts.items() if v})
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    decoded, counts = done.stdout.splitlines()
    assert decoded == (
        "[[[1.0, 2.0, 9.5], [1.0, 2.0, 9.25]], [[1.5, 2.0, 9.0]]] [[1000000000, 1010000000], [1030000000]]"
    )
    assert counts == "{'samples': 3, 'missing': 1, 'duplicates': 1, 'errors': 2}"


PYTHON = [b for b in all_blocks() if b.language == "python"]


@pytest.mark.parametrize("block", PYTHON, ids=[f"{name_of(b.page)}, {b.text[:40]!r}" for b in PYTHON])
def test_every_python_block_is_python(block: Block) -> None:
    compile(block.text, str(block.page), "exec")


CALIBRATION_HOW_TO = PROJECT / "docs/how-to/use-a-calibration.md"


def in_use(kind: str) -> tuple[tc.Calibration, Any, Any]:
    """A calibration as the how-to uses one of that kind, readings (n,3), and the temperature of each (n,)."""
    effects = {"second_order_nonlinearity": 5e-4, "temperature_bias": 3e-4} if kind == "effects" else {}
    document = {
        "format": "triaxcal.calibration/1",
        "scale_factor": [-2.41, -2.4, -2.37],
        "misalignment": [6e-3, 4e-3, -6e-4],
        "bias": [5e-3, -3e-3, 4e-3],
        "channel_reference": {"temp_c": 24.5},
        "effects": {n: {i: {"value": q * (1 + "xyz".index(i))} for i in "xyz"} for n, q in effects.items()},
    }
    c = tc.Calibration.from_dict(document)
    sensor = c.fitted.sensor
    document |= {"matrix": sensor.matrix.tolist(), "centre": sensor.centre.tolist()}
    rng = np.random.default_rng(0)
    return tc.Calibration.from_dict(document), 2 * rng.standard_normal((50, 3)), rng.uniform(0, 60, 50)


def lines_of_ones_own(kind: str, language: str) -> str:
    """For a calibration of that kind: in the how-to, or in the file that it names."""
    if kind == "effects":
        return (
            (PROJECT / "examples/apply_with_effects").with_suffix(".c" if language == "c" else ".py").read_text("utf-8")
        )
    (block,) = [b for b in blocks(CALIBRATION_HOW_TO) if b.note == kind and b.language == language]
    return block.text


@pytest.mark.parametrize("kind", ["linear", "effects"])
def test_the_formula_in_python_is_what_apply_does(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    c, u, temp_c = in_use(kind)
    monkeypatch.chdir(tmp_path)
    c.save("cal.json")
    names: dict[str, Any] = {"u": u}
    exec(compile(lines_of_ones_own(kind, "python"), "how-to", "exec"), names)
    a = names["apply"]("cal.json", u, temp_c) if kind == "effects" else names["a"]
    assert a == pytest.approx(c.apply(u, channels={"temp_c": temp_c}), abs=1e-12)


@pytest.mark.skipif(shutil.which("cc") is None, reason="this machine has no C compiler")
@pytest.mark.parametrize("kind", ["linear", "effects"])
def test_the_formula_in_c_is_what_apply_does(kind: str, tmp_path: Path) -> None:
    c, u, temp_c = in_use(kind)
    (tmp_path / "apply.c").write_text(lines_of_ones_own(kind, "c"))
    library = tmp_path / "apply.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, tmp_path / "apply.c"], check=True)
    function = ctypes.CDLL(str(library)).apply

    def numbers(values: Any) -> Any:
        flat = np.ravel(values).tolist()
        return (ctypes.c_double * len(flat))(*flat)

    s, a = c.fitted.sensor, (ctypes.c_double * 3)()
    for row, t in zip(u, temp_c, strict=True):
        if kind == "linear":
            function(numbers(s.matrix), numbers(s.centre), numbers(row), a)
        else:
            q2, qt = (q for _, q in s.effects)
            known = map(numbers, (s.scale_factor, s.misalignment, s.bias, q2, qt))
            function(*known, ctypes.c_double(t - 24.5), numbers(row), a)
        assert list(a) == pytest.approx(c.apply(row, channels={"temp_c": t}), abs=1e-12)


def test_the_closed_form_can_be_redone_by_hand() -> None:
    (block,) = [b for b in blocks(PROJECT / "docs/explanation/the-fit.md") if b.language == "python"]
    exec(block.text, {})


# Documents


def keys_of(value: object, named: frozenset[str]) -> set[str]:
    """All keys but those under ``named``, which are names that a profile or the catalogue gives."""
    if isinstance(value, list):
        return {k for inner in value for k in keys_of(inner, named)}
    if not isinstance(value, dict):
        return set()
    found = set(value)
    for key, inner in value.items():
        by_name = key in named and isinstance(inner, dict)
        found |= {k for v in inner.values() for k in keys_of(v, named)} if by_name else keys_of(inner, named)
    return found


NAMED = frozenset(
    {
        "cannot_show",
        "held_out_rms_g",
        "channels",
        "channel_reference",
        "effects",
        "coefficients",
        "probabilities",
        "sees",
        "levels",
        "promised",
        "moves",
    }
)
EFFECT_LEAVES = {"x", "y", "z"}


MODELLED = ("poses", "calibration", "loop", "certificate", "outcome", "run")
"""Pages that are made from the models of documents."""


OF_COMMANDS: dict[str, type[tc.schema.Model]] = {
    "triaxcal.poses/1": tc.schema.Poses,
    "triaxcal.calibration/1": tc.schema.Calibration,
    "triaxcal.loop/1": tc.schema.Loop,
}


def documented_keys() -> set[str]:
    text = "".join((PROJECT / f"docs/reference/{page}.md").read_text("utf-8") for page in ("documents", *MODELLED))
    return set(re.findall(r"[A-Za-z_0-9]+", " ".join(re.findall(r"`([^`]*)`", text))))


@pytest.mark.parametrize("attachment", ["certificate.json", "verification.json"])
def test_every_key_of_a_recordings_documents_is_explained(attachment: str) -> None:
    with Recording.open(PROJECT / "recordings" / "can-second-order.mcap") as recording:
        document = json.loads(recording.attachments[attachment])
    assert to_text(document)
    assert keys_of(document, NAMED) - documented_keys() - EFFECT_LEAVES == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "poses recordings/paper-unit.csv.gz",
        "fit recordings/paper-unit.csv.gz",
        "diagnose recordings/can-second-order.mcap --check recordings/paper-unit.csv.gz --sign=-,-,- --output-unit V",
        "plan --poses 14",
        "plan --poses 14 --for temperature_bias bias_drift",
        "plan recordings/paper-unit.csv.gz",
        "plan recordings/paper-unit.csv.gz --for third_order_nonlinearity temperature_bias",
        "audit recordings/can-second-order.mcap",
        "devices",
    ],
)
def test_every_key_of_a_commands_document_is_explained(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(PROJECT)
    assert main([*command.split(), "--json"]) in (0, 1)
    document = json.loads(capsys.readouterr().out)
    assert document["format"] in (PROJECT / "docs/reference/documents.md").read_text("utf-8")
    assert keys_of(document, NAMED) - documented_keys() - EFFECT_LEAVES == set()
    if model := OF_COMMANDS.get(document["format"]):
        read = model.read(document)
        assert read is not None
        assert to_text(read.document()) == to_text(document)


def test_every_key_of_the_document_of_a_run_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of one that fails at once: its keys are those of any other."""
    station = tmp_path / "station.toml"
    bus = f'bus = {{ serial_port = "{tmp_path}/none" }}'
    station.write_text(
        f'format = "triaxcal.station/1"\nname = "b"\n[[units]]\nname = "u"\nprofile = "triax-ref-modbus"\n{bus}\n'
    )
    assert main(["run", str(station), "--json"]) == 4
    document = json.loads(capsys.readouterr().out)
    assert {"device_state", "records_lost"} <= set(document["units"][0])
    read = Run.read(document)
    assert read is not None
    assert to_text(read.document()) == to_text(document)
    assert keys_of(document, NAMED) - documented_keys() == set()


def dotted_keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """The keys of a file, as its page names them."""
    for attribute, field in model.model_fields.items():
        name = field.alias or attribute
        yield f"{prefix}{name}"
        inner = [a for a in (field.annotation, *get_args(field.annotation)) if isinstance(a, type)]
        for nested in (a for a in inner if issubclass(a, BaseModel)):
            yield from dotted_keys(nested, f"{prefix}{name}.")


@pytest.mark.parametrize(("page", "model"), [("station", StationFile), ("device", DeviceFile)])
def test_every_key_of_a_file_is_in_its_table(page: str, model: type[BaseModel]) -> None:
    rows = re.findall(r"^\| (`.*?) \|", (PROJECT / f"docs/reference/{page}.md").read_text("utf-8"), re.MULTILINE)
    named: set[str] = set()
    for row in rows:
        keys = re.findall(r"`([^`]+)`", row)
        head = keys[0].rpartition(".")[0]
        named |= {keys[0], *(f"{head}{k}" for k in keys[1:])}
    groups = {k.rpartition(".")[0] for k in dotted_keys(model)}
    assert {k for k in dotted_keys(model) if k not in groups} - {re.sub(r"\.NAME$", "", k) for k in named} == set()


def test_the_tables_of_measured_recordings_are_those_of_the_results() -> None:
    """Each page has what its benchmark makes of the stored rows."""

    def rows(name: str) -> list[list[str]]:
        with (PROJECT / "benchmarks/results" / name).open(encoding="utf-8", newline="") as file:
            return list(csv.reader(file))

    measured, session = rows("measured.csv"), rows("session.csv")
    assert len({row[0] for row in measured[1:]}) == len(measured) - 1 >= 28
    assert by_group(measured[1:]) in (PROJECT / "docs/measured.md").read_text("utf-8")
    text = (PROJECT / "docs/session.md").read_text("utf-8")
    listed = [row for row in session[1:] if row[0] == f"1 to {LISTED_RUNS}"]
    assert len(listed) == 8
    shown = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    assert [row for row in listed if row not in shown] == []


README = (PROJECT / "README.md").read_text("utf-8")


def test_the_readme_is_short() -> None:
    assert len(README.split()) <= 650


FEATURES = re.findall(r"^\* (\*\*It .*)$", README, re.MULTILINE)


@pytest.mark.parametrize("feature", FEATURES, ids=lambda f: f.split("**")[1])
def test_every_figure_of_the_readme_is_on_the_page_that_it_links_to(feature: str) -> None:
    pages = "".join((PROJECT / t.partition("#")[0]).read_text("utf-8") for t in LINK.findall(feature))
    figures = re.findall(r"(?<![\w.])\d+(?:\.\d+)?", LINK.sub("", feature))
    assert figures
    assert [f for f in figures if not re.search(rf"(?<![\d.]){re.escape(f)}(?![\d])", pages)] == []


def test_the_readme_tells_the_share_that_the_benchmark_measured() -> None:
    told = re.search(r"named or listed the truth in ([\d.]+) % .*?\[[^\]]*\]\(([^)#]+)", README)
    assert told
    page = (PROJECT / told[2]).read_text("utf-8")
    measured = re.search(r"^\| s = 20 to 200: .*?\| 95 % \| ([\d.]+) %", page, re.MULTILINE)
    assert measured
    assert told[1] == measured[1]


def test_the_documentation_speaks_of_no_machine() -> None:
    spoken = {name_of(p): re.findall(r"/(?:home|root)/\S+", p.read_text("utf-8"), re.I) for p in PAGES}
    assert not {page: found for page, found in spoken.items() if found}


def require_made(pages: Mapping[Path, str]) -> None:
    stale = [name_of(page) for page, text in pages.items() if page.read_text("utf-8") != text]
    assert not stale, f"not what the code says: {', '.join(stale)}; run make docs"


def test_the_pages_made_of_register_types_and_profile_models_are_theirs() -> None:
    made = runpy.run_path(str(PROJECT / "docs/reference/profile.py"))["pages"]()
    assert len(made) == 4
    require_made(made)


def test_the_pages_and_schemas_of_documents_are_those_of_their_models() -> None:
    names = runpy.run_path(str(PROJECT / "docs/reference/documents.py"))
    made = names["pages"]()
    assert len(made) > len(names["MODELS"])
    require_made(made)


def test_the_page_of_the_effects_is_what_they_say_of_themselves() -> None:
    names = runpy.run_path(str(PROJECT / "docs/reference/effects.py"))
    require_made({names["PAGE"]: names["page"]()})


def test_the_page_of_the_python_names_is_that_of_their_docstrings() -> None:
    script = PROJECT / "docs/reference/python.py"
    names = runpy.run_path(str(script))
    require_made({names["PAGE"]: names["page"]()})
    described = [
        *names["FUNCTIONS"],
        *names["CLASSES"],
        *names["ERRORS"],
        *names["VALUES"],
        *names["ROOMS"],
        *names["CONSTANTS"],
    ]
    assert {*described, "__version__"} == set(tc.__all__)
