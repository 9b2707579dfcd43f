"""What a bare install lacks, and which extra brings it."""

from __future__ import annotations

import importlib.util

import pytest

from triaxcal_drivers.hints import absent


@pytest.fixture
def without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)


@pytest.mark.usefixtures("without")
@pytest.mark.parametrize(
    ("modules", "extra"), [(("can", "canopen"), "can"), (("pymodbus",), "modbus"), (("can", "pymodbus"), "station")]
)
def test_one_extra_brings_all_that_is_missing(modules: tuple[str, ...], extra: str) -> None:
    assert f"pip install 'triaxcal[{extra}]' brings it" in str(absent(modules))


@pytest.mark.usefixtures("without")
def test_of_a_package_that_no_extra_brings_the_name_is_all_that_is_said() -> None:
    assert absent(("elsewhere",)) == "the package elsewhere is not installed"
    assert (
        absent(("elsewhere", "can")) == "the package python-can is not installed; pip install 'triaxcal[can]' brings it"
    )


def test_where_all_are_there_nothing_is_absent() -> None:
    assert absent(("json",)) is None
