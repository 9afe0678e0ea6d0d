"""The daemon killed, hung, started again, and cut off while it writes; what its clients see of that."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from support_daemon import trial
from support_lcm import PATIENCE_S

from modelserver.client.mirror import PlatformMirror
from modelserver.earth.geodesy import origin_at
from modelserver.errors import NoPoseError, NoServerError
from modelserver.service.keeping.origin import OriginKeeper

SAVING = """
import sys
from pathlib import Path
from modelserver.earth.geodesy import origin_at
from modelserver.service.keeping.origin import OriginKeeper
keeper, n = OriginKeeper(Path(sys.argv[1]), "raptor"), 0
while True:
    n += 1
    keeper.save(origin_at(50.0, -111.0, float(n)))
    if n == 20:
        print("saves", flush=True)
"""


def answers(mirror: PlatformMirror) -> bool:
    """Return whether a mirror answers about the world: its newest pose may still be that of a service that starts."""
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
        mirror.wait(PATIENCE_S)
        killed = run.kill()
        run.start_again()
        served = run.until(lambda: run.answered_since(killed), "an answer")
        valid = run.until(lambda: run.valid_since(killed), "a valid pose")
        # its clients were told clearly, and go on with the same objects
        assert {type(error) for at, error in run.errors if killed + 0.5 < at < served} <= {NoServerError}
        assert any(at > killed for at, _ in run.errors)
        run.until(lambda: answers(mirror), "an answer of the mirror")
        assert run.last.transformation.origin_id == before.origin_id
        assert valid > served - 1.0
        run.assert_right()
        print(f"serving after {served - killed:.2f} s, valid after {valid - killed:.2f} s")


def test_given_a_hang_that_ends_then_the_daemon_goes_on_and_does_not_make_up_for_what_it_missed(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run:
        run.until_health(lambda health: health.utime > 0, "a report")
        missed = run.health.ticks_missed
        run.process.send_signal(signal.SIGSTOP)
        hung = time.monotonic()
        run.elapse(1.0)
        assert any(at > hung + 0.3 for at, _ in run.errors)
        woken, poses = time.monotonic(), len(run.heard.poses)
        run.process.send_signal(signal.SIGCONT)
        served = run.until(lambda: run.answered_since(woken), "an answer")
        valid = run.until(lambda: run.valid_since(woken), "a valid pose")
        health = run.until_health(lambda health: health.ticks_missed >= missed + 80, "the ticks that were missed")
        assert health.handler_errors == 0
        assert len(run.heard.poses) - poses < 40 + 100 * (time.monotonic() - woken)
        run.assert_right()
        print(f"answers after {served - woken:.3f} s, valid after {valid - woken:.3f} s")


def test_given_kills_at_any_moment_while_state_is_written_then_what_is_kept_is_whole(tmp_path: Path) -> None:
    chance, keeper = random.Random(5), OriginKeeper(tmp_path, "raptor")
    height = 0.0
    for _ in range(6):
        with subprocess.Popen(
            [sys.executable, "-c", SAVING, str(tmp_path)], stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.05))
            process.kill()
        origin = keeper.load()
        assert origin is not None
        assert origin == origin_at(50.0, -111.0, float(round(origin.height)))
        height = max(height, origin.height)
    assert height >= 20.0


def test_given_every_file_of_the_state_torn_then_the_daemon_starts_says_so_and_serves(
    lcm_url: str, tmp_path: Path
) -> None:
    with trial(lcm_url, tmp_path) as run:
        state = tmp_path / "state"
        run.until(lambda: any(state.glob("origin-*.json")), "anything kept")
        files = [each for each in state.rglob("*") if each.is_file()]
        assert files
        for number, tear in enumerate((lambda data: data[: len(data) // 2], lambda data: bytes(len(data)))):
            run.kill()
            for file in files:
                file.write_bytes(tear(file.read_bytes()))
            killed = run.start()
            run.until(lambda killed=killed: run.answered_since(killed), "an answer")
            run.until(lambda number=number: run.log.count("is damaged") > number, "a word about it")
        run.assert_right()
