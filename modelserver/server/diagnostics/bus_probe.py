"""Bus probe: delivery of an own message, other servers on the bus, and the check that the daemon makes at its start.

`probe_delivery` and `discover_servers` are active probes. `DuplicateServerMonitor` watches the health reports while the
daemon runs: two daemons on one bus receive each other's reports, and warn until the other one is gone.
"""

from __future__ import annotations

import logging
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

import lcm

from modelserver.errors import BusError, WireError, quote
from modelserver.messages import GetBodyList, Health, RequestHeader
from modelserver.server.bus import Inbox
from modelserver.server.clock import Clock
from modelserver.server.diagnostics import checks
from modelserver.server.diagnostics.machine import read_bus_facts
from modelserver.wire.channels import PROBE_CHANNEL, REPLY_PREFIX, to_subscription_pattern
from modelserver.wire.codec import decode, encode
from modelserver.wire.provider import handle_message, open_lcm
from modelserver.wire.receiver import Sender

log = logging.getLogger(__name__)

ECHO_TIMEOUT_S: Final = 2.0
"""Timeout of an own message, which takes less than a millisecond on a working bus."""

RESEND_S: Final = 0.1
"""Period of sending it again: a loaded machine may lose one."""

LARGE_BYTES: Final = 100_000
"""Size of a message that LCM splits into packets."""

MAX_SERVERS: Final = 16

REPLY_NAME: Final = "MODELSERVER_DOCTOR"


def probe_delivery(url: str, seconds: float = ECHO_TIMEOUT_S) -> tuple[bool, bool]:
    """Return whether a short and a long own message come back. Raises BusError."""
    sender, receiver = open_lcm(url), open_lcm(url)
    echoed: list[bool] = []
    for size in (8, LARGE_BYTES):
        echoed.append(_is_echoed(sender, receiver, secrets.token_bytes(size), seconds if all(echoed) else 0.0))
    return echoed[0], echoed[1]


def _is_echoed(sender: lcm.LCM, receiver: lcm.LCM, payload: bytes, seconds: float) -> bool:
    matches: list[bool] = []
    subscription = receiver.subscribe(
        to_subscription_pattern(PROBE_CHANNEL), lambda _, data: matches.append(data == payload)
    )
    deadline = time.monotonic() + seconds
    try:
        while time.monotonic() < deadline:
            sender.publish(PROBE_CHANNEL, payload)
            if _receive_until(receiver, min(RESEND_S, seconds), lambda: any(matches)):
                return True
    finally:
        receiver.unsubscribe(subscription)
    return False


def discover_servers(
    url: str, prefix: str, reply_prefix: str = REPLY_PREFIX, seconds: float = 1.3
) -> checks.DiscoveredServers:
    """Collect the servers that publish health reports, and count the replies to one request. Raises BusError.

    The default time is longer than the period of health reports.
    """
    receiver = open_lcm(url)
    servers: dict[checks.Server, None] = {}
    request = RequestHeader(secrets.randbits(62) + 1, f"{reply_prefix}{REPLY_NAME}")

    def on_health(channel: str, data: bytes) -> None:
        try:
            health: Health = decode("health_t", data)
        except WireError:
            return
        if len(servers) < MAX_SERVERS:
            own_prefix = channel.removesuffix("MODELSERVER_HEALTH")
            servers[checks.Server(health.host, health.pid, health.vehicle, health.version, own_prefix)] = None

    count = 0

    def on_reply(_: str, data: bytes) -> None:
        nonlocal count
        # the request id follows the fingerprint
        count += data[8:16] == request.request_id.to_bytes(8, "big", signed=True)

    receiver.subscribe(r"[A-Za-z0-9_]*MODELSERVER_HEALTH", on_health)
    receiver.subscribe(to_subscription_pattern(request.reply_channel), on_reply)
    receiver.publish(f"{prefix}PLATFORM_GET_BODY_LIST", encode(GetBodyList(request)))
    _receive_until(receiver, seconds, lambda: False)
    return checks.DiscoveredServers(tuple(servers), count)


def _receive_until(receiver: lcm.LCM, seconds: float, until: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + seconds
    while not until():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        handle_message(receiver, int(left * 1e3) + 1)
    return True


SERVERS_SUBJECT: Final = "servers"

DUPLICATE_TIMEOUT_S: Final = 5.0
"""Another server without a report for so long is gone."""

MAX_REPORTS_PER_S: Final = 40
"""Reports decoded per second; a server publishes at most ten. Further ones are dropped."""

RECORDING_AGE_S: Final = 30.0
"""A report whose stamp differs so much from now is from the playback of a recording."""


class DuplicateServerMonitor:
    """Warns about other servers on the bus by their health reports. `host` and `pid` are those of this process."""

    def __init__(self, host: str, pid: int, set_warning: Callable[[str, str], None], clock: Clock):
        self._own_process = (host, pid)
        self._set_warning = set_warning
        self._clock = clock
        self._received_ns = 0
        self._window_ns = 0
        self._reports = 0
        self._warning = ""

    def subscribe(self, inbox: Inbox, prefix: str) -> None:
        """Subscribe to the channel of the own health reports."""
        inbox.subscribe(f"{prefix}MODELSERVER_HEALTH", self.on_health)

    def on_health(self, channel: str, data: bytes, sender: Sender = None) -> None:
        """Process a health report, the own one or another server's."""
        now = self._clock.monotonic_ns()
        if now - self._window_ns >= 1_000_000_000:
            self._window_ns, self._reports = now, 0
        self._reports += 1
        if self._reports > MAX_REPORTS_PER_S:
            return
        try:
            health: Health = decode("health_t", data)
        except WireError:
            return
        if (health.host, health.pid) != self._own_process:
            self._received_ns = now
            self._update_warning(_describe(health, self._clock.utime()))
        elif self._warning and now - self._received_ns > DUPLICATE_TIMEOUT_S * 1e9:
            self._update_warning("")

    def _update_warning(self, text: str) -> None:
        if text != self._warning:
            self._warning = text
            self._set_warning(SERVERS_SUBJECT, text)


def _describe(health: Health, utime: int) -> str:
    who = f"modelserver process {health.pid} on {quote(health.host, 64)}, vehicle {quote(health.vehicle, 64)}"
    if abs(health.utime - utime) > RECORDING_AGE_S * 1e6:
        return (
            f"a recording of {who}, is being played on this bus: clients cannot distinguish its poses from current "
            "ones; stop the player, or play without the server's own channels (modelserver replay)"
        )
    return (
        f"another server publishes on this bus: {who}; clients get the replies of either, and POSE is from both; stop "
        f"one (kill {health.pid} there), or give it its own lcm.channel_prefix or port"
    )


BUS_SUBJECT = "bus"


def probe_bus(
    url: str, read: Callable[[str], checks.BusFacts] = lambda url: read_bus_facts(url, probe_delivery)
) -> tuple[checks.Diagnosis, ...]:
    """Check the bus at `url`; takes a few milliseconds if it works.

    Raises BusError if it does not deliver an own message.
    """
    # packets that other programs lost before this one started are not reported
    findings = checks.evaluate_bus(replace(read(url), dropped=None))
    errors = checks.filter_by_level(findings, checks.DiagnosisLevel.ERROR)
    if errors:
        raise BusError(f"the bus at {url} does not work: {'; '.join(map(str, errors))} (details: modelserver doctor)")
    return findings


def report_findings(findings: Iterable[checks.Diagnosis], set_warning: Callable[[str, str], None]) -> None:
    """Log the findings, and set a health warning for those to be fixed."""
    findings = tuple(findings)
    for finding in findings:
        log.log(logging.WARNING if finding.level >= checks.DiagnosisLevel.WARNING else logging.DEBUG, "%s", finding)
    warnings = checks.filter_by_level(findings)
    if warnings:
        set_warning(BUS_SUBJECT, "; ".join(map(str, warnings)))
