"""What a folder of wheels lacks of an environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement

from tests.daemon.audit.wheel_making import small_wheel
from triaxcald.audit.wheels import Target, Wheels
from triaxcald.errors import InputError

LINUX = Target(
    frozenset({"cp311-cp311-manylinux_2_17_x86_64", "cp311-abi3-manylinux_2_17_x86_64", "py3-none-any"}),
    {
        "python_version": "3.11", "python_full_version": "3.11.7", "sys_platform": "linux", "os_name": "posix",
        "implementation_name": "cpython", "implementation_version": "3.11.7", "platform_machine": "x86_64",
        "platform_python_implementation": "CPython", "platform_release": "", "platform_system": "Linux",
        "platform_version": "",
    },
)  # fmt: skip


def missing(folder: Path, *wanted: str) -> list[str]:
    return Wheels.of(folder).missing(map(Requirement, wanted), LINUX)


def test_all_that_lacks_is_named_at_once(tmp_path: Path) -> None:
    small_wheel(tmp_path, "line", "1.0", requires=["mid>=2,<3", "leaf", "colour; sys_platform == 'win32'"])
    small_wheel(tmp_path, "mid", "2.1", requires=["deep==4.0", "more; extra == 'all'"])
    assert missing(tmp_path, "line==1.0", "other==5.0") == [
        "other 5.0",
        "leaf, which line needs",
        "deep 4.0, which mid needs",
    ]
    assert missing(tmp_path, "mid[all]==2.1") == ["deep 4.0, which mid needs", "more, which mid needs"]


def test_nothing_lacks_of_a_whole_folder(tmp_path: Path) -> None:
    small_wheel(tmp_path, "line", "0.2.0.dev0", requires=["Some.Name>=1"])
    small_wheel(tmp_path, "some-name", "1.5", tag="cp311-abi3-manylinux2014_x86_64.manylinux_2_17_x86_64")
    assert missing(tmp_path, "line==0.2.0.dev0") == []


@pytest.mark.parametrize(
    ("tag", "words", "other"),
    [
        ("cp312-cp312-manylinux_2_17_x86_64", ["another Python (cp312-cp312)"], "another platform"),
        ("cp311-cp311-win_amd64", ["another platform (win_amd64)"], "another Python"),
        ("cp39-cp39-win32", ["another Python (cp39-cp39)", "another platform (win32)"], "there is"),
    ],
)
def test_a_wheel_for_another_python_or_platform_is_named_as_such(
    tmp_path: Path, tag: str, words: list[str], other: str
) -> None:
    small_wheel(tmp_path, "line", "1.0", tag=tag)
    (told,) = missing(tmp_path, "line==1.0")
    assert told.startswith("line 1.0 (line-1.0-")
    assert all(word in told for word in words)
    assert other not in told


def test_another_version_and_a_source_are_named(tmp_path: Path) -> None:
    small_wheel(tmp_path, "line", "1.1")
    small_wheel(tmp_path, "line", "0.9")
    (tmp_path / "part-2.0.tar.gz").touch()
    assert missing(tmp_path, "line==1.0", "part==2.0") == [
        "line 1.0 (there is 0.9, 1.1)",
        "part 2.0 (there is its source, expected a wheel)",
    ]


def test_a_wheel_that_needs_another_python_is_named(tmp_path: Path) -> None:
    small_wheel(tmp_path, "line", "1.0", headers=["Requires-Python: >=3.12"])
    assert missing(tmp_path, "line==1.0") == ["line 1.0 (needs Python >=3.12)"]


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no archive", b"\x00" * 4000])
def test_a_damaged_wheel_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "line-1.0-py3-none-any.whl").write_bytes(content)
    (told,) = missing(tmp_path, "line==1.0")
    assert "line-1.0-py3-none-any.whl: is no wheel" in told


def test_damaged_metadata_are_named(tmp_path: Path) -> None:
    small_wheel(tmp_path, "line", "1.0", requires=["=== what"])
    (told,) = missing(tmp_path, "line==1.0")
    assert told.startswith("line 1.0 (its metadata are damaged")


@pytest.mark.parametrize("name", ["x.whl", "line-1.0.whl", "a-b-c-d-e-f-g-h.whl", "notes.txt", "index.html"])
def test_other_files_are_no_wheels(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("text")
    assert Wheels.of(tmp_path).by_name == {}


@pytest.mark.parametrize("make", [lambda p: None, lambda p: p.write_text("")], ids=["nothing", "a file"])
def test_what_is_no_folder_is_an_error(tmp_path: Path, make: Any) -> None:
    make(tmp_path / "x")
    with pytest.raises(InputError, match="expected a folder of wheels"):
        Wheels.of(tmp_path / "x")
