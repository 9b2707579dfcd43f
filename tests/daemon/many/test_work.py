"""Work at one recording gives a row, whatever happens."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import triaxcal as tc
from tests.daemon.many import works
from tests.daemon.many.conftest import environment
from triaxcald.errors import InputError
from triaxcald.many import Finding, Settings, Source, attempt, is_current
from triaxcald.many.work import WrongVersion


@pytest.fixture
def source(tmp_path: Path) -> Source:
    path = tmp_path / "odd"
    path.write_bytes(b"abc")
    return Source(str(path), 3, "7")


def test_a_row_says_of_which_file_and_by_which_software(source: Source) -> None:
    settings = Settings("d1")
    done = attempt(works.tells, source, settings)
    row = done.row
    assert (row["recording"], row["exit_code"], row["error"]) == (source.name, 0, None)
    assert (row["size"], row["stamp"], row["settings"]) == (3, "7", "d1")
    assert row["sha256"] == hashlib.sha256(b"abc").hexdigest()
    assert row["software"] == tc.__version__
    assert float(row["seconds"] or 0) >= 0


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("no table"), 2, "no table"),
        (tc.Refused("too few", wanted=("+X", "-Y")), 3, "refused: too few; add the poses +X, -Y"),
        (MemoryError("Unable to allocate 1 PiB"), 5, "memory ran out: Unable to allocate 1 PiB"),
        (KeyError("x"), 4, "internal error: KeyError: 'x'"),
        (ModuleNotFoundError("No module named 's3fs'", name="s3fs"), 2, "pip install 'triaxcal[fleet]'"),
    ],
    ids=repr,
)
def test_every_error_is_a_row_that_names_the_recording(source: Source, error: Exception, code: int, words: str) -> None:
    def work(path: Any) -> Finding:
        raise error

    done = attempt(work, source, Settings("d1"))
    assert done.exit_code == code
    assert done.error is not None
    assert words in done.error
    assert source.name in done.error
    assert "\n" not in done.error


@pytest.mark.parametrize(
    ("error", "cause", "read"),
    [
        (InputError("no table"), None, True),
        (tc.Refused("too few"), None, True),
        (InputError("the store refuses"), PermissionError(13, "credentials expired"), False),
        (InputError("the package s3fs is not installed"), ModuleNotFoundError(name="s3fs"), False),
        (ModuleNotFoundError("No module named 's3fs'", name="s3fs"), None, False),
        (MemoryError("none"), None, False),
    ],
    ids=repr,
)
def test_an_error_of_the_recording_has_its_digest_and_one_of_the_process_none(
    source: Source, error: Exception, cause: Exception | None, read: bool
) -> None:
    def work(path: Any) -> Finding:
        raise error from cause

    done = attempt(work, source, Settings("d1"))
    assert done.row["sha256"] == (hashlib.sha256(b"abc").hexdigest() if read else None)
    assert is_current(done.row, source, Settings("d1")) is read


def test_a_recording_that_this_machine_has_not_is_tried_again(source: Source) -> None:
    Path(source.name).unlink()
    done = attempt(works.reads, source, Settings("d1"))
    assert (done.exit_code, done.row["size"]) == (2, source.size)
    assert not is_current(done.row, source, Settings("d1"))


def test_an_error_in_the_one_recording_asked_for_keeps_its_trace(source: Source) -> None:
    with pytest.raises(AttributeError, match="no such thing"):
        attempt(works.breaks, source, Settings("d1"), supervised=False)


def test_another_version_is_no_row(source: Source) -> None:
    with pytest.raises(WrongVersion, match="expected 99"):
        attempt(works.tells, source, Settings("d1", "99"))


@pytest.mark.slow
def test_what_wants_more_memory_than_it_may_have_fails_alone(tmp_path: Path) -> None:
    for name in ("large", "small"):
        (tmp_path / name).write_bytes(b"x")
    code = f"""
import resource
from tests.daemon.many import works
from triaxcald.many import Settings, Source, attempt
for name in ("large", "small"):
    done = attempt(works.grows, Source({str(tmp_path)!r} + "/" + name, 1, "1"), Settings("d", memory=300 * 2**20))
    print(done.exit_code, done.error)
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]
print(int(peak) >> 10, resource.getrlimit(resource.RLIMIT_DATA)[0])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=True, timeout=300
    )
    large, small, after = done.stdout.splitlines()
    assert large.startswith(f"5 {tmp_path}/large: memory ran out")
    assert small == "0 None"
    peak_mib, limit = map(int, after.split())
    assert peak_mib < 330
    assert limit == -1  # the limit is there for the work alone
