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

from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from modelserver.wire.eventlog import LogFile

pytestmark = pytest.mark.slow

PROTOCOL = Subprotocol("foxglove.sdk.v1")
MESSAGE_DATA = 1
"""Opcode of a message in the protocol: then the subscription, the log time in nanoseconds, and the payload."""


async def receive(link: str, topics: set[str]) -> dict[str, Any]:
    """Subscribe to topics, and return the first message of each."""
    found: dict[str, Any] = {}
    known: dict[int, dict[str, Any]] = {}
    async with asyncio.timeout(TIMEOUT_S), connect(link, subprotocols=[PROTOCOL], max_size=None) as link_socket:
        assert json.loads(await link_socket.recv())["op"] == "serverInfo"
        while set(found) != topics:
            data = await link_socket.recv()
            if isinstance(data, str):
                message = json.loads(data)
                if message["op"] != "advertise":
                    continue
                wanted = [each for each in message["channels"] if each["topic"] in topics]
                known |= {each["id"]: each for each in wanted}
                pairs = [{"id": each["id"], "channelId": each["id"]} for each in wanted]
                await link_socket.send(json.dumps({"op": "subscribe", "subscriptions": pairs}))
            elif data[0] == MESSAGE_DATA:
                number, _ = struct.unpack_from("<IQ", data, 1)
                found.setdefault(known[number]["topic"], decode_payload(known[number], data[13:]))
    return found


def decode_payload(channel: dict[str, Any], payload: bytes) -> Any:
    if channel["encoding"] == "json":
        return json.loads(payload)
    schema = Schema(1, base64.b64decode(channel["schema"]), "protobuf", channel["schemaName"])
    decoder = DecoderFactory().decoder_for("protobuf", schema)
    assert decoder is not None
    return decoder(payload)


def test_given_a_running_service_then_a_client_of_the_protocol_receives_frames_pose_and_health(
    tmp_path: Path, lcm_url: str
) -> None:
    log = record_drive(tmp_path, 8.0)
    process = subprocess.Popen(
        [*MODELSERVER, "export", "--live", "--port", "0", "--url", lcm_url], stdout=subprocess.PIPE, text=True
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
        found = asyncio.run(receive(link, {"/tf", "/pose", "/diagnostics", "/fix/gps"}))
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
