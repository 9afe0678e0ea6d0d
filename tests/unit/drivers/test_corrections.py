"""Corrections: sessions with casters of both versions, and the way to the receiver."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support_gps import drive, split_randomly

from modelserver.messages import FixType, GpsSample, SensorHeader
from msdrivers.corrections import (
    MAX_WAITING,
    CorrectionsClient,
    NtripError,
    NtripSession,
    encode_request,
    make_gga,
)
from msdrivers.devices.ublox import UbloxDriver, UbloxSettings
from msdrivers.links.fake import FakeLink, FakeTimeSource
from msdrivers.registry import NtripSettings
from msdrivers.runner import Runner, RunnerSettings
from msdrivers.settings import read_driver

TIMEOUT_S = 20.0


STREAM = b"".join(b"\xd3\x00" + bytes((n, 62)) + bytes(n) for n in (20, 23, 60))
SETTINGS = NtripSettings("caster.example:2101", "MOUNT", "me", "secret")


# --- sessions -------------------------------------------------------------------------------------------------


def chunk(data: bytes, sizes: int = 7) -> bytes:
    pieces = [data[at : at + sizes] for at in range(0, len(data), sizes)]
    return b"".join(f"{len(piece):x}\r\n".encode() + piece + b"\r\n" for piece in pieces)


ANSWERS = {
    "version 1": b"ICY 200 OK\r\n\r\n" + STREAM,
    "version 1, at once": b"ICY 200 OK\r\n" + STREAM,
    "version 2": b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n\r\n" + STREAM,
    "version 2, chunks": b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + chunk(STREAM),
}


@pytest.mark.parametrize("name", ANSWERS)
@given(seed=st.integers(0, 1000))
def test_given_an_answer_of_a_caster_then_its_corrections_are_found_whatever_the_pieces(name: str, seed: int) -> None:
    session = NtripSession("MOUNT")
    found = b"".join(session.feed(piece) for piece in split_randomly(ANSWERS[name], seed))
    # the receiver skips the end of a header of version 1
    assert found.removeprefix(b"\r\n") == STREAM
    assert session.is_answered


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "401 Unauthorized: check user and password"),
        (b"HTTP/1.1 404 Not Found\r\n\r\n", "check mountpoint"),
        (b"HTTP/1.1 503 Service Unavailable\r\n\r\n", "try again later"),
        (b"SOURCETABLE 200 OK\r\nSTR;A;B\r\n", "no mountpoint 'MOUNT'"),
        (b"HTTP/1.1 200 OK\r\nContent-Type: gnss/sourcetable\r\n\r\n", "no mountpoint 'MOUNT'"),
        (b"SSH-2.0-OpenSSH\r\n", "not that of an NTRIP caster"),
        (b"x" * 9000, "not that of an NTRIP caster"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", "damaged"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", "ended the stream"),
    ],
)
def test_given_another_answer_then_the_error_has_what_to_do(answer: bytes, words: str) -> None:
    with pytest.raises(NtripError, match=words):
        NtripSession("MOUNT").feed(answer)


def test_given_a_request_and_a_position_then_they_are_written_as_casters_read_them() -> None:
    text = encode_request(SETTINGS).decode()
    assert text.startswith("GET /MOUNT HTTP/1.1\r\nHost: caster.example\r\nNtrip-Version: Ntrip/2.0\r\n")
    assert "Authorization: Basic bWU6c2VjcmV0\r\n" in text
    assert text.endswith("\r\n\r\n")
    fix = GpsSample(SensorHeader(0, "gps", 0), FixType.FIX_3D, 50.27, -111.18, height_msl=717.5, satellites=12)
    gga = make_gga(fix, 8 * 3600 * 1_000_000).decode()
    assert gga.startswith("$GPGGA,080000.000,5016.2000000,N,11110.8000000,W,1,12,1.0,717.50,M,0.0,M,,*")


# --- the thread -----------------------------------------------------------------------------------------------


class Caster:
    """A caster on loopback: each connection gets an answer, then waits until the next one or the end."""

    def __init__(self, *answers: bytes):
        self._answers = list(answers)
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
                connection, _ = self._server.accept()
                with connection:
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

        def make(*answers: bytes) -> Caster:
            caster = Caster(*answers)
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
    assert counters["corrections.bytes"] == len(STREAM) + 2


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
