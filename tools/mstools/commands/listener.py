"""Messages of a running daemon, received until a condition holds."""

from __future__ import annotations

import time
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from modelserver.errors import WireError
from modelserver.wire.channels import BY_NAME, to_subscription_pattern
from modelserver.wire.codec import decode
from modelserver.wire.provider import handle_message

if TYPE_CHECKING:
    import lcm

POLL_S: Final = 0.2
"""Period of checks of the condition without a message, seconds: a signal may have changed it."""


class DaemonListener:
    """Receive channels of a daemon, whose handlers get the decoded messages. `has_received`: any message.

    Messages of another type or version are ignored: the next one may be valid.
    """

    def __init__(self, bus: lcm.LCM, prefix: str, handlers: Mapping[str, Callable[[Any], object]]):
        self.has_received = False
        self._bus = bus
        self._handlers = dict(handlers)
        # a weak reference, so that the bus is left with this object
        receive = partial(_receive, weakref.ref(self))
        self.subscriptions = [
            bus.subscribe(to_subscription_pattern(f"{prefix}{name}"), partial(receive, name)) for name in handlers
        ]

    def _receive(self, name: str, data: bytes) -> None:
        self.has_received = True
        with suppress(WireError):
            self._handlers[name](decode(BY_NAME[name].type_name, data))

    def listen(self, seconds: float, until: Callable[[], bool]) -> bool:
        """Listen for up to `seconds` until a condition holds; return whether it does."""
        return handle_until(self._bus, seconds, until)


def _receive(listener: weakref.ref[DaemonListener], name: str, _: str, data: bytes) -> None:
    if (found := listener()) is not None:
        found._receive(name, data)


def handle_until(bus: lcm.LCM, seconds: float, is_done: Callable[[], bool]) -> bool:
    """Handle messages of the bus for up to `seconds` until `is_done`; return whether it is."""
    deadline = time.monotonic() + seconds
    while not is_done():
        left = deadline - time.monotonic()
        if left <= 0.0:
            return False
        handle_message(bus, int(min(left, POLL_S) * 1e3) + 1)
    return True
