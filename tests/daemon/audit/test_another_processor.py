"""An audit where the linear algebra runs otherwise than at the station."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.audit.forging import OUTCOME, Forgery
from triaxcald.audit import text
from triaxcald.audit.conduct import Result
from triaxcald.computer import KERNEL, KEYS

pytestmark = pytest.mark.slow

CERTIFICATE = "certificate.json"
CPUINFO = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
X86 = platform.machine() in ("x86_64", "AMD64")
NEEDED = {
    "Prescott": "pni", "Nehalem": "sse4_2", "SandyBridge": "avx", "Haswell": "fma", "Zen": "fma",
    "SkylakeX": "avx512f", "Cooperlake": "avx512_bf16", "Sapphirerapids": "amx_tile",
}  # fmt: skip
"""Core types of OpenBLAS for x86-64, and what each needs of the processor: its code would not run without."""
KERNELS = [name for name, flag in NEEDED.items() if X86 and re.search(rf"\b{flag}\b", CPUINFO)]
SIMD = ("AVX512_SPR AVX512_ICL AVX512_SKX X86_V4", "AVX512_SPR AVX512_ICL AVX512_SKX X86_V4 AVX2 FMA3 X86_V3")
ENVIRONMENTS: list[dict[str, str]] = [
    *({"OPENBLAS_NUM_THREADS": n, "OMP_NUM_THREADS": n} for n in ("1", "4")),
    *({"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "2"} for kernel in KERNELS),
    *({"NPY_DISABLE_CPU_FEATURES": off} for off in SIMD if X86),
]


@pytest.fixture(scope="module")
def demo(once: Callable[..., Path]) -> list[Path]:
    """Two units; the CAN one of this seed has two effects that are hard to tell apart, and ill-conditioned figures."""

    def make(folder: Path) -> None:
        command = [sys.executable, "-m", "triaxcald.cli", "demo", "--out", str(folder), "--seed", "2"]
        subprocess.run(command, capture_output=True, check=True)

    return sorted(once("demo-of-seed-2", make).glob("*.mcap"))


@pytest.mark.parametrize("environment", ENVIRONMENTS, ids=lambda e: ",".join(e.values()))
def test_an_untouched_recording_is_never_said_to_differ(demo: list[Path], environment: dict[str, str]) -> None:
    paths = demo  # tests/test_golden_recordings.py has the others
    done = subprocess.run(
        [sys.executable, "-m", "triaxcald.cli", "audit", "--json", *map(str, paths)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    audits = json.loads(done.stdout)["audits"]
    assert [a["differences"] for a in audits] == [[]] * len(paths), done.stderr
    assert {a["result"] for a in audits} <= {"same_bytes", "same_figures"}
    assert done.returncode == 0


def _edited(source: Path, out: Path, change: Callable[[Any], None], *, outcome_too: bool) -> Path:
    """By somebody who brings all digests in step."""
    forged = Forgery.of(source)
    forged.edit(CERTIFICATE, change)
    digest = hashlib.sha256(forged.attachment(CERTIFICATE).data).hexdigest()
    if outcome_too:
        forged.edit(OUTCOME, lambda o: o["sha256"].update({CERTIFICATE: digest}))
    forged.seal()
    return forged.write(out)


def _line_of_budget(by: float) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        document["result"]["calibration"]["uncertainty"]["budget"][0]["misalignment"][0] *= 1 + by

    return change


@pytest.mark.parametrize(("by", "result"), [(1e-5, Result.SAME_FIGURES), (1e-2, Result.DIFFERS)])
def test_a_digest_is_compared_by_the_document(
    finished_run: Any, tmp_path: Path, auditor: Any, by: float, result: Result
) -> None:
    """A line of a budget is known to its own size."""
    path = _edited(finished_run.can, tmp_path / "x.mcap", _line_of_budget(by), outcome_too=True)
    found = auditor(path)
    assert found.result is result, found.differences
    place = "result.calibration.uncertainty.budget[0].misalignment[0]"
    if result is Result.SAME_FIGURES:
        assert found.agreement.of_uncertainty == pytest.approx(1e-5, rel=0.6)  # the stored figure is a rounded one
        assert found.agreement.worst == f"{CERTIFICATE}: {place}"
        assert "the same figures (largest difference " in text.heading(found)
    else:
        assert f"{CERTIFICATE}: {place}: stored " in text.difference(found.differences[0]) or any(
            d.part == CERTIFICATE and d.place == place for d in found.differences
        )


def test_a_digest_of_another_document_is_found(finished_run: Any, tmp_path: Path, auditor: Any) -> None:
    path = _edited(finished_run.can, tmp_path / "x.mcap", _line_of_budget(1e-5), outcome_too=False)
    found = auditor(path)
    assert [(d.part, d.place) for d in found.differences] == [(OUTCOME, f"sha256.{CERTIFICATE}")]


def test_the_outcome_has_the_certificate_s_own_figures(finished_run: Any, tmp_path: Path, auditor: Any) -> None:
    """It was copied from there, by no arithmetic."""
    forged = Forgery.of(finished_run.can)
    forged.edit(OUTCOME, lambda o: o["measured"]["after"].update(rms_g=o["measured"]["after"]["rms_g"] * (1 + 1e-10)))
    forged.seal()
    found = auditor(forged.write(tmp_path / "x.mcap"))
    assert [(d.part, d.place) for d in found.differences] == [(OUTCOME, "measured.after.rms_g")]


def test_the_recording_says_on_which_computer_it_was_made(finished_run: Any, auditor: Any) -> None:
    found = auditor(finished_run.can)
    then, now = found.computed_on
    assert set(then) == set(KEYS)
    assert then == now
    certificate = json.loads(finished_run.can.with_suffix(f".{CERTIFICATE}").read_text())
    assert {key: certificate["software"][key] for key in KEYS} == dict(then)
    document = text.document(str(finished_run.can), found)
    assert document["result"] == "same_bytes"
    assert document["largest_difference"] is None
    assert document["computer"] == {"then": then, "now": now}


def test_another_processor_is_named_as_such(finished_run: Any, tmp_path: Path, auditor: Any) -> None:
    """Metadata and certificate as a station with another kernel makes them."""
    forged = Forgery.of(finished_run.can)
    forged.metadata("software").metadata[KERNEL] = "Nehalem"
    for name in (CERTIFICATE, OUTCOME):
        forged.edit(name, lambda document: document["software"].update({KERNEL: "Nehalem"}))
    forged.edit(CERTIFICATE, _line_of_budget(1e-5))
    digest = hashlib.sha256(forged.attachment(CERTIFICATE).data).hexdigest()
    forged.edit(OUTCOME, lambda o: o["sha256"].update({CERTIFICATE: digest}))
    report = forged.attachment("report.html").data.decode()
    now = json.loads(finished_run.can.with_suffix(f".{CERTIFICATE}").read_text())["software"][KERNEL]
    forged.put("report.html", report.replace(f">{now}<", ">Nehalem<").encode())
    digest = hashlib.sha256(forged.attachment("report.html").data).hexdigest()
    forged.edit(OUTCOME, lambda o: o["sha256"].update({"report.html": digest}))
    forged.seal()
    found = auditor(forged.write(tmp_path / "x.mcap"))
    assert found.differences == ()
    assert "; computed on another processor)" in text.heading(found)
    assert found.notes.versions == {}
