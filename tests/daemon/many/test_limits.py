"""A container may have less than its machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from triaxcald.many.limits import memory, processors


def group(folder: Path, **said: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in said.items():
        (folder / f"{name}.max").write_text(f"{text}\n")


@pytest.mark.parametrize(
    ("outer", "inner", "cores", "limit"),
    [
        ({}, {"cpu": "max 100000", "memory": "max"}, None, None),
        ({}, {"cpu": "50000 100000", "memory": "1000"}, 1, 1000),
        ({"cpu": "100000 100000", "memory": "900"}, {"cpu": "max 100000", "memory": "1000"}, 1, 900),
        ({}, {"cpu": "odd", "memory": "odd"}, None, None),
    ],
    ids=str,
)
def test_the_least_of_all_groups_counts(
    tmp_path: Path, outer: dict[str, str], inner: dict[str, str], cores: int | None, limit: int | None
) -> None:
    group(tmp_path / "groups" / "a", **outer)
    group(tmp_path / "groups" / "a" / "b", **inner)
    own = tmp_path / "own"
    own.write_text("0::/a/b\n")
    unlimited = processors(tmp_path / "groups", tmp_path / "nowhere")
    assert processors(tmp_path / "groups", own) == (cores or unlimited)
    assert memory(tmp_path / "groups", own) == limit


def test_without_control_groups_the_machine_counts(tmp_path: Path) -> None:
    assert processors(tmp_path, tmp_path / "nowhere") >= 1
    assert memory(tmp_path, tmp_path / "nowhere") is None
