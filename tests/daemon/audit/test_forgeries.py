"""A table of what can be done to a recording with the `mcap` library, and what the audit says of it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Channel, Message, Metadata
from mcap.writer import IndexType

from tests.daemon.audit.forging import END, OUTCOME, Forgery, at
from triaxcald.audit import audit
from triaxcald.errors import RecordingError
from triaxcald.recording import schema
from triaxcald.recording.schema import EVENTS, LOSS, RAW, REGISTERS

CERTIFICATE, VERIFICATION, REPORT = "certificate.json", "verification.json", "report.html"
BEFORE, AFTER = "registers-before.json", "registers-after.json"
SECOND_NS = 1_000_000_000
Make = Callable[[Forgery], object]


@dataclass(frozen=True)
class Row:
    """``sealed`` where the forger brings the outcome's inventory and the digests in step with what he has made."""

    name: str
    make: Make
    says: str
    sealed: bool = False
    writing: dict[str, Any] = field(default_factory=dict)


def _outcome(**values: Any) -> Make:
    return lambda f: f.edit(OUTCOME, lambda o: o.update(values))


def _registers(**values: Any) -> Make:
    return lambda f: f.edit(OUTCOME, lambda o: o["registers"].update(values))


def _zeroed(f: Forgery) -> None:
    f.edit(BEFORE, lambda held: held.update({name: "0" * len(raw) for name, raw in held.items()}))


def _accesses(f: Forgery, keep: Callable[[int, schema.RegisterAccess], bool]) -> None:
    """Of the register traffic, what is to be kept, by its place and content."""
    numbers = {id(m): i for i, m in enumerate(f.messages(REGISTERS))}
    f.each(REGISTERS, lambda m: m if keep(numbers[id(m)], schema.decode_register_access(m.data)) else None)


def _nothing_after_the_restart(f: Forgery) -> None:
    """Which is the last write."""
    accesses = [schema.decode_register_access(m.data) for m in f.messages(REGISTERS)]
    last = max(i for i, a in enumerate(accesses) if a.operation == "write")
    _accesses(f, lambda i, a: i <= last)


def _access(register: str, raw: bytes) -> Callable[[Message], Message]:
    def change(m: Message) -> Message:
        a = schema.decode_register_access(m.data)
        return replace(m, data=schema.encode(replace(a, raw=raw))) if a.register == register else m

    return change


def _event(f: Forgery, kind: str, text: str = "{}") -> None:
    last = list(f.messages(EVENTS))[-1]
    event = schema.Event(last.log_time, kind, text)
    f.records.insert(f.records.index(last) + 1, replace(last, data=schema.encode(event)))


def _without_event(kind: str) -> Make:
    return lambda f: f.each(EVENTS, lambda m: None if schema.decode_event(m.data).kind == kind else m)


def _swapped_raw(f: Forgery) -> None:
    one, other = (i for i, r in enumerate(f.records) if any(r is m for m in list(f.messages(RAW))[10:12]))
    f.records[one], f.records[other] = f.records[other], f.records[one]


def _raw_twice(f: Forgery) -> None:
    m = list(f.messages(RAW))[10]
    f.records.insert(f.records.index(m), deepcopy(m))


def _twice(find: Callable[[Forgery], Any]) -> Make:
    return lambda f: f.records.append(deepcopy(find(f)))


def _noted_loss(f: Forgery) -> None:
    (number,) = (c.id for c in f.channels.values() if c.topic == LOSS)
    loss = schema.Loss(1, RAW, 5, 7, "the queue to the disk was full")
    f.records.insert(-1, Message(number, 1, schema.encode(loss), 1, 0))


def _other_topic(f: Forgery) -> None:
    f.channels[9] = Channel(len(f.channels) + 1, "/remarks", "protobuf", {}, 3)
    f.records.insert(-1, Message(len(f.channels), 1, b"", 1, 0))


def _unit_of_channel(f: Forgery) -> None:
    channel = next(c for c in f.channels.values() if c.topic == "/preview/readings")
    channel.metadata = {"unit": "mV"}


def _field_of_schema(f: Forgery) -> None:
    kind = next(s for s in f.schemas.values() if b"temp_c" in s.data)
    kind.data = kind.data.replace(b"temp_c", b"temp_f")


def _order(f: Forgery) -> None:
    one, other = f.records.index(f.attachment(BEFORE)), f.records.index(f.attachment(VERIFICATION))
    f.records[one], f.records[other] = f.records[other], f.records[one]


def _last(f: Forgery) -> None:
    outcome = f.attachment(OUTCOME)
    f.records.remove(outcome)
    f.records.insert(f.records.index(f.attachment(CERTIFICATE)), outcome)


def _attached_later(f: Forgery) -> None:
    report = f.attachment(REPORT)
    report.create_time += SECOND_NS
    report.log_time += SECOND_NS


def _other_report(f: Forgery) -> None:
    f.put(REPORT, f.attachment(REPORT).data.replace("µg".encode(), b"ng", 1))


def _other_report_and_its_digest(f: Forgery) -> None:
    _other_report(f)
    f.edit(OUTCOME, lambda o: o["sha256"].update({REPORT: hashlib.sha256(f.attachment(REPORT).data).hexdigest()}))


def _no_certificate_and_failed(f: Forgery) -> None:
    f.drop(CERTIFICATE)
    f.edit(OUTCOME, lambda o: o.update(verdict="fail", exit_code=1, reason="out of order"))


def _aborted(f: Forgery) -> None:
    f.drop(CERTIFICATE, REPORT)
    f.edit(OUTCOME, lambda o: o.update(verdict="aborted", exit_code=4, reason="out of order"))


def _aborted_and_unsettled(f: Forgery) -> None:
    _aborted(f)
    unsettled = {"exit_code": 130, "device_state": "unknown", "evidence": "no_answer", "journal": "x"}
    f.edit(OUTCOME, lambda o: o.update(unsettled))


def _previews_under_a_loss(f: Forgery) -> None:
    """One is noted as lost, and another is changed."""
    topic = "/preview/readings"
    f.first(topic, lambda m: None)
    f.first(topic, lambda m: replace(m, data=m.data[:-1] + b"\x41"))
    (number,) = (c.id for c in f.channels.values() if c.topic == LOSS)
    loss = schema.Loss(1, topic, 0, 1, "the queue to the disk was full")
    f.records.insert(-1, Message(number, 1, schema.encode(loss), 1, 0))


def _refusals_for_a_silence(f: Forgery) -> None:
    """As many failed reads as a supply that is switched off makes, and each was refused."""
    *_, last = f.messages(REGISTERS)
    answered = schema.decode_register_access(last.data)
    refused = replace(answered, raw=b"", error="refused")
    at = f.records.index(last)
    f.records[at:at] = [replace(last, data=schema.encode(refused)) for _ in range(5)]
    f.edit(OUTCOME, lambda o: o.update(evidence="read_after_power_cycle"))


def _turned_back(f: Forgery) -> None:
    f.drop(OUTCOME, END)
    f.metadata("recording").metadata.pop("ends_with")


def _bare(f: Forgery) -> None:
    _turned_back(f)
    f.drop(CERTIFICATE, REPORT, VERIFICATION, BEFORE, AFTER)


def _unindexed(writer: Any) -> None:
    writer._Writer__attachment_indexes.pop()


def _one_message_less(writer: Any) -> None:
    writer._Writer__statistics.message_count -= 1


def _better(document: Any) -> None:
    document["after_rms_g"] *= 0.5


def _better_measured(f: Forgery) -> None:
    f.edit(OUTCOME, lambda o: o["measured"]["after"].update(rms_g=1e-9))


def _fewer_written(f: Forgery) -> None:
    f.edit(OUTCOME, lambda o: o["registers"].update(written=o["registers"]["written"][:-1]))


MISSING = "missing, though the result rests on it"
ROWS = [
    Row("verification taken out", lambda f: f.drop(VERIFICATION), f"{VERIFICATION}: {MISSING}"),
    Row("register traffic taken out", lambda f: f.each(REGISTERS, lambda m: None), f"{REGISTERS}: {MISSING}"),
    Row("registers before zeroed", _zeroed, f"{BEFORE}: sha256: the outcome lists "),
    Row("registers after taken out", lambda f: f.drop(AFTER), f"{AFTER}: {MISSING}"),
    Row("report replaced", lambda f: f.put(REPORT, b"<html>all is well</html>"), f"{REPORT}: drawn again, "),
    Row("report taken out", lambda f: f.drop(REPORT), f"{REPORT}: {MISSING}"),
    Row("certificate taken out", lambda f: f.drop(CERTIFICATE), f"{CERTIFICATE}: {MISSING}"),
    Row("raw digest zeroed", lambda f: f.metadata("raw").metadata.update(sha256="0" * 64), "raw: sha256: stored "),
    Row("raw count changed", lambda f: f.metadata("raw").metadata.update(records="7"), 'raw: records: stored "7"'),
    Row(
        "raw count of a phase changed",
        lambda f: f.metadata("raw").metadata.update({"phase calibration": "[1, 2, 3, 4]"}),
        "raw: phase calibration: stored ",
    ),
    Row("raw metadata taken out", lambda f: f.drop("raw"), f"raw: {MISSING}"),
    Row("raw log times shifted", lambda f: f.each(RAW, at(SECOND_NS)), f"{RAW}: sha256: the outcome lists "),
    Row("event times shifted", lambda f: f.each(EVENTS, at(SECOND_NS)), f"{EVENTS}: 2 records with other times"),
    Row(
        "publish times shifted",
        lambda f: f.first(REGISTERS, lambda m: replace(m, publish_time=m.publish_time + 1)),
        f"{REGISTERS}: 1 record with other times",
    ),
    Row("an attachment's time shifted", _attached_later, f"{REPORT}: time_ns: the outcome lists "),
    Row("raw batch taken out", lambda f: f.first(RAW, lambda m: None), f"{RAW}: 1 gap in the running index"),
    Row("raw batch twice", _raw_twice, f"{RAW}: messages: the outcome lists "),
    Row("raw batches in another order", _swapped_raw, f"{RAW}: sha256: the outcome lists "),
    Row("previews taken out", lambda f: f.each("/preview/readings", lambda m: None), f"/preview/readings: {MISSING}"),
    Row(
        "a preview changed",
        lambda f: f.first("/preview/readings", lambda m: replace(m, data=m.data[:-1] + b"\x41")),
        "/preview/readings: sha256: the outcome lists ",
    ),
    Row("an event taken out", _without_event("provisioned"), f"{EVENTS}: provisioned: missing"),
    Row("an event added", partial(_event, kind="remark"), f"{EVENTS}: messages: the outcome lists 2, "),
    Row("a loss noted", _noted_loss, f"{LOSS}: is in the recording, and the outcome does not list it"),
    Row("a topic added", _other_topic, "/remarks: a topic that no recording has"),
    Row("sequence numbers", lambda f: f.first(RAW, lambda m: replace(m, sequence=3)), f"{RAW}: 1 record with a sequen"),
    Row("another unit of a channel", _unit_of_channel, "/preview/readings: declared: the outcome lists "),
    Row("another field of a schema", _field_of_schema, "/preview/readings: declared: the outcome lists "),
    Row(
        "an attachment added",
        lambda f: f.records.append(replace(f.attachment(REPORT), name="a.txt")),
        "a.txt: is in the",
    ),
    Row(
        "an attachment twice", _twice(lambda f: f.attachment("profile.toml")), "profile.toml: is in the recording more"
    ),
    Row("attachments in another order", _order, "attachments: in another order than the outcome lists them"),
    Row(
        "another media type",
        lambda f: setattr(f.attachment(REPORT), "media_type", "text/plain"),
        f"{REPORT}: media_type: the outcome lists ",
    ),
    Row(
        "metadata added", lambda f: f.records.append(Metadata("remark", {"a": "b"})), "remark: is in the recording, and"
    ),
    Row("metadata twice", _twice(lambda f: f.metadata("station")), "station: is in the recording more than once"),
    Row("metadata taken out", lambda f: f.drop("station"), f"station: {MISSING}"),
    Row("another name of the station", lambda f: f.metadata("station").metadata.update(name="x"), "station: sha256: "),
    Row("outcome taken out", lambda f: f.drop(OUTCOME), f"{OUTCOME}: missing, though the recording says that it ends"),
    Row("outcome not last", _last, f"{OUTCOME}: not the last attachment; that is {CERTIFICATE}"),
    Row("another word in the outcome", _outcome(supersedes="0" * 64), f"{END}: sha256: stored "),
    Row("overruled doubts hidden", _outcome(forced="because"), f"{END}: sha256: stored "),
    Row("another time of the end", _outcome(ended="2020-01-01T00:00:00.000+00:00"), f"{END}: sha256: stored "),
    Row("end record taken out", lambda f: f.drop(END), f"{END}: {MISSING}"),
    Row("no statistics", lambda f: None, "statistics: the index at the end", writing={"use_statistics": False}),
    Row("no indices", lambda f: None, "chunks: the index at the end", writing={"index_types": IndexType.NONE}),
    Row("hidden in the index", lambda f: None, "attachments: the index at the end", writing={"spoil": _unindexed}),
    Row("a count too small", lambda f: None, "statistics: the index at the end", writing={"spoil": _one_message_less}),
    # By a forger who knows of the inventory and the digests.
    Row("verification taken out", lambda f: f.drop(VERIFICATION), f"{VERIFICATION}: {MISSING}", True),
    Row(
        "previews taken out",
        lambda f: f.each("/preview/corrected", lambda m: None),
        "/preview/corrected: messages: stored 0, computed again ",
        True,
    ),
    Row(
        "a preview changed",
        lambda f: f.first("/preview/readings", lambda m: replace(m, data=m.data[:-1] + b"\x41")),
        "/preview/readings: not what the raw records give",
        True,
    ),
    Row("verification edited", lambda f: f.edit(VERIFICATION, _better), f"{VERIFICATION}: after_rms_g: stored ", True),
    Row("traffic taken out", lambda f: f.each(REGISTERS, lambda m: None), f"{REGISTERS}: written: [", True),
    Row("registers before zeroed", _zeroed, f"{BEFORE}: scale_factor_x: 00000000 here, 9a9919c0 by the register", True),
    Row("registers before taken out", lambda f: f.drop(BEFORE), f"{BEFORE}: {MISSING}", True),
    Row("registers after taken out", lambda f: f.drop(AFTER), f"{AFTER}: {MISSING}", True),
    Row("report edited", _other_report, f"{REPORT}: drawn again, it comes out otherwise", True),
    Row("report and its digest edited", _other_report_and_its_digest, f"{REPORT}: drawn again, it comes", True),
    Row(
        "another verdict",
        _outcome(verdict="not_judged"),
        f'{OUTCOME}: verdict: stored "not_judged", computed again',
        True,
    ),
    Row("another exit code", _outcome(exit_code=1), f"{OUTCOME}: exit_code: stored 1, computed again 0", True),
    Row("failed, and no certificate", _no_certificate_and_failed, f'{OUTCOME}: verdict: stored "fail", computed', True),
    Row("aborted, and no certificate", _aborted, f"{EVENTS}: failed.error: stored null, computed again", True),
    Row("better figures", _better_measured, f"{OUTCOME}: measured.after.rms_g: stored ", True),
    Row("other limits", _outcome(limits={}), f"{OUTCOME}: limits.rms_g: stored nothing", True),
    Row("a digest that is none", _outcome(supersedes=7), f"{OUTCOME}: supersedes: stored 7, computed again null", True),
    Row("a reason that is none", _outcome(forced=["x"]), f'{OUTCOME}: forced: stored ["x"], computed again null', True),
    Row("registers that are none", _registers(steps="all"), f"{OUTCOME}: registers: stored ", True),
    Row("another serial number", _outcome(serial="4712"), f'{OUTCOME}: serial: stored "4712"', True),
    Row(
        "another journal", _outcome(journal="/tmp/x"), f'{OUTCOME}: journal: stored "/tmp/x", computed again null', True
    ),
    Row(
        "said to be unverified",
        _outcome(device_state="new_unverified", evidence="read_back", journal="x"),
        f'{OUTCOME}: evidence: "read_back": the register traffic does not bear it out',
        True,
    ),
    Row(
        "said to be untouched",
        _outcome(device_state="untouched", evidence="nothing_written"),
        f"{OUTCOME}: device_s",
        True,
    ),
    Row("said to be old", _outcome(device_state="old"), f'{OUTCOME}: device_state: "old": the register traffic', True),
    Row("said to be cycled", _outcome(evidence="read_after_power_cycle"), f"{OUTCOME}: evidence: ", True),
    Row("said to be cycled, with refusals", _refusals_for_a_silence, f"{OUTCOME}: evidence: ", True),
    Row(
        "aborted, unsettled, and no fault of the device", _aborted_and_unsettled, f"{OUTCOME}: exit_code: stored", True
    ),
    Row("a preview lost, another changed", _previews_under_a_loss, "/preview/readings: not what the raw records", True),
    Row("fewer registers written", _fewer_written, f"{EVENTS}: provisioned.written: stored ", True),
    Row("said not to differ", _registers(differing=[]), f"{OUTCOME}: registers.differing: stored [], ", True),
    Row("said to be cut short", _registers(cut_short_before=True), f"{OUTCOME}: registers.cut_short_before: ", True),
    Row(
        "the restart taken out",
        lambda f: _accesses(f, lambda i, a: a.register != "reset"),
        f'{OUTCOME}: evidence: "read_after_restart": the register traffic does not bear it out',
        True,
    ),
    Row(
        "nothing read after the restart",
        _nothing_after_the_restart,
        f'{OUTCOME}: evidence: "read_after_restart": the register traffic does not bear it out',
        True,
    ),
    Row(
        "another value written",
        lambda f: f.each(REGISTERS, _access("unlock_key", b"\x01\x02")),
        f"{REGISTERS}: unlock_key: 0102 was written, which neither",
        True,
    ),
    Row(
        "another unit answered",
        lambda f: f.each(REGISTERS, _access("serial_number", b"\x68\x12\x00\x00")),
        f"{REGISTERS}: serial_number: 4711 here, 4712 by the register traffic",
        True,
    ),
    Row(
        "traffic's times shifted",
        lambda f: f.each(REGISTERS, at(SECOND_NS)),
        "records with other times than those in the content",
        True,
    ),
    Row("raw log times shifted", lambda f: f.each(RAW, at(SECOND_NS)), f"{RAW}: ", True),
    Row("an event taken out", _without_event("provisioned"), f"{EVENTS}: provisioned: missing", True),
    Row(
        "said to be undone",
        partial(_event, kind="restored", text='{"state": "old"}'),
        f"{EVENTS}: restored.state",
        True,
    ),
    Row(
        "said to have failed", partial(_event, kind="failed", text='{"error": "x"}'), f"{EVENTS}: failed.error: ", True
    ),
    Row(
        "an attachment twice", _twice(lambda f: f.attachment("station.toml")), "station.toml: is in the recording", True
    ),
]


@pytest.fixture(scope="module")
def source(finished_run: Any) -> Forgery:
    return Forgery.of(finished_run.can)


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name + (" (sealed)" if row.sealed else ""))
def test_what_is_changed_or_taken_out_is_found(
    source: Forgery, tmp_path: Path, said: Callable[[Path], list[str]], row: Row
) -> None:
    forged = source.copied()
    row.make(forged)
    if row.sealed:
        forged.seal()
    found = said(forged.write(tmp_path / "forged.mcap", **row.writing))
    assert any(row.says in line for line in found), found


def test_the_table_is_of_forgeries_and_not_of_the_forger(
    source: Forgery, tmp_path: Path, said: Callable[[Path], list[str]]
) -> None:
    copy = source.copied()
    assert said(copy.write(tmp_path / "copied.mcap")) == []
    copy.seal()
    assert said(copy.write(tmp_path / "sealed.mcap")) == []


@pytest.mark.parametrize("make", [_turned_back, _bare])
def test_a_recording_without_its_end_is_not_audited(source: Forgery, tmp_path: Path, make: Make) -> None:
    forged = source.copied()
    make(forged)
    with pytest.raises(RecordingError, match="holds no result to audit"):
        audit(forged.write(tmp_path / "forged.mcap"))


@pytest.mark.parametrize("name", [CERTIFICATE, REPORT, OUTCOME])
def test_an_edited_file_beside_a_recording_is_found_and_a_missing_one_is_noted(
    finished_run: Any, tmp_path: Path, auditor: Any, name: str
) -> None:
    path = tmp_path / "unit.mcap"
    path.write_bytes(finished_run.can.read_bytes())
    for other in {CERTIFICATE, REPORT, OUTCOME} - {name}:
        path.with_suffix(f".{other}").write_bytes(finished_run.can.with_suffix(f".{other}").read_bytes())
    found = auditor(path)
    assert (found.differences, found.notes.not_beside) == ((), (f"unit.{name}",))
    path.with_suffix(f".{name}").write_bytes(finished_run.can.with_suffix(f".{name}").read_bytes() + b"\n")
    assert auditor.lines(path) == [f"unit.{name}: the file beside the recording is not the one in it"]


def test_a_file_beside_an_aborted_unit_s_recording_that_says_it_was_certified_is_found(
    finished_run: Any, tmp_path: Path, said: Callable[[Path], list[str]], source: Forgery
) -> None:
    forged = source.copied()
    _aborted(forged)
    path = forged.write(tmp_path / "unit.mcap")
    path.with_suffix(f".{CERTIFICATE}").write_text(json.dumps({}))
    assert f"unit.{CERTIFICATE}: lies beside the recording, which has none" in said(path)
