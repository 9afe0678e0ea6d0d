"""The journal of the real daemon: what it did before it was killed is run again, and a disk that refuses is no end."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from conftest import BRISK, Daemon
from support_lcm import MODELSERVER, PATIENCE_S

from modelserver.client.remote import Platform

JOURNAL = "journal: {directory: box, megabytes: 64, sync_s: 0.2}\n"


def verified(folder: Path) -> tuple[int, dict[str, Any], str]:
    """Run `modelserver replay --verify`; return its exit code, what it found, and what it said on stderr."""
    run = subprocess.run(
        [*MODELSERVER, "replay", "--verify", str(folder / "box"), "--json"],
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE_S,
        check=False,
    )
    assert run.stdout, run.stderr
    return run.returncode, json.loads(run.stdout), run.stderr


def asked(platform: Platform, times: int) -> None:
    for _ in range(times):
        platform.get_body_list()
        platform.get_transformation("Cart:Mast", "Cart:Base")
        platform.get_body_frame_list("Cart")


def test_given_a_daemon_that_is_killed_twice_then_all_it_did_is_reproduced(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    for _ in range(2):
        daemon = start_daemon(BRISK + JOURNAL)
        daemon.fed(8.0)
        asked(daemon.platform(), 10)
        # what a kill takes is what has not been written yet: so some time of the daemon's own passes first
        published = daemon.health(lambda health: health.poses_published > 0).poses_published
        daemon.health(lambda health, published=published: health.poses_published > published + 100)
        daemon.process.send_signal(signal.SIGKILL)
        daemon.process.wait(PATIENCE_S)
    code, found, _ = verified(tmp_path)
    assert (code, found["result"]) == (0, "reproduced"), found
    assert (found["runs"], found["lost"], found["other"]) == (2, 0, [])
    assert found["said"]["POSE"] > 100
    assert found["said"]["replies"] >= 60


def test_given_a_disk_that_takes_no_more_then_the_daemon_serves_and_says_so_until_it_does(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    daemon = start_daemon(BRISK + JOURNAL)
    daemon.fed(6.0)
    # no file of this process may grow beyond: what a full disk does to it
    limits = resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (20_000, limits[1]))
    daemon.health(lambda health: any(subject == "journal" for subject, _ in health.notices))
    asked(daemon.platform(), 3)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, limits)
    daemon.health(lambda health: all(subject != "journal" for subject, _ in health.notices))
    asked(daemon.platform(), 3)
    daemon.fed(1.0)
    assert daemon.end() == 0
    assert "nothing is recorded: the journal cannot be kept in" in daemon.log
    assert "is kept again" in daemon.log
    code, found, _ = verified(tmp_path)
    assert (code, found["result"]) == (0, "reproduced"), found
    assert found["lost"] > 0
    assert found["said"]["replies"] >= 9


def test_given_a_folder_that_cannot_be_made_then_the_daemon_serves(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    (tmp_path / "box").write_text("no directory")
    daemon = start_daemon(BRISK + JOURNAL)
    asked(daemon.platform(), 3)
    daemon.health(lambda health: any(subject == "journal" for subject, _ in health.notices))
    assert daemon.end() == 0
