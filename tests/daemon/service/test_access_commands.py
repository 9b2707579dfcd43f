"""`triaxcal people` and `triaxcal token` as commands."""

from __future__ import annotations

import io
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import Done, Workshop
from tests.daemon.service.guarded import JSON, guarded, trail_of
from tests.daemon.service.test_access import refused, scan, station_of
from triaxcald.cli.commands import main
from triaxcald.service.ledger import Ledger
from triaxcald.station.config import load_station

Run = Callable[..., Done]


@pytest.fixture
def station(workshop: Workshop) -> Path:
    return station_of(workshop)


@pytest.fixture
def run(station: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command at the station, with ``given`` on standard input."""

    def run(*arguments: str, given: bytes = b"", at: Path = station) -> Done:
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(given)))
            code = main([*arguments, "--station", str(at)])
        return Done(code, *capsys.readouterr())

    return run


def trail(station: Path) -> list[tuple[Any, ...]]:
    ledger = Ledger.open(load_station(station))
    try:
        return [(r["action"], r["what"]["name"], r["what"].get("role"), r["ok"]) for r in trail_of(ledger)]
    finally:
        ledger.close()


def add(run: Run, name: str = "Ada", role: str = "operator", pin: bytes = b"4711\n") -> Done:
    return run("people", "add", name, "--role", role, "--pin-file", "-", given=pin)


def test_people_are_added_changed_and_listed_with_a_row_for_each_change(run: Run, station: Path) -> None:
    for command in (
        ["people", "role", "Ada", "engineer"], ["people", "disable", "Ada"], ["people", "enable", "Ada"],
    ):  # fmt: skip
        if command[1] == "role":
            assert add(run) == Done(0, "", "")
            assert add(run, "Grace", "reader") == Done(0, "", "")
        assert run(*command) == Done(0, "", "")
    assert run("people", "pin", "Ada", "--pin-file", "-", given=b"another\n") == Done(0, "", "")
    run("people", "disable", "Grace")
    listed = run("people", "list")
    assert listed.code == 0
    rows = [re.findall(r"\w+", line) for line in listed.out.splitlines()]
    assert ["Ada", "engineer"] in rows
    assert ["Grace", "reader", "disabled"] in rows
    assert trail(station) == [
        ("person_add", "Ada", "operator", True), ("person_add", "Grace", "reader", True),
        ("person_role", "Ada", "engineer", True), ("person_disable", "Ada", None, True),
        ("person_enable", "Ada", None, True), ("person_pin", "Ada", None, True),
        ("person_disable", "Grace", None, True),
    ]  # fmt: skip


def test_without_anybody_the_lists_say_how_to_begin(run: Run) -> None:
    assert run("people", "list").out == "no people; triaxcal people add adds one\n"
    assert run("token", "list").out == "no tokens; triaxcal token new makes one\n"


@pytest.mark.parametrize(
    ("pin", "why"),
    [(b"", "0 characters"), (b"471", "3 characters"), (b"1" * 65, "65 characters"), (b"47\x0711", "typed"),
     (b"4711\n4712\n", "one line"), (b"\xff\xff\xff\xff", "UTF-8"), (b"1" * 100_000, "one line")],
)  # fmt: skip
def test_a_pin_that_is_none_is_one_line_that_does_not_repeat_it(run: Run, pin: bytes, why: str) -> None:
    done = add(run, pin=pin)
    done.failed(2, why)
    assert "471" not in done.err
    assert run("people", "list").out.startswith("no people")


@pytest.mark.parametrize("pin", [b"4711", b"4711\r\n", "äöüß €".encode(), b"1" * 64, b" 12 "])
def test_a_pin_has_four_to_64_characters_of_any_language(run: Run, pin: bytes) -> None:
    assert add(run, pin=pin).code == 0


@pytest.mark.parametrize("name", ["", "x" * 65, "Ada\n", "A\u202eda", " Ada", "loopback"])
def test_a_name_has_1_to_64_printable_characters(run: Run, name: str) -> None:
    add(run, name).failed(2, "expected")
    run("token", "new", name, "--role", "reader").failed(2, "expected")


def test_a_script_as_a_name_is_a_name(run: Run) -> None:
    assert add(run, "<script>alert(1)</script>").code == 0


@pytest.mark.parametrize(
    ("command", "why"),
    [
        ("people add Ada --role operator --pin-file -", "already"),
        ("people pin Bob --pin-file -", "no person 'Bob'"),
        ("people role Bob reader", "no person 'Bob'"),
        ("people disable Bob", "no person 'Bob'"),
        ("people enable Bob", "no person 'Bob'"),
        ("people role Ada boss", "invalid choice: 'boss'"),
        ("people add Bob --pin-file -", "--role"),
        ("people add Bob --role operator", "no terminal"),
        ("people add Bob --role operator --pin-file none.txt", "none.txt"),
        ("people add Bob --role operator --pin-file /", "directory"),
        ("token new mes --role boss", "invalid choice: 'boss'"),
        ("token new mes", "--role"),
        ("token revoke none", "no token 'none'"),
        ("people list --database mysql://x/y", "database"),
    ],
)
def test_a_wrong_command_changes_nothing_and_ends_with_one_line(
    run: Run, station: Path, command: str, why: str
) -> None:
    add(run)
    run(*command.split(), given=b"4711\n").failed(2, why)
    assert trail(station) == [("person_add", "Ada", "operator", True)]


def test_a_station_file_that_is_not_there_is_one_line(run: Run, tmp_path: Path) -> None:
    run("people", "list", at=tmp_path / "none.toml").failed(2, "none.toml")


async def test_a_token_is_alone_on_standard_output_and_works_until_it_is_revoked(
    station: Path, run: Run, tmp_path: Path
) -> None:
    """All while the service runs."""
    async with guarded(station) as service:
        program = [sys.executable, "-m", "triaxcald.cli", "token", "new", "mes", "--role", "operator", "--station"]
        made = subprocess.run([*program, str(station)], capture_output=True, text=True, check=True)
        assert made.stderr == ""
        token = made.stdout.removesuffix("\n")
        assert re.fullmatch(r"triaxcal_[\w-]{43}", token)
        assert (await scan(service, headers={"Authorization": f"Bearer {token}"})).status_code == 200
        run("token", "new", "mes", "--role", "reader").failed(2, "already")
        assert run("token", "revoke", "mes") == Done(0, "", "")
        refused(await scan(service, headers={"Authorization": f"Bearer {token}"}), 401, "not_signed_in")
        run("token", "revoke", "mes").failed(2, "mes")
        assert run("token", "new", "mes", "--role", "reader").code == 0
        listed = run("token", "list").out
        assert ("revoked" in listed, token in listed) == (True, False)
        pin = tmp_path / "pin"
        pin.write_text("4711\n")
        assert run("people", "add", "Ada", "--role", "engineer", "--pin-file", str(pin)).code == 0
        await service.sign_in("Ada", "4711")
        assert (await service.client.post("/api/1/reload", headers=JSON)).status_code == 200
        assert run("people", "disable", "Ada").code == 0
        refused(await service.client.post("/api/1/reload", headers=JSON), 401, "not_signed_in")


async def test_people_and_tokens_are_in_either_database(station: Path, run: Run, database: str | None) -> None:
    where = [] if database is None else ["--database", database]

    def command(*arguments: str, given: bytes = b"") -> Done:
        return run(*arguments, *where, given=given)

    assert command("people", "add", "Ада", "--role", "operator", "--pin-file", "-", given=b"4711").code == 0
    made = command("token", "new", "mes", "--role", "reader")
    token = {"Authorization": f"Bearer {made.out.strip()}"}
    async with guarded(station, url=database) as service:
        assert (await service.sign_in("Ада", "4711")).status_code == 200
        cookie = service.cookie()
    async with guarded(station, url=database) as service:
        assert (await scan(service, headers=cookie)).status_code == 200
        assert (await service.client.get("/api/1/station", headers=token)).json()["by"] == "token"
        assert command("people", "role", "Ада", "reader").code == 0
        refused(await scan(service, headers=cookie), 403, "role")
        assert command("people", "disable", "Ада").code == 0
        assert command("token", "revoke", "mes").code == 0
        refused(await scan(service, headers=cookie), 401, "not_signed_in")
        refused(await service.client.get("/api/1/station", headers=token), 401, "not_signed_in")
        assert [(r["action"], r["ok"]) for r in service.rows()] == [
            ("person_add", True), ("token_new", True), ("sign_in", True), ("scan", True), ("person_role", True),
            ("request", False), ("person_disable", True), ("token_revoke", True), ("request", False),
            ("request", False),
        ]  # fmt: skip


def at_terminal(station: Path, *typed: bytes) -> tuple[int, bytes]:
    """Exit code and what a terminal shows while someone types."""
    program = [sys.executable, "-m", "triaxcald.cli", "people", "add", "Ada", "--role", "operator", "--station"]
    terminal, other_end = pty.openpty()
    with subprocess.Popen(
        [*program, str(station)], stdin=other_end, stdout=other_end, stderr=other_end, start_new_session=True
    ) as process:
        os.close(other_end)
        shown, answers = b"", list(typed)
        with suppress(OSError):  # the other end is closed
            while data := os.read(terminal, 4096):
                shown += data
                if answers and shown.endswith((b"Ada: ", b"again: ")):
                    os.write(terminal, answers.pop(0))
        os.close(terminal)
    return process.returncode, shown


def test_a_pin_that_is_typed_is_not_shown(station: Path) -> None:
    code, shown = at_terminal(station, b"geheim\n", b"geheim\n")
    assert (code, b"geheim" in shown) == (0, False)
    assert trail(station) == [("person_add", "Ada", "operator", True)]


def test_two_different_pins_change_nothing(station: Path) -> None:
    code, shown = at_terminal(station, b"geheim\n", b"geheimer\n")
    assert code == 2
    assert b"differ" in shown
    assert trail(station) == []


def test_help_needs_no_web_and_no_database() -> None:
    script = (
        "import sys; from triaxcald.cli.commands import main; main(['people', 'add', '--help']); "
        "print(sorted({'fastapi', 'sqlalchemy', 'argon2', 'uvicorn'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")
    assert "--pin-file" in done.stdout
