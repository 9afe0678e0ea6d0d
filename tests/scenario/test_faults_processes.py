"""The daemon killed, hung, restarted, and interrupted while it writes, as its clients see it."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from support_daemon import trial
from support_lcm import TIMEOUT_S

from modelserver.client.mirror import PlatformMirror
from modelserver.earth.geodesy import origin_at
from modelserver.errors import NoPoseError, NoServerError
from modelserver.server.persistence import OriginStore

SAVING = """
import sys
from pathlib import Path
from modelserver.earth.geodesy import origin_at
from modelserver.server.persistence import OriginStore
store, n = OriginStore(Path(sys.argv[1]), "raptor"), 0
while True:
    n += 1
    store.save(origin_at(50.0, -111.0, float(n)))
    if n == 20:
        print("saves", flush=True)
"""

HANGING = """
import threading, time
from modelserver.server.log import set_up_logging, start_in_background
def work():
    while True:
        time.sleep(1e-4)
def hang():
    print("hangs", flush=True)
    while True:
        time.sleep(1e-4)
set_up_logging("info")
for _ in range(8):
    start_in_background(threading.Thread(target=work, daemon=True))
hang()
"""


def answers(mirror: PlatformMirror) -> bool:
    """Return whether a mirror answers in world frames: its newest pose may be that of a service that starts."""
    try:
        mirror.get_transformation("Digiclops:ImagePlane", "World:UTM")
    except NoPoseError:
        return False
    return True


def test_given_sigkill_then_the_daemon_serves_again_as_soon_as_it_is_started_and_valid_poses_are_right(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run, PlatformMirror(lcm_url) as mirror:
        before = run.last.transformation
        mirror.wait(TIMEOUT_S)
        killed = run.kill()
        run.restart()
        served = run.wait_until(lambda: run.is_answered_since(killed), "an answer")
        valid = run.wait_until(lambda: run.is_valid_since(killed), "a valid pose")
        # its clients got a clear error, and continue with the same objects
        assert {type(error) for at, error in run.errors if killed + 0.5 < at < served} <= {NoServerError}
        assert any(at > killed for at, _ in run.errors)
        run.wait_until(lambda: answers(mirror), "an answer of the mirror")
        assert run.last.transformation.origin_id == before.origin_id
        assert valid > served - 1.0
        run.assert_consistent()
        print(f"serving after {served - killed:.2f} s, valid after {valid - killed:.2f} s")


def test_given_a_hang_that_ends_then_the_daemon_continues_without_the_missed_ticks(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run:
        run.wait_for_health(lambda health: health.utime > 0, "a report")
        missed = run.health.ticks_missed
        run.process.send_signal(signal.SIGSTOP)
        hung = time.monotonic()
        run.wait(1.0)
        assert any(at > hung + 0.3 for at, _ in run.errors)
        resumed, poses = time.monotonic(), len(run.received.poses)
        run.process.send_signal(signal.SIGCONT)
        served = run.wait_until(lambda: run.is_answered_since(resumed), "an answer")
        valid = run.wait_until(lambda: run.is_valid_since(resumed), "a valid pose")
        health = run.wait_for_health(lambda health: health.ticks_missed >= missed + 80, "the ticks that were missed")
        assert health.handler_errors == 0
        assert len(run.received.poses) - poses < 40 + 100 * (time.monotonic() - resumed)
        run.assert_consistent()
        print(f"answers after {served - resumed:.3f} s, valid after {valid - resumed:.3f} s")


def test_given_kills_at_any_moment_while_state_is_written_then_the_stored_state_is_complete(tmp_path: Path) -> None:
    chance, store = random.Random(5), OriginStore(tmp_path, "raptor")
    height = 0.0
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, "-c", SAVING, str(tmp_path)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.05))
            process.kill()
        origin = store.load()
        assert origin is not None
        assert origin == origin_at(50.0, -111.0, float(round(origin.height)))
        height = max(height, origin.height)
    assert height >= 20.0


def test_given_every_file_of_the_state_torn_then_the_daemon_starts_reports_it_and_serves(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run:
        state = tmp_path / "state"
        run.wait_until(lambda: any(state.glob("origin-*.json")), "a stored state")
        files = [each for each in state.rglob("*") if each.is_file()]
        assert files
        for number, tear in enumerate((lambda data: data[: len(data) // 2], lambda data: bytes(len(data)))):
            run.kill()
            for file in files:
                file.write_bytes(tear(file.read_bytes()))
            killed = run.start()
            run.wait_until(lambda killed=killed: run.is_answered_since(killed), "an answer")
            run.wait_until(lambda number=number: run.log.count("is damaged") > number, "a message about it")
        run.assert_consistent()


def test_given_a_stopped_process_with_threads_then_its_abort_prints_the_stack_of_the_main_thread() -> None:
    for _ in range(3):
        process = subprocess.Popen([sys.executable, "-c", HANGING], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        # as systemd does it: all threads wake at once, and any that does not block the signal may take it
        for number in (signal.SIGSTOP, signal.SIGABRT, signal.SIGCONT):
            process.send_signal(number)
        errors = process.communicate(timeout=TIMEOUT_S)[1].decode()
        assert process.returncode == -signal.SIGABRT
        assert "in hang" in errors
