"""Time stamps of a local authority, which answers with OpenSSL."""

from __future__ import annotations

import json
import subprocess
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import Line, envelope_of, lines_of, looked_at, put_signature
from triaxcald.audit import Policy, audit_chain
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import State, stamp_asked_for
from triaxcald.cli.commands import main
from triaxcald.signing import stamps
from triaxcald.signing.envelope import canonical, parse_envelope
from triaxcald.signing.keys import SigningKey
from triaxcald.signing.stamps import StampState

TSA = """\
[tsa]
default_tsa = tsa1
[tsa1]
serial = {folder}/serial
signer_cert = {folder}/tsa.pem
signer_key = {folder}/tsa.key
signer_digest = sha256
default_policy = 1.2.3.4.1
digests = sha256, sha384, sha512
ess_cert_id_alg = sha256
[ext]
extendedKeyUsage = critical,timeStamping
keyUsage = critical,digitalSignature
subjectKeyIdentifier = hash
authorityKeyIdentifier = keyid
"""


def _run(*command: object) -> None:
    subprocess.run(list(map(str, command)), check=True, capture_output=True)


class Authority:
    """``answer`` makes of a request what the server sends, ``asked`` counts requests."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.asked = folder, 0
        self.answer = self.stamped
        config = folder / "tsa.cnf"
        config.write_text(TSA.format(folder=folder))
        (folder / "serial").write_text("01\n")
        ec = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-config", "/dev/null")
        of_ca = ("-addext", "basicConstraints=critical,CA:TRUE", "-addext", "keyUsage=critical,keyCertSign,cRLSign")
        root = ("-keyout", folder / "root.key", "-out", folder / "root.pem", "-subj", "/CN=test root", "-days", 3650)
        _run("openssl", "req", "-x509", *ec, *root, *of_ca)
        asked = ("-keyout", folder / "tsa.key", "-out", folder / "tsa.csr", "-subj", "/CN=test authority")
        _run("openssl", "req", *ec, *asked)
        by = ("-CA", folder / "root.pem", "-CAkey", folder / "root.key", "-CAcreateserial", "-days", 3650)
        made = ("-in", folder / "tsa.csr", "-extfile", config, "-extensions", "ext", "-out", folder / "tsa.pem")
        _run("openssl", "x509", "-req", *by, *made)

    @property
    def root(self) -> Path:
        return self.folder / "root.pem"

    def stamped(self, request: bytes) -> bytes:
        query, reply = self.folder / "query.tsq", self.folder / "reply.tsr"
        query.write_bytes(request)
        _run("openssl", "ts", "-reply", "-config", self.folder / "tsa.cnf", "-queryfile", query, "-out", reply)
        return reply.read_bytes()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Authority, str]]:
    authority = Authority(tmp_path_factory.mktemp("authority"))

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            authority.asked += 1
            request = self.rfile.read(int(self.headers["Content-Length"]))
            assert self.headers["Content-Type"] == "application/timestamp-query"
            data = authority.answer(request)
            self.send_response(200)
            self.send_header("Content-Type", "application/timestamp-reply")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield authority, f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def authority(served: tuple[Authority, str]) -> Authority:
    found = served[0]
    found.answer, found.asked = found.stamped, 0
    return found


@pytest.fixture
def url(served: tuple[Authority, str], authority: Authority) -> str:
    return served[1]


def _now_ns() -> int:
    return int(datetime.now(UTC).timestamp() * 1e9)


@pytest.fixture
def stamped(tmp_path: Path, key: SigningKey, url: str) -> Line:
    """A line whose first recording is signed and stamped now, by a key that is trusted."""
    line = Line(tmp_path, key, _now_ns() - 60 * 10**9, url)
    trusted(tmp_path, datetime.now(UTC).isoformat(), key)
    line.record()
    return line


def test_a_stamp_shows_the_time_of_a_trusted_authority(stamped: Line, authority: Authority) -> None:
    signature, found = looked_at(stamped.made[0], Policy())
    assert (signature.state, found) == (State.TRUSTED, [])
    assert signature.stamp is not None
    assert (signature.stamp.state, signature.stamp.authority) == (StampState.UNTRUSTED, None)
    assert main(["keys", "trust", "theirs", "--authority", str(authority.root), "--folder", str(stamped.folder)]) == 0
    stamp = looked_at(stamped.made[0], Policy())[0].stamp
    assert stamp is not None
    assert (stamp.state, stamp.authority) == (StampState.TRUSTED, "theirs")
    assert stamp.time is not None
    assert abs(stamp.time - datetime.now(UTC)) < timedelta(minutes=10)


def test_openssl_verifies_the_stamp(stamped: Line, authority: Authority, tmp_path: Path) -> None:
    envelope = parse_envelope(envelope_of(stamped.made[0]))
    assert envelope.stamp is not None
    (tmp_path / "sig").write_bytes(envelope.signature)
    (tmp_path / "tsr").write_bytes(envelope.stamp)
    _run("openssl", "ts", "-verify", "-in", tmp_path / "tsr", "-data", tmp_path / "sig", "-CAfile", authority.root)


def test_the_stamp_of_another_signature_is_found(stamped: Line) -> None:
    stamped.now_ns = _now_ns()
    other = json.loads(envelope_of(stamped.record()))
    envelope = json.loads(envelope_of(stamped.made[0]))
    envelope["signatures"][0]["rfc3161"] = other["signatures"][0]["rfc3161"]
    put_signature(stamped.made[0], canonical(envelope))
    signature, found = looked_at(stamped.made[0], Policy())
    assert signature.stamp is not None
    assert signature.stamp.state is StampState.INVALID
    assert Kind.NOT_VERIFIED in found


def test_a_time_that_the_stamp_contradicts_is_found(tmp_path: Path, key: SigningKey, url: str) -> None:
    trusted(tmp_path, "2020-01-01T00:00:00+00:00", key)
    for away_s in (-7200, 7200):
        line = Line(tmp_path, key, _now_ns() + away_s * 10**9, url, made=[tmp_path] * (away_s > 0))
        assert looked_at(line.record(), Policy())[1] == [Kind.CLOCK]


def test_a_stamp_from_before_the_revocation_keeps_a_signature_trusted(stamped: Line, authority: Authority) -> None:
    folder = str(stamped.folder)
    assert main(["keys", "trust", "theirs", "--authority", str(authority.root), "--folder", folder]) == 0
    later = (datetime.now(UTC) + timedelta(hours=1)).isoformat()
    text = (stamped.folder / "trust.toml").read_text()
    revoked = f'name = "line-1"\nrevoked = "{later}"\nreason = "stolen"\n'
    (stamped.folder / "trust.toml").write_text(text.replace('name = "line-1"\n', revoked))
    assert looked_at(stamped.made[0], Policy())[0].state is State.TRUSTED
    earlier = (datetime.now(UTC) - timedelta(hours=1)).isoformat()
    (stamped.folder / "trust.toml").write_text((stamped.folder / "trust.toml").read_text().replace(later, earlier))
    assert looked_at(stamped.made[0], Policy())[0].state is State.REVOKED


def test_a_stamped_chain_outlives_the_revocation_of_its_key(stamped: Line, authority: Authority) -> None:
    """The start and a tombstone too."""
    folder = str(stamped.folder)
    assert main(["keys", "trust", "theirs", "--authority", str(authority.root), "--folder", folder]) == 0
    stamped.now_ns = _now_ns() - 60 * 10**9
    gone = stamped.record()
    stamped.signing.bury(lines_of(stamped.folder)[-1]["digest"], gone.name, "age")
    for path in stamped.folder.glob(f"{gone.stem}.m*"):
        path.unlink()
    assert audit_chain(stamped.folder).differences == ()
    text = (stamped.folder / "trust.toml").read_text()
    revoked = f'name = "line-1"\nrevoked = "{(datetime.now(UTC) + timedelta(hours=1)).isoformat()}"\n'
    (stamped.folder / "trust.toml").write_text(text.replace('name = "line-1"\n', revoked))
    found = audit_chain(stamped.folder)
    assert (found.differences, found.recordings, found.tombstones) == ((), 2, 1)


@pytest.mark.parametrize("answer", [b"", b"no stamp", b"\x30\x03\x02\x01\x02"])
def test_without_an_answer_the_signature_is_made_and_the_audit_says_so(
    tmp_path: Path, key: SigningKey, url: str, authority: Authority, answer: bytes
) -> None:
    authority.answer = lambda _: answer
    trusted(tmp_path, "2020-01-01T00:00:00+00:00", key)
    line = Line(tmp_path, key, _now_ns(), url)
    for _ in range(3):
        signature, found = looked_at(line.record(), Policy())
        assert (signature.state, signature.stamp, found) == (State.TRUSTED, None, [])
    assert authority.asked == 1  # it is not asked again for a while
    assert stamp_asked_for({"station.toml": f'[sign]\ntimestamp = "{url}"\n'.encode()})
    assert not stamp_asked_for({"station.toml": b'name = "bench"\n'})


def test_the_answer_to_another_request_is_no_stamp(url: str, authority: Authority) -> None:
    kept: list[bytes] = []

    def old(request: bytes) -> bytes:
        kept.append(authority.stamped(request))
        return kept[0]

    authority.answer = old
    assert stamps.stamp(url, b"message") is not None
    assert stamps.stamp(url, b"message") is None  # the same message, but another nonce


def test_nobody_there_is_no_stamp() -> None:
    assert stamps.stamp("http://127.0.0.1:1/", b"message") is None
