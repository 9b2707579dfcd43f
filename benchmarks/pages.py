"""Parts of a page of the documentation that a benchmark writes, between marks that name them."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"
PICTURES = DOCS / "pictures"


def write(page: Path, parts: Mapping[str, str]) -> int:
    """Each part in the place of what stands between its marks; the exit code, 2 where marks are missing."""
    text = page.read_text("utf-8")
    for mark, content in parts.items():
        begin, end = f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
        if begin not in text or end not in text:
            sys.stderr.write(f"{page}: the marks {begin} and {end} are missing\n")
            return 2
        inside = f"{begin}\n{content.strip()}\n{end}"
        text = re.sub(f"{begin}.*{end}", lambda _, inside=inside: inside, text, flags=re.DOTALL)
    page.write_text(text, "utf-8")
    return 0
