"""PlatformMirror: the client that keeps a copy. It listens to the service and answers by itself."""

from __future__ import annotations

import logging
import threading
import time
import weakref
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

import lcm

from modelserver.client.knowledge import Ages, Knowledge, Known
from modelserver.client.local import LocalPlatform
from modelserver.errors import OutOfDateError
from modelserver.messages import Policy, PoseAnswer
from modelserver.spatial.transformation import Transformation
from modelserver.wire.channels import literal
from modelserver.wire.provider import open_lcm, resolve_url, take_message

log = logging.getLogger(__name__)

POLL_S: Final = 0.1
"""The longest that the listening thread waits on the bus: so late may it notice that knowledge has grown old."""

AT_ONCE: Final = 200
"""Messages taken before what they tell is shown: a flood must not keep it back."""

UNREAD: Final = 10_000
"""Messages of a channel kept until they are looked at: all the parts of a large geometry come at once."""

CLOSING_S: Final = 2.0


class PlatformMirror(LocalPlatform):
    """Answers what `Platform` does, without asking: it keeps geometry, joints and poses in step with the service.

        with modelserver.PlatformMirror() as mirror:
            mirror.wait(10.0)
            mirror.get_transformation("Digiclops:ImagePlane", "World:UTM")

    A thread of its own listens, on an LCM instance of its own; any number of threads may ask, none waits for another.
    `url` is the LCM provider, by default $LCM_DEFAULT_URL, else loopback. What is older than `limit` seconds is not
    answered from: OutOfDateError says how old it is. `age` says it at any time.

    What is told of the vehicle is what POSE said: in the service's timer mode that is predicted to the instant of
    sending, and flagged so. `clock` gives microseconds on a clock that never steps; another is for tests.
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
            raise ValueError(f"limit is above 0 s, got {limit}")
        self.url = resolve_url(url)
        self.limit = limit
        self.where = f"at {self.url}" + (f" with prefix {channel_prefix!r}" if channel_prefix else "")
        self._clock = clock
        self._knowledge = Knowledge(channel_prefix)
        self._known = self._knowledge.known
        # what does not move: replaced by nothing when it may not be answered from any more
        self._still: dict[tuple[str, str], Transformation] = {}
        self._answers: dict[tuple[str, str], PoseAnswer] = {}
        self._changed = threading.Condition()
        self._end = threading.Event()
        bus = open_lcm(self.url)
        self._thread = threading.Thread(
            # it does not hold this object: one that is forgotten, not closed, ends the thread all the same
            target=_listen,
            args=(weakref.ref(self), bus, self._end),
            name="PlatformMirror",
            daemon=True,
        )
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus. Further questions raise ValueError."""
        self._end.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(CLOSING_S)
        self._still, self._answers = {}, {}
        with self._changed:
            self._changed.notify_all()

    # No `*` before `at`, though it is meant to be named as in `Platform`: defaults of what can only be named are looked
    # up by name at every call, which makes a lookup a fifth dearer.
    def get_transformation(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> Transformation:
        """Return the pose of `frame_of_interest` in `frame_of_reference`; see `Platform.get_transformation`.

        Raises OutOfDateError where too little is known, or too long since; the QueryErrors as `Platform` does.
        """
        try:
            return self._still[frame_of_interest, frame_of_reference]
        except KeyError:
            return self._pose(frame_of_interest, frame_of_reference, at, policy, wait_ms).transformation

    def get_pose(
        self,
        frame_of_interest: str,
        frame_of_reference: str,
        *,
        at: int = 0,
        policy: Policy = Policy.INTERPOLATED,
        wait_ms: int = 0,
    ) -> PoseAnswer:
        """Return what `get_transformation` does, with the origin, the bounds and the flags beside it."""
        try:
            return self._answers[frame_of_interest, frame_of_reference]
        except KeyError:
            return self._pose(frame_of_interest, frame_of_reference, at, policy, wait_ms)

    @property
    def age(self) -> Ages:
        """Seconds since the geometry was confirmed, a pose came, a joint was told of; infinite for never."""
        known, now = self._known, self._clock()
        return known.ages(now)

    @property
    def rejected(self) -> dict[tuple[str, str], int]:
        """Messages that could not be used: how often, by channel and reason."""
        return dict(self._knowledge.rejected)

    def wait(self, timeout: float = 10.0, *, pose: bool = True) -> Self:
        """Wait until the geometry is known, and with `pose` where the vehicle is; return this mirror.

        Raises OutOfDateError that says what is missing after `timeout` seconds.
        """

        def enough() -> bool:
            known, now = self.known()
            return self.is_fresh(known, now) and (not pose or known.ages(now).pose <= self.limit)

        if not self.wait_for(enough, timeout):
            self._geometry()
            raise OutOfDateError(
                f"the geometry is known, and no POSE with its POSE_ODOM has come {self.where} within {timeout:g} s. Do "
                "the sensors speak? Where the vehicle file names none, wait with pose=False"
            )
        return self

    # --- what is known

    def known(self) -> tuple[Known, int]:
        """Return what is known, and the instant it is. Raises ValueError when closed."""
        if self._end.is_set():
            raise ValueError("this PlatformMirror is closed")
        return self._known, self._clock()

    def wait_for(self, enough: Callable[[], bool], seconds: float) -> bool:
        """Wait for so long at most until more is known and that is enough; return whether it is."""
        with self._changed:
            return self._changed.wait_for(enough, seconds)

    def take(self, messages: list[tuple[str, bytes]]) -> None:
        """Take what has come, and look at the clock; the listening thread does that all the time."""
        now, knowledge = self._clock(), self._knowledge
        for channel, data in messages:
            knowledge.feed(channel, data, now)
        known, before = knowledge.known, self._known
        self._known = known
        self._still, self._answers = (known.still, known.answers) if self.is_fresh(known, now) else ({}, {})
        if known is not before:
            with self._changed:
                self._changed.notify_all()

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that it listens to."""
        return self._knowledge.channels


def _listen(whose: weakref.ref[PlatformMirror], bus: lcm.LCM, end: threading.Event) -> None:
    """Take messages from a bus to a mirror until it is closed or forgotten."""
    fresh: list[tuple[str, bytes]] = []
    heard: set[str] = set()
    while not end.is_set():
        mirror = whose()
        if mirror is None:
            return
        try:
            mirror.take(fresh)
        except Exception:
            # one message that breaks this must not end the listening: knowledge that is not renewed grows old
            log.exception("an error of the mirror's own")
        fresh.clear()
        for channel in mirror.channels:
            if channel not in heard:
                heard.add(channel)
                subscription = bus.subscribe(literal(channel), lambda channel, data: fresh.append((channel, data)))
                subscription.set_queue_capacity(UNREAD)
        del mirror
        take_message(bus, int(POLL_S * 1000))
        while len(fresh) < AT_ONCE and take_message(bus):
            pass
