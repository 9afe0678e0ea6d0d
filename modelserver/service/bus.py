"""The bus: what the loop needs of LCM, and the real one."""

from __future__ import annotations

import select
from collections.abc import Callable
from typing import Protocol, TypeAlias

from modelserver.wire.channels import literal
from modelserver.wire.provider import open_lcm, resolve_url

Handler: TypeAlias = Callable[[str, bytes], None]


class Inbox(Protocol):
    """One queue of incoming messages. Messages are handed to their handlers only within `drain`."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Hand every message of exactly `channel` to `handler`."""
        ...

    def drain(self, limit: int) -> int:
        """Hand over what has come, at most `limit` messages, without waiting; return how many."""
        ...


class Bus(Protocol):
    """Two inboxes, so that a flood of requests cannot hold up a sensor, and a way out."""

    @property
    def sensors(self) -> Inbox:
        """Where samples come in."""
        ...

    @property
    def requests(self) -> Inbox:
        """Where requests come in."""
        ...

    def publish(self, channel: str, data: bytes) -> None:
        """Send a message to everyone."""
        ...

    def wait(self, seconds: float) -> None:
        """Return when something has come or the time is up."""
        ...


class LcmInbox:
    """An inbox on an LCM instance of its own."""

    def __init__(self, url: str):
        self.lcm = open_lcm(url)
        self.fileno = self.lcm.fileno()
        self.may_have = True
        """Whether something may have come; false only where `LcmBus.wait` has just seen that nothing has."""

    def subscribe(self, channel: str, handler: Handler) -> None:
        """Hand every message of exactly `channel` to `handler`."""
        subscription = self.lcm.subscribe(literal(channel), handler)
        # 0 is no limit: LCM would drop silently, the loop refuses and counts
        subscription.set_queue_capacity(0)

    def drain(self, limit: int) -> int:
        """Hand over what has come, at most `limit` messages, without waiting; return how many."""
        if not self.may_have:
            self.may_have = True
            return 0
        handle = self.lcm.handle_timeout
        for count in range(limit):
            if not handle(0):
                return count
        return limit


class LcmBus:
    """The real bus. Make it after forking, never before: LCM has a thread of its own."""

    def __init__(self, url: str = ""):
        self.url = resolve_url(url)
        self.sensors: LcmInbox = LcmInbox(self.url)
        self.requests: LcmInbox = LcmInbox(self.url)
        self._poll = select.poll()
        for inbox in (self.sensors, self.requests):
            self._poll.register(inbox.fileno, select.POLLIN)
        self.publish = self.requests.lcm.publish

    def wait(self, seconds: float) -> None:
        """Return when something has come or the time is up."""
        # poll is the cheaper call but counts in milliseconds; select keeps the deadline to the microsecond
        milliseconds = int(seconds * 1e3)
        ready = self._poll.poll(milliseconds)
        if len(ready) == 1:
            file = ready[0][0]
            self.sensors.may_have = file == self.sensors.fileno
            self.requests.may_have = file == self.requests.fileno
        elif not ready:
            files = (self.sensors.fileno, self.requests.fileno)
            readable, _, _ = select.select(files, (), (), max(0.0, seconds - milliseconds * 1e-3))
            self.sensors.may_have = self.sensors.fileno in readable
            self.requests.may_have = self.requests.fileno in readable
