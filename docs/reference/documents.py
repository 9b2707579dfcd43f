"""Writes the pages and the JSON Schemas of the documents from their models: `python docs/reference/documents.py`."""

from __future__ import annotations

import ast
import inspect
import json
import re
from collections.abc import Iterator
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

from pydantic import TypeAdapter

import triaxcal as tc
from triaxcald.documents import to_text
from triaxcald.provision.state import DeviceState, Evidence, Observation
from triaxcald.schema.certificate import Certificate
from triaxcald.schema.codes import Code, Stage, Verdict
from triaxcald.schema.event import KINDS, Event, Head
from triaxcald.schema.fleet import FleetDocument
from triaxcald.schema.outcome import Outcome
from triaxcald.schema.profile_check import Fault, ProfileCheck
from triaxcald.schema.quality import Chart, Quality
from triaxcald.schema.result import Result
from triaxcald.schema.results import Results
from triaxcald.schema.run import Demo, Run
from triaxcald.schema.station_state import SlotIs, StationState
from triaxcald.schema.verification import Verification

HERE = Path(__file__).parent
LINK = re.compile(r"\[([^]]+)\]\([^)]*\)")
ANOTHER_PAGE = re.compile(r"\]\(\w+\.md")
MODELS: dict[str, type[tc.schema.Model]] = {
    "poses": tc.schema.Poses,
    "calibration": tc.schema.Calibration,
    "loop": tc.schema.Loop,
    "rezero": tc.schema.Rezero,
    "odds": tc.schema.LearnedOdds,
    "certificate": Certificate,
    "verification": Verification,
    "outcome": Outcome,
    "run": Run,
    "demo": Demo,
    "results": Results,
    "station-state": StationState,
    "quality": Quality,
    "chart": Chart,
    "fleet": FleetDocument,
    "result": Result,
    "profile-check": ProfileCheck,
}
JSON_TYPES = {
    "string": "text",
    "number": "number",
    "integer": "integer",
    "boolean": "boolean",
    "null": "`null`",
    "object": "object",
}
PLACES = {"items": "[]", "additionalProperties": ".NAME"}
"""Of an object inside a list or a table by name, in the key of a row."""
POSES = """# Poses

`triaxcal poses --json` prints `triaxcal.poses/1`. Rounding, `null` and units are those of [all documents](documents.md).

Made from the model in `triaxcal/schema/poses.py` by `docs/reference/documents.py`; [JSON Schema](poses.schema.json).

"""  # noqa: E501
CALIBRATION = """# Calibration

`triaxcal fit` and `rezero` write `triaxcal.calibration/1`, so does `tc.Calibration.save`; a [loop](loop.md) has one under `calibration`. Rounding, `null` and units are those of [all documents](documents.md). A key that only some methods have is absent elsewhere.

Made from the model in `triaxcal/schema/calibration.py` by `docs/reference/documents.py`; [JSON Schema](calibration.schema.json).

"""  # noqa: E501
METHODS = """
## Biases anew

`rezero` and `run --rezero`: `poses` are those used, `holds_at` is their mean. The sources of the budget are `kept` (earlier calibration), `since` (changes between recordings), `noise`, `scatter`, `lack_of_fit`.

## A turning unit

`fit --turning`: `poses` is empty, `dilution` is in noises of one sample over the root of their number, `residual` is of stretches. There is no `uncertainty`.

## Known attitudes

`fit --attitudes`: `poses` are those with an attitude, `lack_of_fit_p` is of whole vectors, `dilution` of one axis's four parameters. There is no `uncertainty`.

## Refined datasheet values

`fit --datasheet`: `lack_of_fit_p` is `passport.conflict_p`, `dilution` is of the poses alone. There is no `uncertainty`.
"""  # noqa: E501
LOOP = """# Loop

`triaxcal diagnose` writes `triaxcal.loop/1`; a [certificate](certificate.md) has one as its `result`. Rounding, `null` and units are those of [all documents](documents.md). Keys of 0.1 without a meaning today are `null`.

Made from the models in `triaxcal/schema/loop.py` by `docs/reference/documents.py`; JSON Schema of a [loop](loop.schema.json) and a [rezero](rezero.schema.json).

"""  # noqa: E501
REZERO = """
## Several recordings

Coefficients ending in `_run2` act in the second recording alone. `run_bias` and `run_scale_factor` are its deviation from the mean of all recordings, or with `_run2_alone` from all the others. `channel_reference.run_index` stands for these. Elsewhere they count as zero, and no register takes them.

## Rezero

After `run --rezero` the `result` of a certificate is a `triaxcal.rezero/1`. It has the keys of a loop that are listed here:

"""  # noqa: E501
ODDS = """# Learned odds

`triaxcal fleet -o` writes `triaxcal.odds/1`; `diagnose --odds`, `run --odds`, the station key `odds` and `tc.diagnose(poses, odds=…)` take it ([how](../how-to/diagnose-several-recordings.md#odds-of-a-type)).

Made from the model in `triaxcal/schema/odds.py` by `docs/reference/documents.py`; [JSON Schema](odds.schema.json).

"""  # noqa: E501
CERTIFICATE = """# Certificate

`triaxcal run` and `demo` write `triaxcal.certificate/1` for each unit that did not fail: a file, and an attachment of the recording. It has no time of issue and no signature: an audit computes the same bytes. Rounding, `null` and units are those of [all documents](documents.md).

Made from the models in `daemon/triaxcald/schema/` by `docs/reference/documents.py`; JSON Schema of the [certificate](certificate.schema.json) and the [verification](verification.schema.json).

"""  # noqa: E501
VERIFICATION = """
## Verification

`triaxcal.verification/1`, an attachment of the recording: the magnitude that the device itself reports, in other attitudes than the fit's.

"""  # noqa: E501
OUTCOME = """# Outcome

`triaxcal run`, `provision` and `restore` end with one document, `triaxcal.outcome/1`. It says what became of the unit and what the device holds. A recording has it as its last attachment, `outcome.json`; the same bytes lie beside it as `UNIT-SERIAL-TIME.outcome.json`. `provision` and `restore` write `SERIAL-TIME.outcome.json` into the station's folder. With `--json` it stands under `units[].outcome` of `triaxcal.run/1` and under `outcome` of `triaxcal.provisioning/1` and `triaxcal.restoration/1`, with its path in `outcome_file`. An outcome is never edited: a rework writes another that names this one. `run` leaves one for every attempt: without a recording it is `SLOT-SERIAL-TIME.outcome.json`, with `recording` `null`. If the process was killed, or stopped by a third signal, the next start in the folder mends the recording and writes the outcome, with the code `killed`; until then `running/` in the folder has a file for the attempt. `provision` and `restore` leave none if the device was not reached or its registers were not read.

Made from the model in `daemon/triaxcald/schema/outcome.py` by `docs/reference/documents.py`; [JSON Schema](outcome.schema.json).

"""  # noqa: E501
MARK = """
A probe is a value in use that is stored nowhere ([0012](../decisions/0012-every-write-can-be-undone.md)). If the state is open, the last line of the command names the one that settles it.

"""  # noqa: E501
RUN = """# Run and demo

`triaxcal run --json` prints `triaxcal.run/1`, `demo --json` prints `triaxcal.demo/1`.

Made from the models in `daemon/triaxcald/schema/run.py` by `docs/reference/documents.py`; JSON Schema of a [run](run.schema.json) and a [demo](demo.schema.json).

"""  # noqa: E501
DEMO = """
## Demo

The units are simulated ones. Besides the keys of a run:

"""
EVENT = """# Events

`triaxcal run --events` prints one `triaxcal.event/1` a line, on standard output, as the work goes on ([how to use them](../how-to/use-from-openhtf-or-pytest.md)). A program ignores keys and events that it does not know.

Made from the models in `daemon/triaxcald/schema/event.py` by `docs/reference/documents.py`; [JSON Schema](event.schema.json).

## Every event

"""  # noqa: E501
RESULTS = """# Results

`triaxcal results FOLDER --json` prints `triaxcal.results/1`. A table (`-o`) has the keys of `runs` as columns, an empty cell for `null`, and `terms` in one cell, separated by `; `. Table `run` of the [index](../how-to/run-as-a-service.md#results-of-all-runs) has the same columns.

Made from the columns in `daemon/triaxcald/schema/columns.py` by `docs/reference/documents.py`; [JSON Schema](results.schema.json).

"""  # noqa: E501
STATION_STATE = """# Station state

The [service](../how-to/run-a-station.md) answers GET `/api/1/station` by `triaxcal.station_state/1`, and begins `/api/1/events` with it.

Made from the model in `daemon/triaxcald/schema/station_state.py` by `docs/reference/documents.py`; [JSON Schema](station-state.schema.json).

"""  # noqa: E501
QUALITY = """# Quality

The [service](../how-to/run-a-station.md) answers GET `/api/1/quality` by `triaxcal.quality/1`.

Made from the models in `daemon/triaxcald/schema/quality.py` by `docs/reference/documents.py`; JSON Schema of [quality](quality.schema.json) and [chart](chart.schema.json).

"""  # noqa: E501
FLEET = """# Fleet

`triaxcal fleet --json` prints `triaxcal.fleet/1` ([how to](../how-to/learn-from-many-units.md)). A unit counts once, with its last run that has the figure; gauge studies and drifts take all runs of units that were measured more than once. Intervals are of 95 %.

Made from the models in `daemon/triaxcald/schema/fleet.py` by `docs/reference/documents.py`; [JSON Schema](fleet.schema.json).

"""  # noqa: E501
CHART = """
## Chart

GET `/api/1/charts?name=NAME`, with the filters of `/quality`, answers `triaxcal.chart/1`: individuals and moving ranges of two, by the end of the attempts. One value a unit, chosen as above.

"""  # noqa: E501
RESULT = """# Result for receivers

The [service](../how-to/run-a-station.md#results-for-other-systems) sends `triaxcal.result/1` to each receiver of the station file.

Made from the model in `daemon/triaxcald/schema/result.py` by `docs/reference/documents.py`; [JSON Schema](result.schema.json).

"""  # noqa: E501
PROFILE_CHECK = """# Check of a profile

`triaxcal devices check PROFILE [LOG] --json` prints `triaxcal.profile_check/1` ([how to use it](../how-to/describe-a-device.md#try-it)).

Made from the model in `daemon/triaxcald/schema/profile_check.py` by `docs/reference/documents.py`; [JSON Schema](profile-check.schema.json).

"""  # noqa: E501
JOURNAL = """
## Journal

Before the first write the journal is on the disk, with what the device held and is to hold: `journal/PRODUCT-SERIAL.json` in the station's folder, or `journal/SLOT-RUN.json` without a serial number (characters outside `A–Z a–z 0–9 . _ -` become `_`). It goes once the device is settled. [`provision --resume`](../how-to/provision-registers.md#after-a-cut) and `restore` go by it; they also find `journal/SERIAL.json` of an earlier version.
"""  # noqa: E501


def pages() -> dict[Path, str]:
    """The text of each page by its path."""
    made = {HERE / f"{name}.schema.json": _json_schema(model.model_json_schema()) for name, model in MODELS.items()}
    made[HERE / "event.schema.json"] = _json_schema(TypeAdapter(Event).json_schema())
    texts = {
        "poses": POSES + _keys(tc.schema.Poses),
        "calibration": CALIBRATION + _keys(tc.schema.Calibration) + METHODS,
        "loop": LOOP + _keys(tc.schema.Loop) + REZERO + _keys(tc.schema.Rezero, but=tc.schema.Loop),
        "odds": ODDS + _keys(tc.schema.LearnedOdds),
        "certificate": CERTIFICATE + _keys(Certificate) + VERIFICATION + _keys(Verification),
        "outcome": _outcome(),
        "run": RUN + _keys(Run) + DEMO + _keys(Demo, but=Run),
        "event": _event(),
        "results": RESULTS + _keys(Results),
        "station-state": STATION_STATE + _keys(StationState) + "\n## State of a slot\n\n" + _words("state", SlotIs),
        "fleet": FLEET + _keys(FleetDocument),
        "quality": QUALITY + _keys(Quality) + CHART + _keys(Chart),
        "result": RESULT + _keys(Result),
        "profile-check": PROFILE_CHECK + _keys(ProfileCheck) + "\n## Problems\n\n" + _words("code", Fault),
    }
    return made | {HERE / f"{name}.md": text for name, text in texts.items()}


def _outcome() -> str:
    codes = [
        (f"`{code}`", f"`{code.verdict}`", f"`{json.dumps(code.exit_code)}`", meaning)
        for code, meaning in _meanings(Code)
    ]
    return "".join(
        [
            OUTCOME,
            _keys(Outcome),
            "\n## Verdict and code\n\n",
            _words("verdict", Verdict),
            "\nA code has one verdict and one exit code.\n\n",
            _table(("code", "verdict", "exit code", "meaning"), codes),
            "\n## Device state\n\n",
            _words("device state", DeviceState),
            MARK,
            _words("evidence", Evidence),
            "\n",
            _words("observation", Observation),
            JOURNAL,
        ]
    )


def _event() -> str:
    parts = [EVENT, _keys(Head), "\n## Stages\n\n", _words("stage", Stage)]
    for kind in KINDS:
        name = get_args(kind.model_fields["event"].annotation)[0]
        parts += [f"\n## `{name}`\n\n{kind.__doc__}\n\n", _keys(kind, but=Head)]
    return "".join(parts)


def _json_schema(schema: dict[str, Any]) -> str:
    """The links in descriptions are those of the page, and stay there."""
    document = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema
    return LINK.sub(r"\1", to_text(document))


# Tables


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (head, ("---",) * len(head), *rows))


def _words(title: str, of: type[StrEnum]) -> str:
    return _table((title, "meaning"), [(f"`{member}`", meaning) for member, meaning in _meanings(of)])


def _meanings(of: Any) -> Iterator[tuple[Any, str]]:
    """The members of an enumeration, each with the docstring that follows it."""
    (body,) = (node.body for node in ast.parse(inspect.getsource(of)).body if isinstance(node, ast.ClassDef))
    for member, text in pairwise(body):
        if isinstance(member, ast.Assign) and isinstance(member.targets[0], ast.Name):
            assert isinstance(text, ast.Expr), f"{member.targets[0].id} has no docstring"
            yield of[member.targets[0].id], " ".join(str(ast.literal_eval(text.value)).split()).rstrip(".")


def _keys(model: type[tc.schema.Model], but: type[tc.schema.Model] | None = None) -> str:
    """A row for each key of a document, those of the objects in it below them;
    without the rows that another model has in the same words."""
    known = set(_rows_of(but)) if but else set()
    return _table(("key", "type", "meaning"), [row for row in _rows_of(model) if row not in known])


def _rows_of(model: type[tc.schema.Model]) -> Iterator[tuple[str, str, str]]:
    schema = model.model_json_schema()
    named = schema.get("$defs", {})
    yield from _rows(named[model.__name__] if "$ref" in schema else schema, named, "", {})


def _rows(
    node: dict[str, Any], named: dict[str, Any], prefix: str, shown: dict[str, str]
) -> Iterator[tuple[str, str, str]]:
    """``shown`` are models with the key under which the page has their keys
    already. Another page has those of a key whose description links to it. A
    model with a ``format`` is a document with keys of its own."""
    for name, of in node["properties"].items():
        key, meaning = f"{prefix}{name}", of["description"]
        place, inner = _model_in(of, named)
        known = inner and shown.get(inner)
        yield f"`{key}`", f"as `{known}`" if known else _type(of, named), meaning.replace("|", r"\|")
        if inner and not known and "format" not in named[inner]["properties"] and not ANOTHER_PAGE.search(meaning):
            shown[inner] = key
            yield from _rows(named[inner], named, f"{key}{place}.", shown)


def _model_in(of: dict[str, Any], named: dict[str, Any]) -> tuple[str, str | None]:
    """The name of the model of an object, of one that may be null, or of the
    objects of a list or by name; before it, its place in these."""
    if isinstance(reference := of.get("$ref"), str):
        name = reference.rpartition("/")[2]
        return "", name if "properties" in named[name] else None
    inner = [("", each) for each in (*of.get("anyOf", ()), *of.get("oneOf", ()))]
    inner += [(place, of[key]) for key, place in PLACES.items() if isinstance(of.get(key), dict)]
    found = ((place, *_model_in(each, named)) for place, each in inner)
    return next(((place + below, name) for place, below, name in found if name), ("", None))


def _type(of: dict[str, Any], named: dict[str, Any]) -> str:
    if several := of.get("anyOf") or of.get("oneOf"):
        return " or ".join(dict.fromkeys(_type(each, named) for each in several))
    if isinstance(reference := of.get("$ref"), str):
        return _type(named[reference.rpartition("/")[2]], named)
    if "const" in of:
        return f"`{of['const']}`"
    if of.get("type") == "array":
        each = _type(of["items"], named)
        return f"list of ({each})" if " " in each else f"list of {each}"
    if isinstance(each := of.get("additionalProperties"), dict):
        return f"by name: {_type(each, named)}"
    return JSON_TYPES[of["type"]]


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
