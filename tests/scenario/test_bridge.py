"""`modelserver export --live` as a process, and a client of its protocol (Foxglove WebSocket, foxglove.sdk.v1)."""

from __future__ import annotations

import asyncio
import base64
import json
import signal
import socket
import struct
import subprocess
import threading
from pathlib import Path
from typing import Any

import lcm
import pytest
from support_lcm import MODELSERVER, TIMEOUT_S
from support_view import record_drive

pytest.importorskip("foxglove", reason="the extra foxglove is not installed: pip install -e '.[foxglove]'")

from mcap.reader import make_reader
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from modelserver.wire.codec import type_name_of
from modelserver.wire.eventlog import LogFile

pytestmark = pytest.mark.slow

PROTOCOL = Subprotocol("foxglove.sdk.v1")
MESSAGE_DATA = 1
"""Opcode of a message in the protocol: then the subscription, the log time in nanoseconds, and the payload."""


async def receive(link: str, topics: set[str], names: set[str]) -> dict[str, Any]:
    """Subscribe to topics, and return the first message of each; until all names are advertised."""
    advertised: set[str] = set()
    found: dict[str, Any] = {}
    known: dict[int, dict[str, Any]] = {}
    async with asyncio.timeout(TIMEOUT_S), connect(link, subprotocols=[PROTOCOL], max_size=None) as link_socket:
        assert json.loads(await link_socket.recv())["op"] == "serverInfo"
        while set(found) != topics or not names <= advertised:
            data = await link_socket.recv()
            if isinstance(data, str):
                message = json.loads(data)
                if message["op"] != "advertise":
                    continue
                advertised |= {each["topic"] for each in message["channels"]}
                wanted = [each for each in message["channels"] if each["topic"] in topics]
                known |= {each["id"]: each for each in wanted}
                pairs = [{"id": each["id"], "channelId": each["id"]} for each in wanted]
                await link_socket.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))
            elif data[0] == MESSAGE_DATA:
                number, _ = struct.unpack_from("<IQ", data, 1)
                found.setdefault(known[number]["topic"], decode_payload(known[number], data[13:]))
    return found


def find_topics(log: Path) -> set[str]:
    """Return the topics of a log's MCAP file."""
    out = log.with_suffix(".mcap")
    subprocess.run([*MODELSERVER, "export", log, out], check=True, timeout=TIMEOUT_S, stdout=subprocess.PIPE)
    with out.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {each.topic for each in summary.channels.values()}


def decode_payload(channel: dict[str, Any], payload: bytes) -> Any:
    if channel["encoding"] == "json":
        return json.loads(payload)
    if channel["encoding"] == "lcm":
        return payload
    schema = Schema(1, base64.b64decode(channel["schema"]), "protobuf", channel["schemaName"])
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    assert decoder is not None
    return decoder(payload)


def test_given_a_running_service_then_a_client_of_the_protocol_receives_the_topics_of_a_file(
    tmp_path: Path, lcm_url: str
) -> None:
    log, layout = record_drive(tmp_path, 8.0), tmp_path / "layout.json"
    topics = find_topics(log)
    process = subprocess.Popen(
        [*MODELSERVER, "export", "--live", "--port", "0", "--url", lcm_url, "--layout", layout],
        stdout=subprocess.PIPE,
        text=True,
    )
    stop = threading.Event()

    def publish() -> None:
        bus = lcm.LCM(lcm_url)
        with LogFile(log) as events:
            messages = [(event.channel, event.data) for event in events]
        while not stop.is_set():
            for channel, data in messages:
                bus.publish(channel, data)
                if stop.wait(0.0002):
                    return

    publisher = threading.Thread(target=publish)
    try:
        assert process.stdout is not None
        link = process.stdout.readline().split()[0]
        publisher.start()
        wanted = {"/tf", "/pose", "/diagnostics", "/fix/gps", "/state", "/decoded/GPS", "/lcm/GPS"}
        found = asyncio.run(receive(link, wanted, topics))
        # what is logged once, for a client that comes later
        scene = asyncio.run(receive(link, {"/model"}, topics))["/model"]
    finally:
        stop.set()
        publisher.join(TIMEOUT_S)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == 0
    assert found["/pose"].frame_id == "utm"
    assert found["/tf"].transforms[0].parent_frame_id in ("utm", "Raptor:CG")
    assert found["/diagnostics"]["status"][0]["name"] == "pose"
    assert found["/fix/gps"].latitude == pytest.approx(50.27, abs=0.01)
    assert found["/decoded/GPS"]["latitude_deg"] == pytest.approx(50.27, abs=0.01)
    assert type_name_of(found["/lcm/GPS"]) == "gps_t"
    assert isinstance(found["/state"]["heading_deg"], float)
    assert len(scene.entities) > 5
    assert '"followTf":"Raptor:CG"' in layout.read_text()


def test_given_a_port_in_use_then_the_error_names_the_option(lcm_url: str) -> None:

    with socket.socket() as used:
        used.bind(("127.0.0.1", 0))
        used.listen()
        ended = subprocess.run(
            [*MODELSERVER, "export", "--live", "--port", str(used.getsockname()[1]), "--url", lcm_url],
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )
    assert ended.returncode == 1
    assert "choose another with --port N" in ended.stderr
