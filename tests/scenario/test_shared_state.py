"""Two real services of one vehicle on one state directory: the second serves, stores nothing, and warns."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from pathlib import Path

from conftest import FAST_HEALTH, Daemon
from support_lcm import TIMEOUT_S, wait_until
from support_samples import drive

from modelserver.wire.codec import encode

SHARED = f"{FAST_HEALTH}warm_start: {{period_s: 0.5}}\njournal: {{megabytes: 32}}\n"
PREFIX = "V2_"


def feed(daemon: Daemon, seconds: float = 10.0) -> int:
    """Publish a drive that ends now on the second service's channels; return the stamp of the last sample."""
    utime = 0
    for sample in drive(seconds, time.time_ns() // 1000 - round(seconds * 1e6)):
        daemon.publish(f"{PREFIX}{'GPS' if type(sample).__name__ == 'GpsSample' else 'IMU'}", encode(sample))
        utime = sample.header.utime
    return utime


def test_given_two_services_with_one_state_directory_then_the_second_stores_nothing_until_the_first_ends(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    state = tmp_path / "a" / "state"
    first = start_daemon(SHARED, tmp_path / "a")
    shared = SHARED.replace("state_directory: state", f"state_directory: {state}")
    second = start_daemon(f"{shared}lcm: {{channel_prefix: {PREFIX}}}\n", tmp_path / "b", prefix=PREFIX)

    warnings = dict(
        second.health(lambda health: {"restart", "journal"} <= {name for name, _ in health.warnings}).warnings
    )
    holder = f"another service (process {first.process.pid}) writes there already"
    assert warnings["restart"].startswith(
        f"no state is stored for a warm start in {state}: {holder}; stop one of the two"
    )
    assert f"the journal cannot be written in {state}/journal-cart: {holder}" in warnings["journal"]
    assert warnings["restart"] in second.log
    assert "restart" not in dict(first.health().warnings)

    # it serves all the same, and stores nothing
    last = feed(second)
    platform = second.platform(channel_prefix=PREFIX)
    assert platform.get_state_vector(at=last, wait_ms=2000)
    second.health(lambda health: "origin cannot be stored" in second.log)
    assert sorted(path.name for path in state.iterdir()) == ["journal-cart", "lock-cart"]

    first.end(signal.SIGKILL)
    second.health(lambda health: not {"restart", "journal"} & {name for name, _ in health.warnings})
    assert wait_until(second.listener.bus, lambda: (state / "state-cart.json").is_file(), TIMEOUT_S)
    assert second.end() == 0
