"""Signatures and chains of several folders, of which none hides another."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import pytest

from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import Line
from triaxcald.audit import Policy, many
from triaxcald.audit.as_made import unproven
from triaxcald.cli.commands import main
from triaxcald.signing.keys import SigningKey
from triaxcald.signing.trust import load_trust


def test_a_folder_without_a_chain_hides_no_other(
    recorded: Line, tmp_path: Path, key: SigningKey, capsys: pytest.CaptureFixture[str]
) -> None:
    Line(tmp_path, key).record(signed=False)
    main(["audit", str(recorded.folder), str(tmp_path), "--chain", "--json"])
    said = capsys.readouterr()
    document = json.loads(said.out)
    whole, without = document["chains"]
    assert (whole["folder"], whole["recordings"], whole["error"]) == (str(recorded.folder), 4, None)
    assert (without["folder"], without["recordings"]) == (str(tmp_path), 0)
    assert str(tmp_path) in without["error"]
    assert without["error"] in said.err
    assert len(document["audits"]) == 6


def test_signatures_are_judged_by_the_policy_before_earlier_versions_run(
    recorded: Line, tmp_path: Path, keys: dict[str, SigningKey]
) -> None:
    strange = trusted(tmp_path, "2020-01-01T00:00:00+00:00", keys["stranger"])
    earlier, *signed = recorded.made
    assert unproven(recorded.made, Policy()) == []
    refused = unproven(recorded.made, Policy(strange))
    assert {one.name for one in refused} == {str(path) for path in recorded.made}
    assert {one.exit_code for one in refused} == {1}
    assert unproven(recorded.made, Policy(strange, allow_unsigned=True)) == []
    [broken] = unproven([tmp_path / "no.mcap"], Policy())
    assert broken.exit_code == 2
    assert len(signed) == 4
    assert earlier.name == "earlier.mcap"


def test_a_trust_file_that_was_read_judges_where_it_is_not(
    recorded: Line, tmp_path: Path, keys: dict[str, SigningKey]
) -> None:
    """As on a worker of a cluster."""
    file = trusted(tmp_path, "2020-01-01T00:00:00+00:00", keys["stranger"])
    sent = pickle.loads(pickle.dumps(Policy(load_trust(file))))
    file.unlink()
    assert {one.name for one in unproven(recorded.made, sent)} == {str(path) for path in recorded.made}
    assert many.trust_digests([], sent) == many.trust_digests(
        [], Policy(trusted(tmp_path, "2020-01-01T00:00:00+00:00", keys["stranger"]))
    )


def test_a_trust_file_planted_below_the_folder_does_not_count(
    line: Line, keys: dict[str, SigningKey], capsys: pytest.CaptureFixture[str]
) -> None:
    planted = line.folder / "2025"
    planted.mkdir()
    line.made[1].rename(planted / line.made[1].name)
    trusted(planted, "2020-01-01T00:00:00+00:00", keys["stranger"])
    main(["audit", str(line.folder), "--json"])
    audits = json.loads(capsys.readouterr().out)["audits"]
    assert {one["signature"]["trust"] for one in audits} == {str(line.folder / "trust.toml")}
