"""Audits under the versions that made a recording, in environments of wheels from a folder, without a network."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.audit.forging import Forgery
from tests.daemon.audit.other_software import GOLDEN, made_with
from tests.daemon.audit.wheel_making import needs_of, of_source, repacked, small_wheel
from triaxcald.audit import as_made
from triaxcald.audit.as_made import Part, Software, document_of, grouped, required, worst_of
from triaxcald.audit.wheels import Wheels
from triaxcald.cli.commands import main
from triaxcald.errors import RecordingError
from triaxcald.many import Unusable
from triaxcald.software import drawn_with, versions

VERSIONS = {"triaxcal": "0.1.9", "numpy": "1.26.0", "scipy": "1.11.0", "matplotlib": "3.8.0", "jinja2": "3.1.0"}
PROGRAM = """
import json, os, sys
def main():
    arguments = sys.argv[1:]
    paths = arguments[arguments.index("--") + 1 :]
    if "--json" in arguments:
        audits = [{{"recording": path, "differences": [], "error": None, "by": "{version}"}} for path in paths]
        print(json.dumps({{"format": "triaxcal.audit/1", "audits": audits, "more": 1}}))
    else:
        print("{version} audits", *map(os.path.basename, paths))
    sys.exit({code})
"""
"""Stands in for another version: says which one it is, and ends with a code of its own."""
UNREACHABLE = dict.fromkeys(
    ("http_proxy", "https_proxy", "all_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9"
)


def folder_of(folder: Path, versions: Mapping[str, str], code: int = 0, **options: Any) -> Path:
    """Small wheels of these versions."""
    folder.mkdir(exist_ok=True)
    for name, version in versions.items():
        program = PROGRAM.format(version=version, code=code) if name == "triaxcal" else ""
        small_wheel(folder, name, version, program=program, **(options if name == "triaxcal" else {}))
    return folder


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "triaxcal" / "as-made"


def run(*arguments: object) -> int:
    return main(["audit", *map(str, arguments)])


# What a recording says.


def test_a_recording_names_its_software_and_the_computer_is_none_of_it() -> None:
    found = as_made.made_with(GOLDEN)
    assert [name for name, _ in found.packages] == ["triaxcal", "jinja2", "matplotlib", "numpy", "scipy"]
    assert re.fullmatch(r"3\.\d+", found.python or "")
    assert str(found.requirements()[0]) == f"triaxcal=={dict(found.packages)['triaxcal']}"
    assert str(found.requirements(signed=True)[0]).startswith("triaxcal[sign]==")


@pytest.mark.parametrize(
    "software",
    [
        {"numpy": "2.4 --index-url http://127.0.0.1:9"},
        {"numpy": "2.4; import os"},
        {"numpy": "*"},
        {"numpy": ""},
        {"numpy @ file:///tmp/x": "1.0"},
        {"--pre": "1.0"},
        {"triaxcal": "../../x"},
    ],
)
def test_what_is_no_name_or_version_becomes_no_command(tmp_path: Path, software: dict[str, str]) -> None:
    with pytest.raises(RecordingError, match="metadata software"):
        as_made.made_with(made_with(tmp_path / "x.mcap", software))


@pytest.mark.parametrize("python", ["", "3", "3.x", "3.11/../x", "three", "3.1111"])
def test_a_python_that_is_none_is_not_looked_for(tmp_path: Path, python: str) -> None:
    assert as_made.made_with(made_with(tmp_path / "x.mcap", {"python": python})).python is None


def test_a_recording_without_versions_hides_no_other(tmp_path: Path) -> None:
    forged = Forgery.of(GOLDEN)
    forged.drop("software")
    silent = forged.write(tmp_path / "silent.mcap")
    older = made_with(tmp_path / "older.mcap", {"triaxcal": "0.1.9"})
    (tmp_path / "no.mcap").write_bytes(b"no recording")
    found, failed = grouped([GOLDEN, silent, older, tmp_path / "no.mcap", GOLDEN])
    assert sorted(map(len, found.values())) == [1, 2]
    assert [one.name for one in failed] == [str(silent), str(tmp_path / "no.mcap")]
    assert {one.exit_code for one in failed} == {2}


# Options.


@pytest.mark.parametrize(
    "arguments",
    [
        ("--as-made",),
        ("--wheels", "."),
        ("--as-made", "--wheels", ".", "--within", "0.01"),
        ("--within", "0"),
        ("--within", "-0.01"),
        ("--within", "nan"),
        ("--within", "inf"),
        ("--within", "much"),
        ("--as-made", "--wheels", "nowhere"),
    ],
)
def test_options_that_make_no_sense_end_with_two(arguments: tuple[str, ...], capfd: Any) -> None:
    try:
        code = run(*arguments, GOLDEN)
    except SystemExit as e:
        code = int(str(e.code))
    assert code == 2
    told = capfd.readouterr()
    assert told.out == ""
    assert len(told.err.splitlines()) == 1


# The environment.


def test_everything_that_the_folder_lacks_is_named_and_nothing_is_built(
    tmp_path: Path, cache: Path, capfd: Any
) -> None:
    folder = folder_of(tmp_path / "wheels", {"triaxcal": "0.1.8", "scipy": "1.11.0"})
    small_wheel(folder, "jinja2", "3.1.0", tag="cp27-cp27m-win32")
    assert run("--as-made", "--wheels", folder, made_with(tmp_path / "x.mcap", VERSIONS)) == 2
    told = capfd.readouterr().err.splitlines()[-1]
    for words in ("triaxcal 0.1.9 (there is 0.1.8)", "numpy 1.26.0", "matplotlib 3.8.0", "another platform (win32)"):
        assert words in told
    assert "scipy" not in told
    assert not cache.exists()


def test_the_cache_is_where_the_specification_has_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for said in ("", "relative/folder"):
        monkeypatch.setenv("XDG_CACHE_HOME", said)
        assert as_made.cache_folder() == tmp_path / ".cache" / "triaxcal" / "as-made"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    assert as_made.cache_folder() == tmp_path / "c" / "triaxcal" / "as-made"


@pytest.mark.slow
def test_each_software_has_one_environment_and_keeps_it(tmp_path: Path, cache: Path, capfd: Any) -> None:
    folder = folder_of(tmp_path / "wheels", VERSIONS)
    folder_of(folder, VERSIONS | {"triaxcal": "0.1.8"}, code=1)
    paths = [
        made_with(tmp_path / f"{name}.mcap", VERSIONS | {"triaxcal": version})
        for name, version in (("a", "0.1.9"), ("b", "0.1.8"), ("c", "0.1.9"))
    ]
    assert run("--as-made", "--wheels", folder, *paths) == 1
    assert capfd.readouterr().out.splitlines() == ["0.1.9 audits a.mcap c.mcap", "0.1.8 audits b.mcap"]
    built = {path.name: path.stat().st_ino for path in cache.iterdir()}
    assert len(built) == 2
    assert all(re.fullmatch(r"triaxcal-0\.1\.[89]-python3\.\d+-[0-9a-f]{16}", name) for name in built)

    # Again, as one document in the order asked for, with a recording that is none.
    (tmp_path / "no.mcap").write_bytes(b"no recording")
    assert run("--json", "--as-made", "--wheels", folder, *paths, tmp_path / "no.mcap") == 2
    document = json.loads(capfd.readouterr().out)
    assert [Path(audit["recording"]).stem for audit in document["audits"]] == ["a", "b", "c", "no"]
    assert [audit.get("by") for audit in document["audits"]] == ["0.1.9", "0.1.8", "0.1.9", None]
    assert document["summary"] == {"recordings": 4, "agree": 3, "differ": 0, "unreadable": 1}
    assert {path.name: path.stat().st_ino for path in cache.iterdir()} == built

    # Of one software, its own document and exit code.
    assert run("--json", "--as-made", "--wheels", folder, paths[1]) == 1
    assert json.loads(capfd.readouterr().out)["more"] == 1

    # Other wheels of the same version are other software.
    small_wheel(folder, "triaxcal", "0.1.9", program=PROGRAM.format(version="another build", code=0))
    assert run("--as-made", "--wheels", folder, paths[0]) == 0
    assert capfd.readouterr().out.splitlines() == ["another build audits a.mcap"]
    assert len(list(cache.iterdir())) == 3


@pytest.mark.slow
def test_what_a_wheel_needs_is_named_where_pip_does_not_find_it(tmp_path: Path, cache: Path, capfd: Any) -> None:
    """No index page in the folder leads to it, nor pip's own configuration."""
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    needed = small_wheel(elsewhere, "needed", "1.0")
    folder = folder_of(tmp_path / "wheels", VERSIONS, requires=["needed==1.0", "alike>=2"])
    (folder / "index.html").write_text(f'<a href="{needed.as_uri()}">{needed.name}</a>')
    (folder / "links.html").write_text(f'<a href="{needed.as_uri()}">{needed.name}</a>')
    environment = {"PIP_FIND_LINKS": str(elsewhere), "PIP_EXTRA_INDEX_URL": elsewhere.as_uri()}
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        assert run("--as-made", "--wheels", folder, made_with(tmp_path / "x.mcap", VERSIONS)) == 2
    told = capfd.readouterr().err.splitlines()[-1]
    assert "lacks needed 1.0, which triaxcal needs; alike >=2, which triaxcal needs" in told
    assert list(cache.iterdir()) == []


@pytest.mark.slow
def test_a_python_that_is_not_there_is_replaced_with_a_note(
    tmp_path: Path, cache: Path, capfd: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name on the PATH that runs nothing, as version managers have them, is no Python."""
    shim = tmp_path / "bin" / "python3.98"
    shim.parent.mkdir()
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(shim.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{shim.parent}{os.pathsep}{os.environ['PATH']}")
    folder = folder_of(tmp_path / "wheels", VERSIONS)
    paths = [made_with(tmp_path / f"{v}.mcap", VERSIONS | {"python": f"3.{v}.1"}) for v in (98, 99)]
    assert run("--as-made", "--wheels", folder, *paths) == 0
    told = capfd.readouterr()
    assert len(told.out.splitlines()) == 2
    this = f"Python 3.{sys.version_info.minor} takes its place"
    for v in (98, 99):
        assert f"note: python3.{v} is not on the PATH; {this}" in told.err
    assert len(list(cache.iterdir())) == 1


@pytest.mark.slow
def test_a_python_on_the_path_is_taken(tmp_path: Path) -> None:
    others = [v for v in range(11, 15) if v != sys.version_info.minor and as_made.interpreter_for(f"3.{v}").note == ""]
    if not others:
        pytest.skip("no other Python is on the PATH")
    found = as_made.interpreter_for(f"3.{others[0]}")
    assert found.target.markers["python_version"] == f"3.{others[0]}"
    assert f"cp3{others[0]}-none-any" in found.target.tags
    assert not any(
        tag.startswith(f"cp3{others[0]}-cp3{others[0]}-") for tag in as_made.interpreter_for(None).target.tags
    )


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupted_build_leaves_nothing_that_is_used(tmp_path: Path, cache: Path, number: int) -> None:
    folder = folder_of(tmp_path / "wheels", VERSIONS)
    path = made_with(tmp_path / "x.mcap", VERSIONS)
    command = [sys.executable, "-m", "triaxcald.cli", "audit", "--as-made", "--wheels", folder, path]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not any(begun.exists() for begun in cache.glob(".building-*/pyvenv.cfg")):
        time.sleep(0.01)
    process.send_signal(number)
    _, told = process.communicate()
    assert process.returncode == 130, told
    assert "Traceback" not in told
    assert [found.name for found in cache.iterdir() if not found.name.startswith(".building-")] == []
    assert run("--as-made", "--wheels", folder, path) == 0


def test_what_killed_builds_have_left_is_removed_after_a_day(tmp_path: Path) -> None:
    old, new, whole = (tmp_path / name for name in (".building-old", ".building-new", "triaxcal-0.1.9"))
    for path in (old, new, whole):
        (path / "bin").mkdir(parents=True)
    for path in (old, whole):
        os.utime(path, (time.time() - 2 * 86_400,) * 2)
    as_made._remove_abandoned(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".building-new", "triaxcal-0.1.9"]


def test_signatures_are_verified_where_the_folder_has_what_does_it(tmp_path: Path) -> None:
    software, target = Software((("triaxcal", "0.1.9"),), None), as_made.interpreter_for(None).target
    needs = ["cryptography>=42; extra == 'sign'"]
    small_wheel(tmp_path, "triaxcal", "0.1.9", requires=needs, headers=["Provides-Extra: sign"])
    found, needed = required(software, Wheels.of(tmp_path), target)
    assert (list(map(str, found)), needed) == (["triaxcal==0.1.9"], [])
    small_wheel(tmp_path, "cryptography", "44.0")
    found, needed = required(software, Wheels.of(tmp_path), target)
    assert (list(map(str, found)), needed) == (["triaxcal[sign]==0.1.9"], [])


# Documents and codes.


def test_an_audit_that_leaves_no_document_is_an_error_of_its_recordings() -> None:
    parts = [
        Part((Path("a"),), 4, b"no document"),
        Part((Path("b"),), 2, error="--wheels w: lacks numpy 1.0"),
        Part(
            (Path("c"), Path("d")),
            1,
            json.dumps({"audits": [{"recording": "c", "differences": ["x"], "error": None}]}).encode(),
        ),
    ]
    document = document_of(parts, [Unusable("e", "damaged", 2)], ["e", "d", "c", "b", "a"])
    errors = {audit["recording"]: audit["error"] for audit in document["audits"]}
    assert list(errors) == ["e", "d", "c", "b", "a"]
    assert "ended with 4" in errors["a"]
    assert errors["b"] == "--wheels w: lacks numpy 1.0"
    assert errors["c"] is None
    assert errors["d"]
    assert document["summary"] == {"recordings": 5, "agree": 0, "differ": 1, "unreadable": 4}


@pytest.mark.parametrize(
    ("codes", "worst"), [([], 0), ([0, 1], 1), ([1, 2], 2), ([2, 5], 5), ([5, 130], 130), ([130, 77, 4], 77)]
)
def test_the_worst_code_counts(codes: list[int], worst: int) -> None:
    assert worst_of(codes) == worst


# The real thing.


@pytest.fixture
def offline() -> list[str]:
    """A command that takes the network from another, where the system allows it."""
    wrapper = ["unshare", "--map-root-user", "--net"]
    able = (
        shutil.which("unshare") and subprocess.run([*wrapper, "true"], capture_output=True, check=False).returncode == 0
    )
    return wrapper if able else []


@pytest.mark.slow
def test_a_recording_comes_out_the_same_under_its_versions_without_a_network(
    tmp_path: Path, offline: list[str]
) -> None:
    """Wheels of this source, and of all that it needs as it is installed here. A report may be drawn otherwise in the
    next commit of the same development version."""
    folder = tmp_path / "wheels"
    folder.mkdir()
    of_source(folder)
    for name in needs_of("triaxcal"):
        repacked(folder, name)
    here = {**versions(), **drawn_with()}
    same = made_with(tmp_path / "same.mcap", here)
    differs = made_with(
        tmp_path / "forged.mcap", here, {"certificate.json": lambda c: c["result"]["calibration"]["bias"].reverse()}
    )
    environment = {**os.environ, **UNREACHABLE, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = [*offline, sys.executable, "-m", "triaxcald.cli", "audit", "--json", "--as-made", "--wheels", folder]
    done = subprocess.run([*command, same, differs], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    audits = json.loads(done.stdout)["audits"]
    found = [{line.partition(":")[0] for line in audit["differences"]} for audit in audits]
    assert found[0] <= {"report.html"}
    assert "certificate.json" in found[1]
    assert all({"certificate.json", "verification.json"} <= set(audit["checked"]) for audit in audits)
    (inner,) = (tmp_path / "cache" / "triaxcal" / "as-made").iterdir()
    where = "import triaxcald; print(triaxcald.__file__)"
    said = subprocess.run([inner / "bin/python", "-I", "-c", where], capture_output=True, text=True, check=True)
    assert Path(said.stdout.strip()).is_relative_to(inner)
