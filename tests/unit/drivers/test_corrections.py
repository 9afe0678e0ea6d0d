"""Corrections: sessions with casters of both versions, and the way to the receiver."""

from __future__ import annotations

import contextlib
import math
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_gps import drive, split_randomly

from modelserver.messages import FixType, GpsSample, SensorHeader
from msdrivers import corrections
from msdrivers.corrections import (
    MAX_WAITING,
    CorrectionsClient,
    MissingMountpointError,
    NtripError,
    NtripSession,
    encode_request,
    make_gga,
    parse_source_table,
)
from msdrivers.devices.ublox import UbloxDriver, UbloxSettings
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.registry import NtripSettings
from msdrivers.runner import Runner, RunnerSettings
from msdrivers.settings import read_driver

TIMEOUT_S = 20.0
CERTIFICATE = Path(__file__).resolve().parents[2] / "data" / "localhost.pem"
"""Of localhost, signed by itself, with its key; until 2126."""

STREAM = b"".join(b"\xd3\x00" + bytes((n, 62)) + bytes(n) for n in (20, 23, 60))
SETTINGS = NtripSettings("caster.example:2101", "MOUNT", "me", "secret")


# --- sessions -------------------------------------------------------------------------------------------------


def chunk(data: bytes, sizes: int = 7) -> bytes:
    pieces = [data[at : at + sizes] for at in range(0, len(data), sizes)]
    return b"".join(f"{len(piece):x}\r\n".encode() + piece + b"\r\n" for piece in pieces)


ANSWERS = {
    "version 1": b"ICY 200 OK\r\n\r\n" + STREAM,
    "version 1, at once": b"ICY 200 OK\r\n" + STREAM,
    "version 1, with a header": b"ICY 200 OK\r\nServer: NTRIP Caster/5.2\r\nDate: 28/Nov/2026\r\n\r\n" + STREAM,
    "version 1, with a header and its end in the data": b"ICY 200 OK\r\nServer: x\r\n" + STREAM,
    "version 1, lines without return": b"ICY 200 OK\n\n" + STREAM,
    "version 2, other spelling": b"HTTP/1.0 200 ok\r\ntransfer-encoding:Chunked\r\n\r\n" + chunk(STREAM),
    "version 2, length of chunks in capitals, with parameters": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n"
    + b"%X;a=b\r\n" % len(STREAM)
    + STREAM
    + b"\r\n",
    "version 2": b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n\r\n" + STREAM,
    "version 2, chunks": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + chunk(STREAM),
}


@pytest.mark.parametrize("name", ANSWERS)
@given(seed=st.integers(0, 1000))
def test_given_an_answer_of_a_caster_then_its_corrections_are_found_whatever_the_pieces(name: str, seed: int) -> None:
    session = NtripSession("MOUNT")
    found = b"".join(session.feed(piece) for piece in split_randomly(ANSWERS[name], seed))
    assert found == STREAM
    assert session.is_answered


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "401 Unauthorized: check user and password"),
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "check mountpoint"),
        (b"HTTP/1.1 503 Service Unavailable\r\n\r\n", "try again later"),
        (b"SOURCETABLE 200 OK\r\nSTR;A;B\r\n", "no mountpoint 'MOUNT'"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n", "no mountpoint 'MOUNT'"),
        (
            b"HTTP/1.1 401 Unauthorized\r\nContent-Length: 40\r\n\r\n<html><b>Your account</b> has expired.\r\n",
            "has expired",
        ),
        (b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n", "403 Forbidden: check user"),
        (b"HTTP/1.0 302 Found\r\nLocation: http://b.example:2101/X\r\n\r\n", "redirects to 'http://b.example:2101/X'"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\n\r\n<html>", "web page"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\nThe plain HTTP request was sent to HTTPS port", "sent to HTTPS port"),
        (b"ERROR - Bad Password\r\n", "'ERROR - Bad Password': check mountpoint, user and password"),
        (b"\x15\x03\x01\x00\x02\x02\x46", "wants TLS"),
        (b"", "without an answer"),
        (
            b"SOURCETABLE 200 OK\r\n\r\n" + b"STR;Mount1;;;;;;;;1;2;0\r\nSTR;B;x\r\nENDSOURCETABLE\r\n",
            "it has 'Mount1'",
        ),
        (b"SOURCETABLE 200 OK\r\n\r\nSTR;MOUNT;x\r\nENDSOURCETABLE\r\n", "its station is off the air"),
        (
            b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\nTransfer-Encoding: chunked\r\n\r\n"
            + chunk(b"STR;A;\r\nSTR;B;\r\nENDSOURCETABLE\r\n")
            + b"0\r\n\r\n",
            "it has 'A', 'B'",
        ),
        (b"SSH-2.0-OpenSSH\r\n", "not that of an NTRIP caster"),
        (b"x" * 9000, "not that of an NTRIP caster"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", "damaged"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", "ended the stream"),
    ],
)
def test_given_another_answer_then_the_error_has_what_to_do(answer: bytes, words: str) -> None:
    session = NtripSession("MOUNT")

    def receive() -> None:
        session.feed(answer)
        session.finish()

    with pytest.raises(NtripError, match=words):
        receive()


def test_given_a_request_and_a_position_then_they_are_written_as_casters_read_them() -> None:
    text = encode_request(SETTINGS).decode()
    assert text.startswith("GET /MOUNT HTTP/1.1\r\nHost: caster.example\r\nNtrip-Version: Ntrip/2.0\r\n")
    assert "Authorization: Basic bWU6c2VjcmV0\r\n" in text
    assert text.endswith("\r\n\r\n")
    fix = GpsSample(SensorHeader(0, "gps", 0), FixType.FIX_3D, 50.27, -111.18, height_msl=717.5, satellites=12)
    gga = make_gga(fix, 8 * 3600 * 1_000_000).decode()
    assert gga.startswith("$GPGGA,080000.000,5016.2000000,N,11110.8000000,W,1,12,1.0,717.50,M,0.0,M,,*")


TABLE = (
    b"SOURCETABLE 200 OK\r\nServer: NTRIP Caster\r\nContent-Type: text/plain\r\n\r\n"
    b"CAS;rtk.example;2101;X;Y;0;DEU;50.12;8.69;http://x\r\n"
    b'STR;MOUNT;Town;RTCM 3.2;1004(1)";"1005;2;GPS;NET;DEU;50.00;8.00;1;1;TNET;none;B;N;9600;\r\n'
    b"STR;FAR;Town;RTCM 3.2;1004(1);2;GPS;NET;DEU;-50.00;8.00;0;0;TNET;none;B;N;9600;\r\n"
    b"STR;NEAR0;Town;RTCM 3.2;1004(1);2;GPS;NET;DEU;50.0;8.1;0;0;TNET;none;B;N;9600;\r\n"
    b"STR;SHORT\r\nENDSOURCETABLE\r\n"
)


def test_given_a_source_table_then_its_streams_have_their_place_and_whether_they_need_the_rovers() -> None:
    streams = parse_source_table(TABLE.decode())
    assert [each.name for each in streams] == ["MOUNT", "FAR", "NEAR0", "SHORT"]
    assert [each.needs_place for each in streams] == [True, False, False, False]
    assert streams[0] == ("MOUNT", 50.0, 8.0, True)
    assert math.isnan(streams[3].latitude_deg)
    place = GpsSample(SensorHeader(0, "gps", 0), FixType.FIX_3D, 50.0, 8.0)
    text = str(MissingMountpointError("NEAR1", streams, place))
    assert "it has 'NEAR0'; nearest to the rover: 'MOUNT' (0 km), 'NEAR0' (7 km), 'FAR' (11119 km)" in text


@given(
    st.binary(max_size=300),
    st.sampled_from([b"", b"ICY 200 OK\r\n", b"HTTP/1.1 404 N\r\n\r\n", b"SOURCETABLE 200 OK\n"]),
)
def test_given_any_bytes_then_a_session_gives_bytes_or_an_error(data: bytes, head: bytes) -> None:
    session = NtripSession("MOUNT")
    with contextlib.suppress(NtripError):
        assert isinstance(session.feed(head + data), bytes)
        session.finish()


# --- the thread -----------------------------------------------------------------------------------------------


class Caster:
    """A caster on loopback: each connection gets an answer, then waits until the next one or the end."""

    def __init__(self, *answers: bytes, tls: bool = False):
        self._answers = list(answers)
        self._context: ssl.SSLContext | None = None
        if tls:
            self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
            self._context.load_cert_chain(CERTIFICATE)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self.received: list[bytes] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self._server.settimeout(0.1)
        while not self._ended.is_set():
            with contextlib.suppress(OSError):
                plain, _ = self._server.accept()
                with plain if self._context is None else self._context.wrap_socket(plain, True) as connection:
                    connection.settimeout(0.1)
                    self.received.append(connection.recv(4096))
                    is_last = len(self._answers) == 1
                    connection.sendall(self._answers[0] if is_last else self._answers.pop(0))
                    while not self._ended.is_set() and is_last:
                        with contextlib.suppress(TimeoutError):
                            data = connection.recv(4096)
                            if not data:
                                break
                            self.received.append(data)

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._server.close()


@pytest.fixture
def casters() -> Iterator[Callable[..., Caster]]:
    with contextlib.ExitStack() as stack:

        def make(*answers: bytes, **options: bool) -> Caster:
            caster = Caster(*answers, **options)
            stack.callback(caster.close)
            return caster

        yield make


@contextlib.contextmanager
def receiving(address: str, **more: Any) -> Iterator[CorrectionsClient]:
    client = CorrectionsClient(NtripSettings(address, "MOUNT", **more), "gps")
    client.start()
    try:
        yield client
    finally:
        client.stop()


def wait_for(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, "nothing happened in time"
        time.sleep(0.01)


def test_given_a_caster_then_its_corrections_arrive_with_their_age(casters: Callable[..., Caster]) -> None:
    caster = casters(ANSWERS["version 2, chunks"])
    received: list[bytes] = []
    with receiving(caster.address) as client:
        wait_for(lambda: received.extend(client.pop_received()) or b"".join(received) == STREAM)
        assert client.counts | {"corrections.age_s": 0} == {
            "corrections.connects": 1, "corrections.bytes": len(STREAM), "corrections.age_s": 0,
        }  # fmt: skip
    assert caster.received[0].startswith(b"GET /MOUNT HTTP/1.1")


def test_given_a_caster_with_tls_then_its_corrections_arrive_if_its_certificate_is_that_of_an_authority(
    casters: Callable[..., Caster], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caster = casters(b"ICY 200 OK\r\n\r\n" + STREAM, tls=True)
    port = caster.address.partition(":")[2]
    with receiving(f"localhost:{port}", tls=True):
        wait_for(lambda: "the certificate of localhost is not valid (self-signed certificate)" in caplog.text)
    # as the message advises
    monkeypatch.setenv("SSL_CERT_FILE", str(CERTIFICATE))
    with receiving(f"localhost:{port}", tls=True) as client:
        wait_for(lambda: client.counts.get("corrections.bytes"))
        assert b"".join(client.pop_received()) == STREAM
    with receiving(f"127.0.0.1:{port}", tls=True):
        wait_for(lambda: "the certificate of 127.0.0.1 is not valid (IP address mismatch" in caplog.text)


def test_given_tls_at_a_port_without_it_then_the_log_has_what_to_set(
    casters: Callable[..., Caster], caplog: pytest.LogCaptureFixture
) -> None:
    with receiving(casters(b"ICY 200 OK\r\n\r\n").address, tls=True):
        wait_for(lambda: "the caster does not speak TLS (WRONG_VERSION_NUMBER): leave tls out" in caplog.text)


def test_given_a_lost_connection_then_it_is_made_again(
    casters: Callable[..., Caster], caplog: pytest.LogCaptureFixture
) -> None:
    caster = casters(ANSWERS["version 1"], ANSWERS["version 1"])
    with receiving(caster.address) as client:
        wait_for(lambda: client.counts.get("corrections.bytes", 0) >= 2 * len(STREAM))
        assert client.counts["corrections.connects"] == 2
    assert "the caster has closed the connection" in caplog.text


def test_given_a_caster_that_refuses_then_the_reason_is_logged_once(
    casters: Callable[..., Caster], caplog: pytest.LogCaptureFixture
) -> None:
    caster = casters(b"HTTP/1.1 401 Unauthorized\r\n\r\n")
    with receiving(caster.address) as client:
        wait_for(lambda: client.counts.get("corrections.connects", 0) >= 2)
    assert caplog.text.count("check user and password") == 1


def test_given_a_network_of_stations_then_it_gets_the_position_of_the_fixes(casters: Callable[..., Caster]) -> None:
    caster = casters(ANSWERS["version 1"])
    with receiving(caster.address, gga_period=1.0) as client:
        client.note_place(next(drive(1.0)))
        wait_for(lambda: b"$GPGGA" in b"".join(caster.received[1:]))


class Network:
    """A caster of a network of stations on loopback: it sends a stream to who has sent a position, and its table."""

    def __init__(self, table: bytes = TABLE, closes: bool = False, answer: bytes = b"ICY 200 OK\r\n\r\n"):
        self._table, self._closes, self._answer = table, closes, answer
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(0.1)
        self.address = f"127.0.0.1:{self._server.getsockname()[1]}"
        self.requests: list[bytes] = []
        self.ended = threading.Event()
        self._threads = [threading.Thread(target=self._run, daemon=True)]
        self._threads[0].start()

    def _run(self) -> None:
        while not self.ended.is_set():
            with contextlib.suppress(OSError):
                connection, _ = self._server.accept()
                self._threads.append(threading.Thread(target=self._serve, args=(connection,), daemon=True))
                self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(0.1)
            received = connection.recv(4096)
            self.requests.append(received)
            if received.startswith(b"GET / "):
                connection.sendall(self._table)
                return
            connection.sendall(self._answer)
            while b"$GPGGA" not in received:
                if self._closes or self.ended.is_set():
                    return
                with contextlib.suppress(TimeoutError):
                    received += connection.recv(4096)
            connection.sendall(STREAM)
            self.ended.wait(TIMEOUT_S)

    def close(self) -> None:
        self.ended.set()
        for thread in self._threads:
            thread.join()
        self._server.close()


@pytest.fixture
def networks(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Network]]:
    for name, seconds in (("QUIET_S", 0.3), ("FIRST_DELAY_S", 0.05), ("SILENCE_S", 1.0), ("REJECTION_S", 0.3)):
        monkeypatch.setattr(corrections, name, seconds)
    with contextlib.ExitStack() as stack:

        def make(*args: Any, **more: Any) -> Network:
            network = Network(*args, **more)
            stack.callback(network.close)
            return network

        yield make


@pytest.mark.parametrize("closes", [False, True])
@pytest.mark.parametrize("answer", [b"ICY 200 OK\r\n\r\n", b"HTTP/1.1 200 OK\r\nContent-Type: gnss/data\r\n\r\n"])
def test_given_a_stream_that_needs_the_position_by_its_table_then_it_gets_it_unasked(
    networks: Callable[..., Network], caplog: pytest.LogCaptureFixture, closes: bool, answer: bytes
) -> None:
    caplog.set_level("INFO")
    network = networks(closes=closes, answer=answer)
    with receiving(network.address) as client:
        client.note_place(next(drive(1.0)))
        wait_for(lambda: client.counts.get("corrections.bytes", 0) >= len(STREAM))
    assert "needs the rover's position, by its source table: it is sent every 10 s" in caplog.text
    # a caster that closes at once has it in the next request
    assert not closes or b"Ntrip-GGA: $GPGGA" in network.requests[-1]
    assert sum(each.startswith(b"GET / ") for each in network.requests) == 1


def test_given_such_a_stream_without_a_fix_then_the_reason_is_logged_until_there_is_one(
    networks: Callable[..., Network], caplog: pytest.LogCaptureFixture
) -> None:
    network = networks()
    with receiving(network.address) as client:
        wait_for(lambda: "it needs the rover's position, and the receiver has no fix yet" in caplog.text)
        client.note_place(next(drive(1.0)))
        wait_for(lambda: client.counts.get("corrections.bytes", 0) >= len(STREAM))


@pytest.mark.parametrize(
    ("table", "more", "words"),
    [
        (TABLE, {"gga_period": 0.0}, "gga_period: 0 does not send: set it to 10, or leave it out"),
        (TABLE.replace(b";1;1;TNET", b";0;1;TNET"), {}, "its source table asks for no position; if it is a network"),
        (
            b"HTTP/1.1 404 Not Found\r\n\r\n",
            {},
            r"a network of stations (VRS) needs the rover's position: set gga_period",
        ),
    ],
)
def test_given_a_stream_without_corrections_then_the_log_has_what_to_set(
    networks: Callable[..., Network], caplog: pytest.LogCaptureFixture, table: bytes, more: dict[str, Any], words: str
) -> None:
    network = networks(table)
    with receiving(network.address, **more) as client:
        client.note_place(next(drive(1.0)))
        wait_for(lambda: words in caplog.text)
        assert not client.counts.get("corrections.bytes")
    assert b"GPGGA" not in b"".join(network.requests)


@pytest.mark.parametrize("answer", [TABLE, b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"])
def test_given_a_wrong_mountpoint_then_those_near_it_are_named(
    networks: Callable[..., Network], caplog: pytest.LogCaptureFixture, answer: bytes
) -> None:
    network = networks(TABLE.replace(b"MOUNT", b"MOUNT7"), answer=answer.replace(b"MOUNT", b"MOUNT7"))
    with receiving(network.address) as client:
        client.note_place(next(drive(1.0)))
        wait_for(
            lambda: "no mountpoint 'MOUNT': check mountpoint; it has 'MOUNT7'; nearest to the rover: " in caplog.text
        )


def test_given_corrections_then_a_runner_sends_them_to_its_device(casters: Callable[..., Caster]) -> None:
    caster = casters(ANSWERS["version 1"])
    clock = FakeTimeSource()
    link: FakeLink[bytes] = FakeLink(clock)
    runner = Runner(UbloxDriver(UbloxSettings("gps")), link, RunnerSettings("gps", "ublox"), clock)
    with receiving(caster.address) as client:
        wait_for(lambda: client.counts.get("corrections.bytes", 0) >= len(STREAM))
        feed = client.feed_runner(runner)
        runner.run_once()
        feed()
    assert b"".join(unit for _, unit in link.sent).endswith(STREAM)
    counters = dict(runner.make_health(clock.now()).counters)
    assert counters["corrections.bytes"] == len(STREAM)


def test_given_no_corrections_yet_then_there_is_no_age() -> None:
    client = CorrectionsClient(NtripSettings("127.0.0.1:1", "MOUNT"), "gps")
    assert client.counts["corrections.age_s"] == -1
    client._add(STREAM)
    assert client.counts["corrections.age_s"] >= 0


def test_given_a_driver_that_does_not_take_them_then_old_ones_are_lost_and_counted() -> None:
    client = CorrectionsClient(NtripSettings("127.0.0.1:1", "MOUNT"), "gps")
    for _ in range(MAX_WAITING + 3):
        client._add(STREAM)
    assert client.counts["corrections.lost"] == 3
    assert len(client.pop_received()) == MAX_WAITING


def test_given_a_vehicle_file_then_the_caster_is_read_and_only_receivers_have_one() -> None:
    ntrip = {"caster": "rtk.example:2101", "mountpoint": "NEAR", "user": "me", "password": "x", "gga_period": 10}
    section = {"device": "ublox", "port": "/dev/ttyACM0", "ntrip": ntrip}
    assert read_driver("gps", section).ntrip == NtripSettings("rtk.example:2101", "NEAR", "me", "x", 10.0)
    with pytest.raises(Exception, match="unknown key 'ntrip'"):
        read_driver("imu", {"device": "gx1", "port": "/dev/ttyUSB0", "ntrip": ntrip})
    for wrong in ({"caster": "rtk.example"}, {"mountpoint": "A B"}, {"gga_period": 0.1}):
        with pytest.raises(Exception, match=next(iter(wrong))):
            read_driver("gps", section | {"ntrip": ntrip | wrong})
