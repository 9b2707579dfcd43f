"""Wrong arguments end with one line and the right exit code, before any recording is read."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.many.conftest import environment

Run = Callable[..., Any]
CASES = [
    ("audit", "MANIFEST"),
    ("audit {} --jobs 0", "--jobs"),
    ("audit {} --jobs two", "--jobs"),
    ("audit {} --jobs 2 --scheduler tcp://127.0.0.1:1", "not allowed with"),
    ("audit {} --memory 0", "--memory"),
    ("audit {} --memory 100M --jobs 2", "at least 200M"),
    ("audit file://[a", "file://[a"),
    ("audit {} -o {f}/t.xlsx", "expected a name that ends in .parquet, .csv, .csv.gz, .sqlite"),
    ("audit {} -o {f}/none/t.csv", "there is no folder"),
    ("audit {} --resume", "--resume: give the table"),
    ("audit {} -o {f}/other.sqlite", "a database with other tables"),
    ("audit {f}/empty", "without a recording (.mcap) in it"),
    ("audit {f}/x*", "no file has a name like this"),
    ("audit {f}/nothing.list", "no recording is in this list"),
    ("audit {f}/no.list", "No such file"),
    ("audit odd://x/a.mcap", "odd://x/a.mcap"),
    ("audit {} --scheduler odd", "no Dask scheduler answers"),
    ("batch", "poses|fit|diagnose|verify|apply"),
    ("batch frame {} -o {f}/t.csv", "frame"),
    ("batch poses {}", "-o"),
    ("batch fit {} -o {f}/t.csv --attitude-error 0.1", "there are no --attitudes"),
    ("batch verify {} -o {f}/t.csv", "--calibration"),
    ("batch verify {} -o {f}/t.csv --calibration {f}/no.json", "no.json"),
    ("batch verify {} -o {f}/t.csv --calibration {f}/nothing.list", "nothing.list"),
    ("batch apply {} -o {f}/t.csv --calibration beside", "--to"),
    ("batch apply {} -o {f}/t.csv --calibration beside --to {f}/nothing.list", "no folder"),
    ("batch apply {} -o {f}/t.csv --calibration beside --to {f}/out --own-recording --phase verification", "no times"),
]


@pytest.mark.parametrize(("arguments", "words"), CASES, ids=[case[0] for case in CASES])
def test_a_wrong_argument_is_2(tmp_path: Path, triaxcal: Run, arguments: str, words: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "nothing.list").write_text("# nothing\n")
    (tmp_path / "a.mcap").write_text("x")
    with sqlite3.connect(tmp_path / "other.sqlite") as db:
        db.execute("CREATE TABLE run (a)")
    given = arguments.replace("{f}", str(tmp_path)).replace("{}", str(tmp_path / "a.mcap"))
    triaxcal(*given.split()).failed(2, words)
    assert not (tmp_path / "t.csv").exists()


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("distributed", ["audit", "a.mcap", "--jobs", "2"]),
        ("distributed", ["audit", "a.mcap", "--scheduler", "tcp://127.0.0.1:1"]),
        ("dask", ["batch", "poses", "a.mcap", "-o", "{}", "--jobs", "3"]),
        ("fsspec", ["audit", "s3://bucket/a.mcap"]),
        ("fsspec", ["poses", "s3://bucket/a.mcap"]),
        ("s3fs", ["audit", "s3://bucket/a.mcap"]),
    ],
)
def test_a_missing_extra_is_named(
    tmp_path: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, module: str, arguments: list[str]
) -> None:
    monkeypatch.delitem(sys.modules, "triaxcald.many.cluster", raising=False)
    monkeypatch.setitem(sys.modules, module, None)
    done = triaxcal(*(word.format(tmp_path / "t.csv") for word in arguments))
    done.failed(2, f"the package {module} is not installed; pip install 'triaxcal[fleet]' brings it")


@pytest.mark.parametrize("command", [["audit"], ["batch", "poses"], ["poses"]])
def test_one_recording_loads_neither_dask_nor_fsspec(tmp_path: Path, command: list[str]) -> None:
    (tmp_path / "a.mcap").write_text("no recording")
    code = """
import sys
from triaxcald.cli.commands import main
code = main(sys.argv[1:])
print(code, *({"dask", "distributed", "fsspec"} & set(sys.modules)))
"""
    table = ["-o", str(tmp_path / "t.csv")] if command[0] == "batch" else []
    done = subprocess.run(
        [sys.executable, "-c", code, *command, str(tmp_path / "a.mcap"), *table],
        env=environment(), capture_output=True, text=True, check=True, timeout=180,
    )  # fmt: skip
    assert done.stdout.splitlines()[-1] == "2"
