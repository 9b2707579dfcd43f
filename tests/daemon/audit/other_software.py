"""The golden recording as other versions of software would have made it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tests.daemon.audit.forging import OUTCOME, Forgery
from triaxcald.audit.results import DRAWN_WITH

CERTIFICATE = "certificate.json"
GOLDEN = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
Edit = Callable[[dict[str, Any]], object]


def made_with(out: Path, software: Mapping[str, str], edits: Mapping[str, Edit] | None = None) -> Path:
    """The golden recording as other ``software`` would have made it, with documents edited and in step."""
    forged = Forgery.of(GOLDEN)
    forged.metadata("software").metadata.update(software)
    computes = {name: version for name, version in software.items() if name not in DRAWN_WITH}
    for name in (CERTIFICATE, OUTCOME):
        forged.edit(name, lambda document: document["software"].update(computes))
    for name, edit in (edits or {}).items():
        forged.edit(name, edit)
    digest = hashlib.sha256(forged.attachment(CERTIFICATE).data).hexdigest()
    forged.edit(OUTCOME, lambda o: o["sha256"].update({CERTIFICATE: digest}))
    forged.seal()
    return forged.write(out)
