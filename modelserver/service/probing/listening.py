"""Trying the bus out: a message to ourselves, and who else is there."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Final

import lcm

from modelserver.errors import WireError
from modelserver.messages import GetBodyList, Health, RequestHeader
from modelserver.service.probing.servers import DiscoveredServers, Server
from modelserver.wire.channels import PROBE_CHANNEL, REPLY_PREFIX, literal
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import open_lcm, take_message

PATIENCE_S: Final = 2.0
"""How long our own message is waited for: it takes less than a millisecond where nothing is wrong."""

AGAIN_S: Final = 0.1
"""After so long it is sent once more: a loaded machine may lose one."""

LARGE_BYTES: Final = 100_000
"""Of a message that LCM cuts in two."""

MAX_SERVERS: Final = 16

REPLY_NAME: Final = "MODELSERVER_DOCTOR"


def hears_itself(url: str, seconds: float = PATIENCE_S) -> tuple[bool, bool]:
    """Return whether a short message to ourselves comes back, and a long one. Raises BusError."""
    speaker, ear = open_lcm(url), open_lcm(url)
    found: list[bool] = []
    for size in (8, LARGE_BYTES):
        word = secrets.token_bytes(size)
        found.append(_returns(speaker, ear, word, seconds if all(found) else 0.0))
    return found[0], found[1]


def _returns(speaker: lcm.LCM, ear: lcm.LCM, word: bytes, seconds: float) -> bool:
    heard: list[bool] = []
    subscription = ear.subscribe(literal(PROBE_CHANNEL), lambda _, data: heard.append(data == word))
    deadline = time.monotonic() + seconds
    try:
        while time.monotonic() < deadline:
            speaker.publish(PROBE_CHANNEL, word)
            if _listen(ear, min(AGAIN_S, seconds), lambda: any(heard)):
                return True
    finally:
        ear.unsubscribe(subscription)
    return False


def who_answers(url: str, prefix: str, reply_prefix: str = REPLY_PREFIX, seconds: float = 1.3) -> DiscoveredServers:
    """Return which daemons are heard on a bus, and how many reply to one question; raises BusError.

    It listens for longer than the time between two health reports. A stranger's flood of reports is cut short.
    """
    ear = open_lcm(url)
    servers: dict[Server, None] = {}
    request = RequestHeader(secrets.randbits(62) + 1, f"{reply_prefix}{REPLY_NAME}")

    def report(channel: str, data: bytes) -> None:
        try:
            health: Health = decode("health_t", data)
        except WireError:
            return
        if len(servers) < MAX_SERVERS:
            of = channel.removesuffix("MODELSERVER_HEALTH")
            servers[Server(health.host, health.pid, health.vehicle, health.version, of)] = None

    count = 0

    def reply(_: str, data: bytes) -> None:
        nonlocal count
        # the id is the first field, behind the fingerprint
        count += data[8:16] == request.request_id.to_bytes(8, "big", signed=True)

    ear.subscribe(r"[A-Za-z0-9_]*MODELSERVER_HEALTH", report)
    ear.subscribe(literal(request.reply_channel), reply)
    ear.publish(f"{prefix}PLATFORM_GET_BODY_LIST", encode(GetBodyList(request)))
    _listen(ear, seconds, lambda: False)
    return DiscoveredServers(tuple(servers), count)


def _listen(ear: lcm.LCM, seconds: float, until: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + seconds
    while not until():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        take_message(ear, int(left * 1e3) + 1)
    return True
