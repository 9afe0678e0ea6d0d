"""The journal of the real daemon: replay verification after a kill, and service on a full disk."""

from __future__ import annotations

import json
import resource
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from conftest import FAST_HEALTH, Daemon
from support_lcm import MODELSERVER, TIMEOUT_S

from modelserver.client.remote import Platform

JOURNAL = "journal: {directory: box, megabytes: 64, sync_s: 0.2}\n"


def verify(folder: Path) -> tuple[int, dict[str, Any], str]:
    """Run `modelserver replay --verify`; return its exit code, its JSON and its stderr."""
    run = subprocess.run(
        [*MODELSERVER, "replay", "--verify", str(folder / "box"), "--json"],
        capture_output=True,
        text=True,
        timeout=4 * TIMEOUT_S,
        check=False,
    )
    assert run.stdout, run.stderr
    return run.returncode, json.loads(run.stdout), run.stderr


def query(platform: Platform, times: int) -> None:
    for _ in range(times):
        platform.get_body_list()
        platform.get_transformation("Cart:Mast", "Cart:Base")
        platform.get_body_frame_list("Cart")


def test_given_a_daemon_that_is_killed_twice_then_all_it_did_is_reproduced(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    for _ in range(2):
        daemon = start_daemon(FAST_HEALTH + JOURNAL)
        daemon.feed(8.0)
        query(daemon.platform(), 10)
        # a kill loses what is not written yet: let some time of the daemon pass first
        published = daemon.health(lambda health: health.poses_published > 0).poses_published
        daemon.health(lambda health, published=published: health.poses_published > published + 100)
        daemon.process.send_signal(signal.SIGKILL)
        daemon.process.wait(TIMEOUT_S)
    code, found, _ = verify(tmp_path)
    assert (code, found["result"]) == (0, "reproduced"), found
    assert (found["runs"], found["lost"], found["other"]) == (2, 0, [])
    assert found["exact"]["POSE"] > 100
    assert found["exact"]["replies"] >= 60


def test_given_a_disk_that_takes_no_more_then_the_daemon_serves_and_reports_it_until_it_does(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    daemon = start_daemon(FAST_HEALTH + JOURNAL)
    daemon.feed(6.0)
    # limits the size of this process's files, as a full disk does
    limits = resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (20_000, limits[1]))
    daemon.health(lambda health: any(subject == "journal" for subject, _ in health.warnings))
    query(daemon.platform(), 3)
    resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, limits)
    daemon.health(lambda health: all(subject != "journal" for subject, _ in health.warnings))
    query(daemon.platform(), 3)
    daemon.feed(1.0)
    assert daemon.end() == 0
    assert "nothing is recorded: the journal cannot be written in" in daemon.log
    assert "is written again" in daemon.log
    code, found, _ = verify(tmp_path)
    assert (code, found["result"]) == (0, "reproduced"), found
    assert found["lost"] > 0
    assert found["exact"]["replies"] >= 9


def test_given_a_folder_that_cannot_be_made_then_the_daemon_serves(
    start_daemon: Callable[..., Daemon], tmp_path: Path
) -> None:
    (tmp_path / "box").write_text("no directory")
    daemon = start_daemon(FAST_HEALTH + JOURNAL)
    query(daemon.platform(), 3)
    daemon.health(lambda health: any(subject == "journal" for subject, _ in health.warnings))
    assert daemon.end() == 0
