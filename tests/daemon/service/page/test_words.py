"""Every text of the pages is there in each language, and each is used."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator

import pytest

from triaxcald.provision.state import DeviceState
from triaxcald.schema.codes import Code, Stage, Verdict
from triaxcald.schema.station_state import SlotIs
from triaxcald.service.desk import ENDED, WORK
from triaxcald.service.errors import Problem
from triaxcald.service.page import FOLDER, LANGUAGES, PAGES, THEMES, words

TABLE = tomllib.loads((FOLDER / "words.toml").read_text(encoding="utf-8"))
SOURCES = [*sorted((FOLDER / "templates").glob("*.html")), *sorted((FOLDER / "static").glob("*.js"))]
LITERAL = re.compile(r"""["']([a-z_]+\.[a-z_]+)["']""")
COMPOSED = re.compile(r"""[`"]([a-z_]+)\.(?:\$\{|" ~)""")


def families() -> dict[str, set[str]]:
    """What pages compose from the names of programs."""
    problems = {*(p.value for p in Problem), "no_answer"}
    return {
        "code": {code.value for code in Code},
        "device": {state.value for state in DeviceState},
        "figure": {"rms_g", "cross_validated_rms_g", "verification_rms_g", "scale_factor", "misalignment", "bias"},
        "page": {*(page for page, _ in PAGES), *THEMES},
        "problem": problems | {f"{problem}_do" for problem in problems},
        "role": {"reader", "operator", "engineer"},
        "stage": {stage.value for stage in Stage},
        "state": {state.value for state in SlotIs} - {state.value for state in ENDED.values()},
        "task": {"power_off", "power_on"},
        "verdict": {verdict.value for verdict in Verdict},
        "work": set(WORK),
    }


def used() -> set[str]:
    found, composed = set(), set()
    for source in SOURCES:
        text = source.read_text(encoding="utf-8")
        found |= {key for key in LITERAL.findall(text) if key.partition(".")[0] in TABLE}
        composed |= set(COMPOSED.findall(text))
    assert composed == set(families())
    return found | {f"{table}.{name}" for table, names in families().items() for name in names}


def entries() -> Iterator[tuple[str, dict[str, str]]]:
    for table, texts in TABLE.items():
        for name, by_language in texts.items():
            yield f"{table}.{name}", by_language


@pytest.mark.parametrize("key", [key for key, _ in entries()])
def test_an_entry_has_a_text_in_each_language_with_the_same_blanks(key: str) -> None:
    texts = dict(entries())[key]
    assert set(texts) == set(LANGUAGES)
    assert all(text == text.strip() != "" for text in texts.values())
    assert len({frozenset(re.findall(r"\{\w+\}", text)) for text in texts.values()}) == 1


def test_every_entry_is_used_and_every_one_that_is_used_is_there() -> None:
    there = set(words("en"))
    assert used() - there == set()
    assert there - used() == set()


def test_a_ukrainian_text_holds_no_letter_that_only_looks_ukrainian() -> None:
    mixed = re.compile(r"[a-zA-Z][а-яіїєґА-ЯІЇЄҐ]|[а-яіїєґА-ЯІЇЄҐ][a-zA-Z]")
    russian = re.compile("[ыэъё]", re.IGNORECASE)
    assert [key for key, texts in entries() if mixed.search(texts["uk"]) or russian.search(texts["uk"])] == []


def test_templates_and_scripts_hold_no_text_of_their_own() -> None:
    """What stands between two tags comes from the table."""
    for template in (FOLDER / "templates").glob("*.html"):
        text = re.sub(r"\{%.*?%\}|\{\{.*?\}\}|\{#.*?#\}", "", template.read_text(encoding="utf-8"), flags=re.DOTALL)
        shown = [part.strip() for part in re.sub(r"<[^>]*>", "\n", text).splitlines()]
        assert [part for part in shown if re.search(r"[A-Za-z]{2}", part)] == [], template.name
