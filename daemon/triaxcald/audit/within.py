"""Figures that other software computed: how far each is off, in its uncertainty, and
a result that is the same within a share of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.audit.figures import SHARE, Agreement, Figures, beyond_rounding, figures_of, inside
from triaxcald.audit.results import Again, stored_certificate
from triaxcald.certificate import Certified, with_registers
from triaxcald.outcome import CERTIFICATE
from triaxcald.provision.registers import checksum_of, image_of
from triaxcald.run.write_back import VERIFICATION_FILE

COMPUTES = ("triaxcal", "numpy", "scipy")
"""Software of which other versions may compute other figures."""


@dataclass(frozen=True)
class Moved:
    """A figure that does not come out the same, and by how much of its ``uncertainty``
    both differ beyond their rounding. None where the figure has no uncertainty."""

    part: str
    place: str
    stored: float
    again: float
    uncertainty: float | None
    of_uncertainty: float | None


@dataclass(frozen=True)
class Within:
    """Figures that may be off by ``limit`` of their uncertainties, and those that are
    off at all. ``by`` is the software that computed them then: versions by name."""

    limit: float
    by: Mapping[str, str]
    moved: tuple[Moved, ...] = ()

    @property
    def largest(self) -> Moved | None:
        """The one that is furthest off in its uncertainty."""
        return max((m for m in self.moved if m.uncertainty), key=_share, default=None)

    def share_at(self, part: str, place: str) -> float | None:
        """By how much of its uncertainty a figure is off; None where it has none."""
        return next((m.of_uncertainty for m in self.moved if (m.part, m.place) == (part, place)), None)


def _share(of: Moved) -> float:
    return of.of_uncertainty or 0.0


def moved(again: Again, stored: Mapping[str, Mapping[str, Any] | None]) -> Iterator[Moved]:
    """Each figure of certificate and verification that is not as ``stored``."""
    documents = {VERIFICATION_FILE: again.verification}
    if again.certified is not None:
        documents = {CERTIFICATE: again.certified.document, **documents}
    for part, document in documents.items():
        held = stored_certificate(stored) if part == CERTIFICATE else stored.get(part)
        if document is None or not held:
            continue
        figures, then = _figures(document), dict(figures_of(held))
        for place, figure in figures_of(document):
            before = then.get(place)
            if before is not None and before != figure:
                known = figures.uncertainty_of(place, figure)
                share = beyond_rounding(before, figure) / known if known else None
                yield Moved(part, place, before, float(figure), known, share)


def same_within(
    again: Again, stored: Mapping[str, Mapping[str, Any] | None], limit: float, agreement: Agreement
) -> Again:
    """With the ``stored`` figures that are off by at most ``limit`` of their
    uncertainties, and with the register words that encode such a figure.

    Verdicts and other decisions are not made again: they stay those of the figures
    that were computed ``again``. Raises LookupError, TypeError or ValueError where the
    stored certificate lacks a part, DriverError for words that the profile does not
    have.
    """
    certified, verification = again.certified, again.verification
    certificate, checked = stored_certificate(stored), stored.get(VERIFICATION_FILE)
    if certified is not None:
        certified = _words_within(again, certified, certificate, limit)
        document = _figures(certified.document, limit).taken(CERTIFICATE, certificate, agreement)
        certified = replace(certified, document=document)
    if verification is not None and checked is not None:
        verification = _figures(verification, limit).taken(VERIFICATION_FILE, checked, agreement)
    return replace(again, certified=certified, verification=verification)


def _figures(document: Mapping[str, Any], limit: float = SHARE) -> Figures:
    return Figures(document, limit, dict(derived(document)))


P_VALUE = 12**-0.5
"""A p-value is uniform from 0 to 1 where nothing acts; this is its deviation."""
_OF_RESIDUALS = ("rms_g", "max_abs_g", "cross_validated_rms_g", "before_rms_g", "after_max_abs_g")
_OF_REGISTERS = (
    "rms_g", "cost_rms_g", "rounding_rms_g", "left_rms_g", "left_largest_g", "own_rms_g.before", "own_rms_g.predicted",
)  # fmt: skip
_P_VALUES = ("lack_of_fit_p", "p_value")
_PROBABILITIES = ("probability", "nothing_probability", "outlier_probability", "weight")


def derived(node: Any, at: str = "") -> Iterator[tuple[str, float]]:
    """Uncertainties, by place, of figures that follow from others in the document."""
    if isinstance(node, list):
        for i, inner in enumerate(node):
            yield from derived(inner, f"{at}[{i}]")
    if not isinstance(node, Mapping):
        return
    for place, uncertainty in (*_of_residuals(node), *_of_probabilities(node), *_of_places(node)):
        yield inside(at, place), uncertainty
    for key, inner in node.items():
        yield from derived(inner, inside(at, key))


def _of_residuals(node: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """Where each residual moves by a share of its standard error, their largest and
    their rms move by at most about that share of the rms standard error (the noise
    floor), and χ² per degree of freedom by its derivative. So do rms changes of the
    magnitude in these poses, which the registers make."""
    if floor := node.get("noise_floor_g"):
        yield from ((key, floor) for key in _OF_RESIDUALS if key in node)
        yield "noise_floor_g", tc.rounding.KNOWN_TO * floor
    if chi2 := node.get("reduced_chi2"):
        yield "reduced_chi2", max(1.0, 2 * chi2**0.5)
    if node.get("registers") and "result" in node and (floor := node["result"]["after"]["noise_floor_g"]):
        yield from ((f"registers.{key}", floor) for key in _OF_REGISTERS)


def _of_probabilities(node: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """The odds of a posterior are known to a factor of e at best."""
    of_effects = {f"probabilities.{name}": p for name, p in node.get("probabilities", {}).items()}
    for place, p in ({key: node[key] for key in _PROBABILITIES if key in node} | of_effects).items():
        if p:
            yield place, p * (1 - p)
    yield from ((key, P_VALUE) for key in _P_VALUES if key in node)


def _of_places(node: Mapping[str, Any]) -> Iterator[tuple[str, float]]:
    """A direction is known as well as the magnitude of its pose, and so is the place of
    a pose, or of a curve through poses, in a trace."""
    if "direction" in node and (error := node.get("standard_error_g")):
        yield from ((f"direction[{i}]", error) for i in range(len(node["direction"])))
    if "x" in node and (errors := node.get("error")):
        yield from ((f"x[{i}]", error) for i, error in enumerate(errors))
        curve = node.get("curve") or {}
        yield from ((f"curve.x[{i}]", max(errors)) for i in range(len(curve.get("x", ()))))


def _words_within(again: Again, certified: Certified, stored: Mapping[str, Any], limit: float) -> Certified:
    """The registers for the coefficients of the ``stored`` certificate, where these are
    the same, and its words where they encode such a coefficient. The register traffic
    is judged by the stored words. Whether the registers are better than what the device
    held stays as it was computed."""
    own, held = certified.document["registers"], stored.get("registers")
    words = held.get("words") if isinstance(held, Mapping) else None
    if own is None or not isinstance(words, list) or len(words) != len(own["words"]):
        return certified
    figures, profile = Figures(own, limit), again.bundle.profile
    taken = figures.taken("", {"words": words}, Agreement())["words"]
    wanted = {
        new["role"]: new["wanted"]
        for old, new in zip(own["words"], taken, strict=True)
        if old["wanted"] != new["wanted"]
    }
    made = with_registers(certified, again.bundle, again.station, wanted) if wanted else certified
    registers = made.document["registers"]
    raw = {word["register"]: bytes.fromhex(word["raw"]) for word in registers["words"]}
    for i, (word, before) in enumerate(zip(registers["words"], words, strict=True)):
        off = limit * (figures.uncertainties.get(f"words[{i}].wanted") or 0.0)
        data = bytes.fromhex(before["raw"])
        if _encodes(profile, word, data, off):
            raw[word["register"]] = data
    if profile.crc is not None and profile.crc.register_name in raw:
        name = profile.crc.register_name
        raw[name] = profile.encode(name, checksum_of(profile, raw))
    registers = {**registers, "words": [_word(profile, word, raw) for word in registers["words"]]}
    image = image_of(profile, {word["register"]: bytes.fromhex(word["raw"]) for word in words})
    return replace(made, document={**made.document, "registers": registers}, image=image, better=certified.better)


def _encodes(profile: td.Profile, word: Mapping[str, Any], raw: bytes, off: float) -> bool:
    """Whether a ``raw`` word is that of a figure so little ``off`` the wanted one."""
    if not off:
        return False
    name, wanted = word["register"], word["wanted"]
    try:
        ends = [profile.decode(name, profile.encode(name, wanted + way * off)) for way in (-1, 1)]
        return min(ends) <= profile.decode(name, raw) <= max(ends)
    except td.RegisterValueError:  # beside the register's range
        return False


def _word(profile: td.Profile, word: Mapping[str, Any], raw: Mapping[str, bytes]) -> dict[str, Any]:
    """The word of a certificate with its ``raw`` bytes."""
    name = word["register"]
    if raw[name].hex() == word["raw"]:
        return dict(word)
    value = profile.decode(name, raw[name])
    of_checksum = {"wanted": tc.rounding.number(value)} if profile.crc and profile.crc.register_name == name else {}
    return {**word, "raw": raw[name].hex(), "held": tc.rounding.number(value), **of_checksum}
