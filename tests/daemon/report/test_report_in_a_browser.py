"""The report in a real browser, as wide as a telephone: nothing has to be scrolled sideways."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from html import escape, unescape
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest

from triaxcal.diagnosis import diagnose
from triaxcald.documents import loop_document
from triaxcald.inputs import measure
from triaxcald.report import StreamOverview, render_report, thin

_spec = spec_from_file_location("sample_documents", Path(__file__).with_name("sample_documents.py"))
assert _spec is not None
assert _spec.loader is not None
samples = module_from_spec(_spec)
_spec.loader.exec_module(samples)

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium (apt-get install chromium)"),
]
RECORDINGS = Path(__file__).parents[3] / "recordings"
QUIET = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
PHONE_PX = 400
MEASURE = """
<script>
const shown = [...document.querySelectorAll("body, body *")]
  .filter(e => !e.parentElement.closest("svg") && e.getClientRects().length).map(e => [e, e.getBoundingClientRect()]);
const found = {
  wide: innerWidth,
  scroll: document.documentElement.scrollWidth,
  outside: shown.filter(([e, box]) => box.right > innerWidth + 0.5 || box.left < -0.5)
    .map(([e, box]) => e.tagName + ": " + e.textContent.trim().slice(0, 60)),
  after: shown.filter(([e, box]) => e.tagName == "TH" && e.textContent == "After").map(([e, box]) => box.right),
  tops: shown.filter(([e, box]) => e.parentElement == document.querySelector(".panels")).map(([e, box]) => box.top),
};
parent.document.getElementById("measured").textContent = JSON.stringify(found);
</script>
"""
FRAME = """<!DOCTYPE html><pre id="measured"></pre>
<iframe width="{width}" height="3000" style="border:0" srcdoc="{page}">
</iframe>"""
"""A browser's own window is never narrower than 500 pixels."""


def measured(folder: Path, page: str, width_px: int) -> dict[str, Any]:
    """Of the page in a window so wide: its width, the elements that reach beyond it, and where panels stand."""
    file = folder / "page.html"
    measuring = page.replace("</body>", f"{MEASURE}</body>")
    file.write_text(FRAME.format(width=width_px, page=escape(measuring)), encoding="utf-8")
    assert CHROMIUM is not None
    done = subprocess.run(
        [CHROMIUM, *QUIET, f"--user-data-dir={folder / 'profile'}", "--window-size=1400,3000", "--dump-dom",
         file.as_uri()],
        capture_output=True, text=True, check=True, timeout=180,
    )  # fmt: skip
    text = done.stdout.partition('<pre id="measured">')[2].partition("</pre>")[0]
    found: dict[str, Any] = json.loads(unescape(text))
    assert found["wide"] == width_px
    return found


def of_recording(name: str, **options: Any) -> str:
    poses = measure(str(RECORDINGS / name)).poses
    loop = diagnose(poses, signs=(-1, -1, -1), **options)
    return render_report(loop_document(loop, output_unit="V"), title=name)


def with_everything() -> str:
    """Every table that there may be, long names, an excluded pose and a stream."""
    document = samples.loop_document()
    document["calibration"]["poses"][4] |= {"used": False, "residual_g": 3.062e-3, "excluded": "outlier"}
    document["calibration"]["uncertainty"] = {
        "level": 0.95, "expanded": {}, "magnitude": {"standard_g": 4.4e-5, "expanded_g": 8.6e-5},
        "budget": [{"source": "reference", "evaluation": "B", "magnitude_g": 4e-5, "share": 1.0, "how": "as stated"}],
    }  # fmt: skip
    document["data_quality"] = ["/a/path/without/a/blank/" + "folder/" * 12 + "x.csv: saturation: x: take again"]
    papers = samples.certificate() | {"registers": {"terms": ["linear"], "words": [
        {"register": "second_order_nonlinearity_x", "role": "second_order_nonlinearity.x", "raw": "85471ac0",
         "wanted": 0.0056123456, "held": 0.00561234, "unit": "g/g^2"}]}}  # fmt: skip
    spans = tuple((pose["start_s"], pose["end_s"]) for pose in document["calibration"]["poses"])
    stream = StreamOverview(*thin(*samples.raw_stream(document)), spans, "V")
    return render_report(document, title="unit", certificate=papers, stream=stream)


PAGES: dict[str, Callable[[], str]] = {
    "a name": lambda: of_recording("modbus-temperature-bias.mcap"),
    "a candidate": lambda: of_recording("can-second-order.mcap"),
    "unexplained": lambda: of_recording("modbus-temperature-bias.mcap", catalogue=()),
    "everything": with_everything,
}


@pytest.mark.parametrize("name", PAGES)
def test_on_a_telephone_nothing_is_wider_than_the_page_and_panels_stand_below_each_other(
    tmp_path: Path, name: str
) -> None:
    page = PAGES[name]()
    phone = measured(tmp_path, page, PHONE_PX)
    assert phone["outside"] == []
    assert phone["scroll"] <= PHONE_PX
    assert phone["tops"] == sorted(set(phone["tops"]))
    assert len(phone["after"]) == page.count(">After</th>")
    assert all(right <= PHONE_PX for right in phone["after"])
    desk = measured(tmp_path, page, 1280)
    assert desk["outside"] == []
    if len(desk["tops"]) > 1:
        assert desk["tops"][0] == desk["tops"][1]
