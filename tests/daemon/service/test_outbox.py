"""Every receiver gets each result once, in order, whatever it answers and whenever it or the service is away."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from tests.daemon.service.conftest import put_outcome
from tests.daemon.service.receivers import Answer, HttpReceiver
from triaxcald.documents import to_text
from triaxcald.schema.codes import Code
from triaxcald.schema.result import Result
from triaxcald.service import ledger as ledger_module
from triaxcald.service import outbox, tables
from triaxcald.service.ledger import Delivery, Ledger
from triaxcald.service.outbox import Outbox
from triaxcald.station.config import Station

MakeStation = Callable[..., Station]
KEYS = (
    "format", "run", "station", "slot", "work", "serial", "attempt", "started", "ended", "verdict", "code", "reason",
    "device_state", "measurements", "recording_sha256", "outcome",
)  # fmt: skip


def by_post(*receivers: HttpReceiver, more: str = "") -> str:
    return "".join(f'[[deliver]]\nname = "r{i}"\nurl = "{r.url}"\n{more}' for i, r in enumerate(receivers))


FILES = '[[deliver]]\nname = "files"\nfolder = "out"\n'


@pytest.fixture
def began(make_station: MakeStation, request: pytest.FixtureRequest) -> Any:
    """Opens the ledger of a station whose receivers are named before any run ends."""
    opened: list[Ledger] = []

    def begin(deliver: str) -> tuple[Station, Ledger]:
        station = make_station(deliver)
        ledger = Ledger.open(station)
        opened.append(ledger)
        ledger.begin_deliveries()
        return station, ledger

    yield begin
    for ledger in opened:
        ledger.close()


@asynccontextmanager
async def delivering(
    station: Station, ledger: Ledger, first_s: float = 0.01
) -> AsyncIterator[tuple[Outbox, list[str]]]:
    said: list[str] = []
    out = Outbox(ledger, station, said.append, first_s)
    running = asyncio.ensure_future(out.run())
    try:
        async with asyncio.timeout(60):
            yield out, said
        assert not running.done()
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError):
            await running


async def settled(out: Outbox, *waiting: int) -> list[Delivery]:
    """The state once so many results wait for each receiver."""
    while True:
        state = await asyncio.to_thread(out.status)
        if [d.waiting for d in state] == list(waiting):
            return state


# What is delivered.


async def test_a_result_has_the_keys_of_the_contract_and_the_digest_of_the_recording(
    make_station: MakeStation, open_ledger: Callable[[Station], Ledger], tmp_path: Path
) -> None:
    recording = os.urandom(3_000_000)
    (tmp_path / "a.mcap").write_bytes(recording)
    (tmp_path / "token").write_text("s3cret\n")
    with HttpReceiver().listening() as receiver:
        station = make_station(by_post(receiver, more='token_file = "token"\n'))
        ledger = open_ledger(station)
        ledger.begin_deliveries()
        document = put_outcome(tmp_path, 2)
        (path,) = tmp_path.glob("*.outcome.json")
        document["recording"] = "a.mcap"
        path.write_text(to_text(document))
        without = put_outcome(tmp_path, 3, Code.ABSENT)
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            (state,) = await settled(out, 0)
    first, second = receiver.got
    result = first.document
    assert tuple(result) == KEYS
    assert Result.model_validate(result).document() == result
    assert result["outcome"] == document
    assert result["recording_sha256"] == hashlib.sha256(recording).hexdigest()
    assert (result["run"], result["slot"], result["attempt"]) == (document["run"], "a", 1)
    assert result["measurements"][0] == {
        "name": "rms_g", "value": 1e-5, "unit": "g", "low": None, "high": 1e-4, "passed": True,
    }  # fmt: skip
    assert first.headers["idempotency-key"] == document["run"]
    assert first.headers["authorization"] == "Bearer s3cret"
    assert first.headers["content-type"] == "application/json"
    assert (second.run, second.document["recording_sha256"], second.document["measurements"]) == (
        without["run"], None, [],
    )  # fmt: skip
    assert (state.refused, state.oldest_s, state.error, said) == (0, 0.0, None, [])


async def test_results_come_in_the_order_of_their_ends_and_later_ones_at_once(began: Any, tmp_path: Path) -> None:
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver))
        first = [put_outcome(tmp_path, n)["run"] for n in (5, 3, 4)]
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
            later = put_outcome(tmp_path, 1)["run"]
            await asyncio.to_thread(ledger.take)
            out.news()
            await asyncio.to_thread(receiver.wait, 4)
            await settled(out, 0)
    assert [g.run for g in receiver.got] == [first[1], first[2], first[0], later]


# What receivers answer.


@pytest.mark.parametrize("status", [200, 201, 204, 299, 409])
async def test_these_answers_end_it(began: Any, tmp_path: Path, status: int) -> None:
    with HttpReceiver(status).listening() as receiver:
        station, ledger = began(by_post(receiver))
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            (state,) = await settled(out, 0)
    assert (len(receiver.got), state.refused) == (1, 0)


@pytest.mark.parametrize("status", [408, 429, 500, 502, 503, 599, 302, 304])
async def test_after_these_answers_it_is_tried_again_and_the_next_one_waits(
    began: Any, tmp_path: Path, status: int
) -> None:
    with HttpReceiver(*[Answer(status, {"Location": "/elsewhere"})] * 3).listening() as receiver:
        station, ledger = began(by_post(receiver))
        runs = [put_outcome(tmp_path, n)["run"] for n in (1, 2)]
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            (state,) = await settled(out, 0)
    assert [g.run for g in receiver.got] == [runs[0]] * 4 + [runs[1]]
    assert len({g.data for g in receiver.got}) == 2  # the same bytes each time
    assert state.refused == 0
    assert len(said) == 1
    assert str(status) in said[0]


@pytest.mark.parametrize("status", [400, 401, 403, 404, 410, 413, 422, 499])
async def test_after_these_answers_it_is_set_aside_and_the_next_one_goes_on(
    began: Any, tmp_path: Path, status: int
) -> None:
    with HttpReceiver(Answer(status, body=b"no \x1b[31msuch\n unit " + b"x" * 100_000)).listening() as receiver:
        station, ledger = began(by_post(receiver))
        runs = [put_outcome(tmp_path, n)["run"] for n in (1, 2)]
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            (state,) = await settled(out, 0)
    assert [g.run for g in receiver.got] == runs
    assert (state.refused, state.waiting) == (1, 0)
    assert f"answers {status}: no \\x1b[31msuch unit" in said[0]
    assert len(said[0]) < 400
    assert said[0].isprintable()
    assert str(status) in str(state.error)


async def test_a_receiver_that_is_away_gets_all_when_it_is_back(began: Any, tmp_path: Path) -> None:
    """It goes, comes back at its port, and goes once more; the other one does not wait for it."""
    moving = HttpReceiver()
    with HttpReceiver().listening() as steady, moving.listening():
        station, ledger = began(by_post(moving, steady))
    runs = [put_outcome(tmp_path, n)["run"] for n in (1, 2)]
    ledger.take()
    with steady.listening():
        async with delivering(station, ledger) as (out, said):
            state = await settled(out, 2, 0)
            assert [g.run for g in steady.got] == runs
            assert state[0].oldest_s > 0
            with moving.listening():
                await settled(out, 0, 0)
            runs.append(put_outcome(tmp_path, 3)["run"])
            await asyncio.to_thread(ledger.take)
            out.news()
            while (await settled(out, 1, 0))[0].error is None:
                pass
            with moving.listening():
                await settled(out, 0, 0)
    assert [g.run for g in moving.got] == runs
    assert [g.run for g in steady.got] == runs
    assert all("r0" in line for line in said)


async def test_pauses_are_one_two_four_up_to_300_s(began: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    enough, true = asyncio.Event(), asyncio.sleep

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 11:
            enough.set()
            await asyncio.Event().wait()
        await true(0)

    monkeypatch.setattr(outbox, "_pause", sleep)
    wishes = [{}] * 3 + [{"Retry-After": "30"}, {"Retry-After": "7200"}, {"Retry-After": "soon"}]
    with HttpReceiver(*[Answer(429, wish) for wish in wishes], *[503] * 20).listening() as receiver:
        station, ledger = began(by_post(receiver))
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger, outbox.FIRST_S):
            await enough.wait()
    assert pauses == [1, 2, 4, 30, 3600, 32, 64, 128, 256, 300, 300]


@pytest.mark.parametrize(
    ("header", "seconds"),
    [
        (None, None), ("0", 0.0), ("12", 12.0), ("-5", 0.0), ("1e9", 3600.0), ("nan", None), ("soon", None), ("", None),
        ("Sun, 06 Nov 1994 08:50:37 GMT", 60.0), ("Sun, 06 Nov 1994 08:49:00 GMT", 0.0),
        ("Sun, 06 Nov 1999 08:50:37 GMT", 3600.0), ("Sun, 99 Nov 1994 08:49:00 GMT", None),
    ],
)  # fmt: skip
def test_a_wish_is_in_seconds_or_a_time(header: str | None, seconds: float | None) -> None:
    assert outbox._seconds(header, 784111777.0) == seconds  # Sun, 06 Nov 1994 08:49:37 GMT


async def test_a_receiver_that_says_nothing_is_tried_again(
    began: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outbox, "ANSWER_S", 0.3)
    held = threading.Event()
    with HttpReceiver(Answer(silent=True, held=held)).listening() as receiver:
        station, ledger = began(by_post(receiver))
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            await settled(out, 0)
            held.set()
    assert len(receiver.got) == 2
    assert "does not answer within" in said[0]


async def test_an_answer_without_an_end_counts_by_its_status(began: Any, tmp_path: Path) -> None:
    held = threading.Event()
    with HttpReceiver(Answer(200, body=b"{", held=held)).listening() as receiver:
        station, ledger = began(by_post(receiver))
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
            held.set()
    assert len(receiver.got) == 1


async def test_what_is_no_http_is_tried_again(began: Any, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        receiver = HttpReceiver()
        receiver.port = server.getsockname()[1]
        station, ledger = began(by_post(receiver))
        put_outcome(tmp_path, 1)
        ledger.take()

        def babble() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    connection.sendall(b"\x00garbage\r\n\r\n")
                    connection.close()

        thread = threading.Thread(target=babble, daemon=True)
        thread.start()
        async with delivering(station, ledger) as (out, _):
            while (await settled(out, 1))[0].error is None:
                pass
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


async def test_a_token_is_read_each_time_and_waited_for(began: Any, tmp_path: Path) -> None:
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver, more='token_file = "token"\n'))
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            while (await settled(out, 1))[0].error is None:
                pass
            (tmp_path / "token").write_text("two\nlines")
            while "printable" not in str((await settled(out, 1))[0].error):
                pass
            (tmp_path / "new").write_text("good")
            (tmp_path / "new").replace(tmp_path / "token")
            await settled(out, 0)
    assert [g.headers["authorization"] for g in receiver.got] == ["Bearer good"]
    assert "token" in said[0]


async def test_secrets_in_a_url_are_not_told(began: Any, tmp_path: Path) -> None:
    with HttpReceiver(422).listening() as receiver:
        url = f"http://user:s3cret@127.0.0.1:{receiver.port}/x?key=s3cret"
        station, ledger = began(f'[[deliver]]\nname = "r"\nurl = "{url}"\n')
        put_outcome(tmp_path, 1)
        ledger.take()
        async with delivering(station, ledger) as (out, said):
            (state,) = await settled(out, 0)
    assert (len(said), state.refused) == (1, 1)
    assert "s3cret" not in said[0] + str(state.error)


# Runs whose files are odd.


async def test_a_run_that_cannot_be_told_is_set_aside_and_the_next_one_goes_on(began: Any, tmp_path: Path) -> None:
    (tmp_path / "station").mkdir()
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver) + FILES)
        documents = {n: put_outcome(tmp_path, n) for n in range(1, 6)}
        path = {n: next(tmp_path.glob(f"*-{n:06d}.outcome.json")) for n in documents}
        documents[1]["run"] = "../../escaped"
        documents[2]["observed"] = ["of a later version"]
        documents[3]["recording"] = "../secret.mcap"
        for n in (1, 2, 3):
            path[n].write_text(to_text(documents[n]))
        (tmp_path.parent / "secret.mcap").write_bytes(b"of somebody")
        ledger.take()
        path[4].unlink()
        async with delivering(station, ledger) as (out, said):
            state = await settled(out, 0, 0)
    (tmp_path.parent / "secret.mcap").unlink()
    assert [g.run for g in receiver.got] == [documents[n]["run"] for n in (2, 3, 5)]
    assert receiver.got[0].document["outcome"] == documents[2]
    assert receiver.got[1].document["recording_sha256"] is None
    assert [d.refused for d in state] == [2, 2]
    assert len(said) == 4
    assert not list(tmp_path.parent.glob("escaped*"))
    assert {p.name for p in (tmp_path / "out").iterdir()} == {f"{documents[n]['run']}.json" for n in (2, 3, 5)}


async def test_a_result_that_is_tried_again_is_the_same_whatever_happens_to_its_files(
    make_station: MakeStation, open_ledger: Callable[[Station], Ledger], tmp_path: Path
) -> None:
    with HttpReceiver(503).listening() as receiver:
        station = make_station(by_post(receiver))
        ledger = open_ledger(station)
        ledger.begin_deliveries()
        document = put_outcome(tmp_path, 2) | {"recording": "a.mcap"}
        (path,) = tmp_path.glob("*.outcome.json")
        path.write_text(to_text(document))
        (tmp_path / "a.mcap").write_bytes(b"readings")
        ledger.take()
        async with delivering(station, ledger, first_s=60) as (out, _):
            await asyncio.to_thread(receiver.wait, 1)
            while not (await asyncio.to_thread(out.status))[0].error:
                await asyncio.sleep(0.01)
        (tmp_path / "a.mcap").rename(tmp_path / "archived.mcap")
        path.write_text(to_text(document | {"reason": "told in another way"}))
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
    first, second = receiver.got
    assert first.document["recording_sha256"] == hashlib.sha256(b"readings").hexdigest()
    assert first.data == second.data
    with ledger.reading() as db:
        assert db.execute(select(tables.sending)).all() == []


@pytest.mark.parametrize("recording", ["a\0b.mcap", "..", "loop", "a" * 300])
async def test_a_recording_that_can_be_none_holds_up_no_other_result(
    began: Any, tmp_path: Path, recording: str
) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver))
        document = put_outcome(tmp_path, 1) | {"recording": recording}
        next(tmp_path.glob("*.outcome.json")).write_text(to_text(document))
        second = put_outcome(tmp_path, 2)
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
    assert receiver.got[-1].run == second["run"]


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="no file that cannot be read")
async def test_a_result_whose_files_cannot_be_read_for_a_while_is_waited_for(began: Any, tmp_path: Path) -> None:
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver))
        document = put_outcome(tmp_path, 1)
        (path,) = tmp_path.glob("*.outcome.json")
        ledger.take()
        there = path.read_bytes()
        path.unlink()
        path.symlink_to("/proc/self/mem")  # can be opened, and not be read
        async with delivering(station, ledger) as (out, _):
            while not (await asyncio.to_thread(out.status))[0].error:
                await asyncio.sleep(0.01)
            path.unlink()
            path.write_bytes(there)
            (state,) = await settled(out, 0)
    assert (state.refused, [g.run for g in receiver.got]) == (0, [document["run"]])


async def test_results_of_several_transactions_come_in_the_order_of_their_ends_too(
    began: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ledger_module, "BATCH", 2)
    with HttpReceiver().listening() as receiver:
        station, ledger = began(by_post(receiver))
        ended = [put_outcome(tmp_path, n, slot="ab"[n in (2, 5)]) for n in range(1, 7)]
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
    assert [g.run for g in receiver.got] == [document["run"] for document in ended]


# Files.


async def test_a_file_appears_complete_and_replaces_no_other(began: Any, tmp_path: Path) -> None:
    station, ledger = began(FILES)
    runs = [put_outcome(tmp_path, n)["run"] for n in (1, 2, 3, 4)]
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / f"{runs[0]}.json").write_text("of somebody")
    (folder / f"{runs[1]}.json").symlink_to(tmp_path / "elsewhere")
    (folder / f".{runs[2]}.json.part").write_text("of a process that was killed")
    ledger.take()
    async with delivering(station, ledger) as (out, said):
        (state,) = await settled(out, 0)
    assert state.refused == 2
    assert len(said) == 2
    assert (folder / f"{runs[0]}.json").read_text() == "of somebody"
    assert not (tmp_path / "elsewhere").exists()
    for run in runs[2:]:
        assert json.loads((folder / f"{run}.json").read_text())["run"] == run
    assert sorted(p.name for p in folder.iterdir()) == sorted(f"{run}.json" for run in runs)


async def test_the_same_file_is_delivered(began: Any, tmp_path: Path) -> None:
    """As after a kill between the file and its row."""
    station, ledger = began(FILES)
    put_outcome(tmp_path, 1)
    ledger.take()
    async with delivering(station, ledger) as (out, _):
        await settled(out, 0)
    (path,) = (tmp_path / "out").iterdir()
    before = path.stat().st_ino, path.stat().st_mtime_ns
    with ledger.writing() as db:
        db.exec_driver_sql("UPDATE outbox SET state = 'waiting'")
    async with delivering(station, ledger) as (out, _):
        (state,) = await settled(out, 0)
    assert (state.refused, (path.stat().st_ino, path.stat().st_mtime_ns)) == (0, before)


async def test_a_station_file_that_is_read_again_while_a_file_is_written_shows_no_part_of_it(
    began: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thread of the cancelled delivery goes on beside the one that delivers again."""
    held, again, go_on = threading.Event(), threading.Event(), threading.Event()
    appear = outbox._appear

    def appearing(partial: Path, path: Path) -> None:
        (again if held.is_set() else held).set()
        assert go_on.wait(20)
        appear(partial, path)

    monkeypatch.setattr(outbox, "_appear", appearing)
    station, ledger = began(FILES)
    put_outcome(tmp_path, 1)
    ledger.take()
    async with delivering(station, ledger) as (out, said):
        await asyncio.to_thread(held.wait, 20)
        out.receive(station)
        assert not await asyncio.to_thread(again.wait, 0.5)
        go_on.set()
        (state,) = await settled(out, 0)
    assert (state.refused, said) == (0, [])


async def test_a_folder_that_goes_away_is_waited_for(began: Any, tmp_path: Path) -> None:
    station, ledger = began(FILES)
    folder = tmp_path / "out"
    first = put_outcome(tmp_path, 1)["run"]
    ledger.take()
    async with delivering(station, ledger) as (out, said):
        await settled(out, 0)
        folder.rename(tmp_path / "away")
        second = put_outcome(tmp_path, 2)["run"]
        await asyncio.to_thread(ledger.take)
        out.news()
        while (await settled(out, 1))[0].error is None:
            pass
        assert not folder.exists()
        (tmp_path / "away").rename(folder)
        await settled(out, 0)
    assert {p.stem for p in folder.iterdir()} == {first, second}
    assert "no such folder" in said[0]


# The service.


async def test_a_receiver_that_is_new_in_the_station_file_gets_what_ends_from_then_on(
    began: Any, make_station: MakeStation, tmp_path: Path
) -> None:
    with HttpReceiver().listening() as one, HttpReceiver().listening() as two:
        station, ledger = began(by_post(one))
        put_outcome(tmp_path, -30 * 365 * 24 * 60)  # long before
        before = put_outcome(tmp_path, 1)["run"]
        ledger.take()
        async with delivering(station, ledger) as (out, _):
            await settled(out, 0)
            station = make_station(by_post(one, two))
            ledger.receive(station)
            out.receive(station)
            after = put_outcome(tmp_path, 2)["run"]
            await asyncio.to_thread(ledger.take)
            out.news()
            await settled(out, 0, 0)
    assert [g.run for g in one.got] == [before, after]
    assert [g.run for g in two.got] == [after]


DELIVER = """
import asyncio, sys
from pathlib import Path
from triaxcald.service.ledger import Ledger
from triaxcald.service.outbox import Outbox
from triaxcald.station.config import load_station
station = load_station(Path(sys.argv[1]))
ledger = Ledger.open(station, sys.argv[2] or None)
ledger.take()
asyncio.run(Outbox(ledger, station, print, 0.01).run())
"""


@pytest.mark.slow
async def test_a_kill_before_the_answer_delivers_again_under_the_same_key(
    make_station: MakeStation, open_ledger: Callable[[Station], Ledger], database: str | None, tmp_path: Path
) -> None:
    held = threading.Event()
    with HttpReceiver(200, Answer(silent=True, held=held)).listening() as receiver:
        station = make_station(by_post(receiver))
        ledger = open_ledger(station)
        ledger.begin_deliveries()
        runs = [put_outcome(tmp_path, n)["run"] for n in (1, 2, 3)]
        command = [sys.executable, "-c", DELIVER, station.path, database or ""]
        with subprocess.Popen(command) as process:
            await asyncio.to_thread(receiver.wait, 2)
            process.kill()
        held.set()
        process = subprocess.Popen(command)
        await asyncio.to_thread(receiver.wait, 4)
        async with asyncio.timeout(60):
            while (await asyncio.to_thread(ledger.deliveries))[0].waiting:
                pass
        process.kill()
        process.wait()
    assert [g.run for g in receiver.got] == [runs[0], runs[1], runs[1], runs[2]]
    assert receiver.got[1].data == receiver.got[2].data
    assert {g.headers["idempotency-key"] for g in receiver.got[1:3]} == {runs[1]}
