"""The page of a fleet: whole, quoted, and of the width of a phone."""

from __future__ import annotations

import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

from tests.daemon.fleet.worlds import certificate, line, write
from triaxcald.fleet import Asked, Selection, fleet_document, fleets_of, read_runs, render_fleet
from triaxcald.fleet.page import acting, drift_table, gauge_table, lasting, notices
from triaxcald.fleet.places import Placed, PlaceOfEffect
from triaxcald.schema.fleet import FleetDocument

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.slow


PLACED = [
    Placed(
        "candidate",
        (PlaceOfEffect("hour", "14-18", 1.0),),
        None,
        None,
        None,
        "bias_x",
        0.6,
        "0.1 mg",
        "The bias of x is higher in the afternoon.",
    ),
    Placed(
        "confounded",
        (PlaceOfEffect("fixture", "F2 <b>", 0.7), PlaceOfEffect("station", "S1", 0.3)),
        "2026-03-02",
        ("2026-03-01", "2026-03-04"),
        "2026-06-01",
        "bias_y",
        0.998,
        "4.0(2) mg",
        "Fixture F2 shifts the bias of y.",
    ),
]


@pytest.fixture(scope="module")
def lined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    documents = line()
    for document in documents[:3]:
        document["work"]["batch"] = '<script>alert("x")</script>'
    return write(tmp_path_factory.mktemp("line"), documents, [certificate(0.9)] * len(documents))


@pytest.fixture(scope="module")
def page(lined: Path) -> tuple[dict, str]:
    runs = read_runs(str(lined), Selection())
    fleets = fleets_of(runs)
    made = fleet_document(fleets, "<out>", runs.skipped, Asked(limit_g=0.02), lambda _: PLACED)
    document = FleetDocument.model_validate(made).document()
    return document, render_fleet(document, fleets)


def test_the_page_is_whole_and_quotes_what_data_say(page: tuple[dict, str]) -> None:
    class Tags(HTMLParser):
        found: list[str]

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            self.found.append(tag)
            assert not any(
                name in ("src", "onload") or (name == "href" and not (of or "").startswith("#")) for name, of in attrs
            )

    parser = Tags()
    parser.found = []
    parser.feed(page[1])
    assert "script" not in parser.found
    assert "b" not in parser.found
    assert parser.found.count("svg") >= 20
    assert "&lt;out&gt;" in page[1]
    for heading in (
        "Effects of places", "Distributions", "Control charts", "Capability", "Gauge repeatability and reproducibility",
        "Recalibration interval", "Effects",
    ):  # fmt: skip
        assert f"<h3>{heading}</h3>" in page[1]


def test_effects_of_places_come_with_the_most_probable_first(page: tuple[dict, str]) -> None:
    (product,) = page[0]["products"]
    assert [value["kind"] for value in product["places"]] == ["fixture", "hour"]
    assert page[1].index("Fixture F2 shifts the bias of y.") < page[1].index("The bias of x is higher")


def test_a_place_is_shown_with_its_verdict_its_rivals_and_its_end(page: tuple[dict, str]) -> None:
    (product,) = page[0]["products"]
    confounded, candidate = product["places"]
    assert (confounded["kind"], confounded["place"], confounded["verdict"]) == ("fixture", "F2 <b>", "confounded")
    assert [(p["kind"], p["name"], p["probability"]) for p in confounded["places"]] == [
        ("fixture", "F2 <b>", 0.7), ("station", "S1", 0.3),
    ]  # fmt: skip
    assert (candidate["verdict"], candidate["until"]) == ("candidate", None)
    for words in (
        "Fixture F2 &lt;b&gt; or station S1", "from 2026-03-02 (95 %: 2026-03-01 to 2026-03-04) until 2026-06-01",
        "Hours 14-18 UTC", "always", 'class="finding confounded"', 'class="finding"',
    ):  # fmt: skip
        assert words in page[1]


@pytest.mark.parametrize(
    ("since", "until", "said"),
    [(None, None, "always"), (None, "b", "until b"), ("a", None, "since a"), ("a", "b", "from a until b")],
)
def test_the_time_of_an_effect_has_its_ends(since: str | None, until: str | None, said: str) -> None:
    assert acting({"since": since, "since_interval": None, "until": until}) == said


def test_the_same_fleet_gives_the_same_bytes(page: tuple[dict, str], lined: Path) -> None:
    document, text = page
    fleets = fleets_of(read_runs(str(lined), Selection()))
    again = FleetDocument.model_validate(document).document()
    assert again == document
    assert render_fleet(again, fleets) == text
    assert text.count("<figure>") == text.count("</figure>")


def test_notices_name_the_fixture_and_the_gauge(page: tuple[dict, str]) -> None:
    told = list(notices(page[0]["products"][0]))
    assert any("Bias y differs by fixture, most at F2" in text for text in told)
    assert any("Bias y: %GRR" in text and "by fixture (above 30 %: not acceptable, AIAG)" in text for text in told)


def test_tables_have_a_row_a_coefficient(page: tuple[dict, str]) -> None:
    (product,) = page[0]["products"]
    assert len(drift_table(product)) == 9
    gauges = gauge_table(product)
    assert gauges["factors"] == ["fixture"]
    assert {"Bias y, 10⁻³ g"} <= {row["title"] for row in gauges["rows"]}


def test_times_are_told_in_their_unit() -> None:
    assert [lasting(days) for days in (0.0, 0.01, 0.5, 3.0, 100.0, 1000.0, None)] == [
        "no time", "14 minutes", "12 hours", "3.0 days", "3.3 months", "2.7 years", "longer than the data can tell",
    ]  # fmt: skip


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium (apt-get install chromium)")
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_a_phone(page: tuple[dict, str], tmp_path: Path, scheme: str) -> None:
    from playwright.sync_api import sync_playwright

    (tmp_path / "fleet.html").write_text(page[1], encoding="utf-8")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"])
        shown = browser.new_page(viewport={"width": 400, "height": 800}, color_scheme=scheme)
        shown.goto((tmp_path / "fleet.html").as_uri())
        assert shown.evaluate("document.documentElement.scrollWidth") == 400
        browser.close()
