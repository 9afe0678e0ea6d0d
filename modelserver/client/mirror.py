"""PlatformMirror: the client with a local replica of the vehicle. It answers queries without the server."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections.abc import Callable
from typing import Final, Self

import lcm

from modelserver.client.interface import make_demand
from modelserver.client.local import IN_HISTORY, LocalPlatform
from modelserver.client.mirror_state import Ages, MirrorReceiver, MirrorState
from modelserver.client.times import Time, to_utime
from modelserver.errors import OutOfDateError
from modelserver.messages import Policy, PoseAnswer
from modelserver.transforms.transformation import Transformation
from modelserver.wire.channels import to_subscription_pattern
from modelserver.wire.provider import handle_message, open_lcm, resolve_url

log = logging.getLogger(__name__)

POLL_S: Final = 0.1
"""Longest wait of the listener thread on the bus, and so the delay with which an expired replica is noticed."""

MAX_BATCH: Final = 200
"""Messages processed before the state is published: a flood must not delay it."""

QUEUE_CAPACITY: Final = 10_000
"""Queued messages of a channel: all parts of a large geometry arrive at once."""

JOIN_TIMEOUT_S: Final = 2.0


class PlatformMirror(LocalPlatform):
    """Answer the queries of `Platform` from a replica of geometry, joints and poses that follows the server.

        with modelserver.PlatformMirror() as mirror:
            mirror.wait(10.0)
            mirror.get_transformation("Digiclops:ImagePlane", "World:UTM")

    A thread of its own subscribes, on an LCM instance of its own; any number of threads may query without waiting for
    each other. Poses of the vehicle are those of POSE: in timer mode the server predicts them to the time of sending,
    and flags them so.

    Parameters
    ----------
    url
        LCM provider, default $LCM_DEFAULT_URL, else loopback.
    limit
        Largest age of the replica, seconds. Beyond it queries raise OutOfDateError; `age` is the age now.
    clock
        Returns microseconds of a monotonic clock; for tests.
    """

    def __init__(
        self,
        url: str = "",
        *,
        channel_prefix: str = "",
        limit: float = 10.0,
        clock: Callable[[], int] = lambda: time.monotonic_ns() // 1000,
    ):
        if not limit > 0:
            raise ValueError(f"limit must be above 0 s, got {limit}")
        self.url = resolve_url(url)
        self.limit = limit
        self.where = f"at {self.url}" + (f" with prefix {channel_prefix!r}" if channel_prefix else "")
        self._clock = clock
        self._receiver = MirrorReceiver(channel_prefix)
        self._state = self._receiver.state
        # caches of the state, emptied when it is out of date
        self._static_transforms: dict[tuple[str, str], Transformation] = {}
        self._static_answers: dict[tuple[str, str], PoseAnswer] = {}
        self._changed = threading.Condition()
        self._stop = threading.Event()
        bus = open_lcm(self.url)
        self._thread = threading.Thread(
            # a weak reference, so that a mirror that is deleted without close() also ends its thread
            target=_listen,
            args=(weakref.ref(self), bus, self._stop),
            name="PlatformMirror",
            daemon=True,
        )
        self._thread.start()

    def close(self) -> None:
        """Leave the bus. Further queries raise ValueError."""
        self._stop.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(JOIN_TIMEOUT_S)
        self._static_transforms, self._static_answers = {}, {}
        with self._changed:
            self._changed.notify_all()

    # Without `*` before `at`, unlike `Platform`: keyword-only defaults cost a cached lookup 20 % of its time.
    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`; see `Platform.get_transformation`.

        Raises OutOfDateError where the replica is incomplete or too old, and the QueryErrors of `Platform`.
        """
        try:
            return self._static_transforms[frame_of_interest, frame_of_reference]
        except KeyError:
            return self._query_pose(frame_of_interest, frame_of_reference, to_utime(at), policy, wait_ms).transformation

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: Time = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
        max_horizontal: float = 0.0,
        max_heading: float = 0.0,
        max_age: float = 0.0,
        min_integrity: float = 0.0,
    ) -> PoseAnswer:
        """Return the transformation with its origin, levels and quality flags, and what it lacks of a demand.

        See `Platform.get_pose`. The age is that of the newest published pose.
        """
        demand = make_demand(max_horizontal, max_heading, max_age, min_integrity)
        known = None if any(demand) else self._static_answers.get((frame_of_interest, frame_of_reference))
        return known or self._query_pose(frame_of_interest, frame_of_reference, to_utime(at), policy, wait_ms, demand)

    @property
    def age(self) -> Ages:
        """Seconds since the geometry was confirmed, and a pose and a joint were received; infinite for never."""
        known, now = self._state, self._clock()
        return known.get_ages(now)

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        """Number of rejected messages by channel and reason."""
        return dict(self._receiver.rejected)

    def wait(self, timeout: float = 10.0, *, pose: bool = True) -> Self:
        """Wait for the geometry, and with `pose` for a pose; return self. Raises OutOfDateError."""

        def is_ready() -> bool:
            known, now = self.read_state()
            return self.is_fresh(known, now) and (not pose or known.get_ages(now).pose <= self.limit)

        if not self.wait_for(is_ready, timeout):
            self._wait_until_ready(IN_HISTORY)
            raise OutOfDateError(
                f"no POSE with its POSE_ODOM was received {self.where} within {timeout:g} s, only the geometry. Do the "
                "sensors publish? For a vehicle file without sensors call wait(pose=False)"
            )
        return self

    # --- state

    def read_state(self) -> tuple[MirrorState, int]:
        """Return the replica and the time of its clock. Raises ValueError when closed."""
        if self._stop.is_set():
            raise ValueError("this PlatformMirror is closed")
        return self._state, self._clock()

    def wait_for(self, enough: Callable[[], bool], seconds: float) -> bool:
        """Wait up to `seconds` for a new state with `is_enough`; return whether there is one."""
        with self._changed:
            return self._changed.wait_for(enough, seconds)

    def process_messages(self, messages: list[tuple[str, bytes]]) -> None:
        """Process received messages and check the age of the state; called by the listener thread."""
        now, knowledge = self._clock(), self._receiver
        for channel, data in messages:
            knowledge.feed(channel, data, now)
        known, before = knowledge.state, self._state
        self._state = known
        self._static_transforms, self._static_answers = (
            (known.static_transforms, known.static_answers) if self.is_fresh(known, now) else ({}, {})
        )
        if known is not before:
            with self._changed:
                self._changed.notify_all()

    @property
    def channels(self) -> tuple[str, ...]:
        return self._receiver.channels


def _listen(mirror_ref: weakref.ref[PlatformMirror], bus: lcm.LCM, stop: threading.Event) -> None:
    """Pass messages from a bus to a mirror until it is closed or deleted."""
    received: list[tuple[str, bytes]] = []
    subscribed: set[str] = set()
    while not stop.is_set():
        mirror = mirror_ref()
        if mirror is None:
            return
        try:
            mirror.process_messages(received)
        except Exception:
            # one message must not end the thread; a state that is not updated expires
            log.exception("internal error in PlatformMirror")
        received.clear()
        for channel in mirror.channels:
            if channel not in subscribed:
                subscribed.add(channel)
                subscription = bus.subscribe(
                    to_subscription_pattern(channel), lambda channel, data: received.append((channel, data))
                )
                subscription.set_queue_capacity(QUEUE_CAPACITY)
        del mirror
        handle_message(bus, int(POLL_S * 1000))
        while len(received) < MAX_BATCH and handle_message(bus):
            pass
