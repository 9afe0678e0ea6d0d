"""Poses as they are published: for a callback, a loop, or an asynchronous loop."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

import lcm

from modelserver.errors import WireError
from modelserver.messages import PoseAnswer
from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.codec import decode
from modelserver.wire.provider import handle_message, open_lcm

POLL_MS: Final = 200
"""Longest wait of the thread for a message: so long does it take to end."""

MAX_WAITING: Final = 1000
"""Poses that wait to be read; of more the oldest are lost."""

POSE_TYPE: Final = "pose_transform_t"


class PoseStream:
    """The poses on a channel, received by a thread of its own; `Platform.subscribe_pose` makes one.

        with platform.subscribe_pose() as poses:
            for pose in poses:
                ...

    It can be iterated with `for` and with `async for`; both end when it is closed. With a callback, that is called by
    the thread, and its exceptions are logged. `lost`: poses that were not read in time.
    """

    def __init__(self, url: str, channel: str, callback: Callable[[PoseAnswer], object] | None = None):
        self.lost = 0
        self._callback = callback
        self._waiting: deque[PoseAnswer] = deque()
        self._condition = threading.Condition()
        self._wake: Callable[[], object] | None = None
        self._is_closed = False
        self._bus = open_lcm(url)
        subscription = self._bus.subscribe(to_subscription_pattern(channel), self._receive)
        self._thread = threading.Thread(target=self._run, args=(subscription,), name=f"poses of {channel}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread; iterations end. It may be called from the callback."""
        with self._condition:
            self._is_closed = True
            self._notify()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def get(self, timeout: float | None = None) -> PoseAnswer:
        """Return the next pose. Raises TimeoutError after `timeout` seconds without one, StopIteration when closed."""
        end = None if timeout is None else time.monotonic() + timeout
        with self._condition:
            while not self._waiting:
                if self._is_closed:
                    raise StopIteration
                if not self._condition.wait(None if end is None else max(0.0, end - time.monotonic())):
                    raise TimeoutError(f"no pose within {timeout:g} s: is the daemon running?")
            return self._waiting.popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> PoseAnswer:
        return self.get()

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> PoseAnswer:
        loop, event = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(event.set)

        while True:
            with self._condition:
                if self._waiting:
                    return self._waiting.popleft()
                if self._is_closed:
                    raise StopAsyncIteration
                event.clear()
                self._wake = wake
            await event.wait()

    def _run(self, subscription: lcm.LCMSubscription) -> None:
        while not self._is_closed:
            handle_message(self._bus, POLL_MS)
        # leaves the bus, which the handler would keep open
        self._bus.unsubscribe(subscription)

    def _receive(self, _: str, data: bytes) -> None:
        try:
            pose: PoseAnswer = decode(POSE_TYPE, data)
        except WireError:
            return
        if self._callback is not None:
            try:
                self._callback(pose)
            except Exception:
                logging.getLogger(__name__).exception("the callback of subscribe_pose failed")
            return
        with self._condition:
            if len(self._waiting) == MAX_WAITING:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(pose)
            self._notify()

    def _notify(self) -> None:
        self._condition.notify_all()
        if self._wake is not None:
            self._wake()
