"""Looking at the running daemon: status and doctor as processes of their own on its bus."""

from __future__ import annotations

import json
import os
import pty
import re
import select
import shutil
import signal
import subprocess
import termios
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from conftest import FAST_HEALTH, Daemon
from support_command import run_command
from support_lcm import MODELSERVER, TIMEOUT_S, invoke
from support_samples import VEHICLE, write_vehicle

from modelserver.messages import Invalid
from modelserver.server.diagnostics import probe_delivery

StartDaemon = Callable[..., Daemon]
NO_SENSORS = "".join(
    line for line in VEHICLE.splitlines(keepends=True) if not line.strip().startswith(("sensors:", "gps:", "imu:"))
)


def ran(url: str, *arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    """Run a subcommand on a bus as a process of its own until it ends."""
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"} | {"LCM_DEFAULT_URL": url}
    return subprocess.run(
        [*MODELSERVER, *map(str, arguments)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT_S,
        **options,  # type: ignore[call-overload]
    )


# --- health -------------------------------------------------------------------------------------------------


def test_given_a_real_daemon_then_its_report_reports_of_process_loop_and_sensors(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    fresh = daemon.health()
    assert {each.channel: (each.count, each.silent) for each in fresh.channels} == {
        "GPS": (0, True),
        "IMU": (0, True),
    }
    assert fresh.pid == daemon.process.pid
    assert fresh.host
    later = daemon.health(lambda health: health.cpu_share == health.cpu_share)
    assert 0.0 < later.cpu_share < 1.5
    assert 30_000_000 < later.memory < 1_000_000_000
    assert 0.0 < later.tick_latency_p50 <= later.tick_latency_p90 <= later.tick_latency_p99 <= later.tick_latency_max
    # then the sensors speak, and fall silent
    daemon.feed()
    silent = daemon.health(
        lambda health: {"sensor:gps", "sensor:imu"} == {each.channel for each in health.channels if each.silent}
    )
    assert all(each.count for each in silent.channels)
    assert Invalid.STALE_IMU in silent.invalid_reasons


# --- status -------------------------------------------------------------------------------------------------


def test_given_a_daemon_without_a_pose_then_status_reports_why_and_exits_3(start_daemon: StartDaemon) -> None:
    daemon = start_daemon()
    done = ran(daemon.url, "status")
    assert done.returncode == 3, done.stderr
    for words in (
        "cart: STARTING",
        "NOT VALID: no usable GPS fix yet",
        "never received",
        f"process {daemon.process.pid}",
    ):
        assert words in done.stdout
    data = json.loads(invoke(daemon.url, "status", "--json").stdout)
    assert (data["state"], data["healthy"], data["pid"]) == ("STARTING", False, daemon.process.pid)


def test_given_a_vehicle_without_sensors_then_it_is_well_and_status_exits_0(start_daemon: StartDaemon) -> None:
    done = invoke(start_daemon(NO_SENSORS).url, "status")
    assert done.returncode == 0, done.stderr
    assert "no localization sensor is configured" in done.stdout


def test_given_the_wrong_prefix_then_status_offers_the_one_that_is_received(start_daemon: StartDaemon) -> None:
    daemon = start_daemon(FAST_HEALTH + "lcm: {channel_prefix: RAPTOR_}\n", prefix="RAPTOR_")
    done = invoke(daemon.url, "status", "--prefix", "RAPTR_", "--timeout", "0.5")
    assert (done.returncode, done.stdout) == (1, "")
    assert "Did you mean --prefix 'RAPTOR_'?" in done.stderr
    # and the vehicle file knows it
    assert invoke(daemon.url, "status", "-c", daemon.folder / "vehicle.yaml").returncode == 3


def test_given_an_empty_bus_then_status_reports_what_to_look_at_and_exits_1(lcm_url: str) -> None:
    done = invoke(lcm_url, "status", "--timeout", "0.2")
    assert (done.returncode, done.stdout) == (1, "")
    assert "modelserver doctor checks the bus" in done.stderr
    assert lcm_url in done.stderr


def test_given_watch_into_a_pipe_then_the_reports_follow_one_another_until_it_is_interrupted(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon()
    with run_command(["status", "--watch"], daemon.url, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        with process.stdout:
            lines: list[str] = []
            while sum(line.startswith("pose ") for line in lines) < 3:
                lines.append(process.stdout.readline())
                assert lines[-1]
            process.send_signal(signal.SIGINT)
            assert process.wait(TIMEOUT_S) == 0
    assert all("NOT VALID" in line for line in lines if line.startswith("pose "))
    assert sum(line.startswith("cart: STARTING") for line in lines) == 3


class Screen:
    """A terminal with a program in it."""

    def __init__(self, arguments: Sequence[str], url: str):
        self.main, self.end = pty.openpty()
        termios.tcsetwinsize(self.end, (40, 140))
        left_out = ("DISPLAY", "COLUMNS", "LINES")
        environment = {key: value for key, value in os.environ.items() if key not in left_out}
        self.process = subprocess.Popen(
            [*MODELSERVER, *arguments],
            stdin=self.end,
            stdout=self.end,
            stderr=self.end,
            env=environment | {"LCM_DEFAULT_URL": url, "TERM": "xterm-256color"},
            start_new_session=True,
        )
        self.output = ""

    def shows(self, pattern: str) -> bool:
        """Return whether what matches comes, from now on, in time."""
        deadline = time.monotonic() + TIMEOUT_S
        seen = ""
        while time.monotonic() < deadline:
            ready, _, _ = select.select([self.main], [], [], 0.5)
            if ready:
                try:
                    seen += os.read(self.main, 65536).decode(errors="replace")
                except OSError:
                    break  # the program has ended
            if re.search(pattern, seen):
                return True
        self.output = seen
        return False

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.main)
        os.close(self.end)


@pytest.fixture
def screen(start_daemon: StartDaemon) -> Iterator[Callable[..., Screen]]:
    url = start_daemon().url
    opened: list[Screen] = []

    def show(*arguments: str) -> Screen:
        opened.append(Screen(arguments, url))
        return opened[-1]

    yield show
    for each in opened:
        each.close()


def test_given_a_terminal_then_status_watch_shows_the_report_until_ctrl_c(screen: Callable[..., Screen]) -> None:
    watch = screen("status", "--watch")
    assert watch.shows("cart: STARTING"), watch.output
    watch.process.send_signal(signal.SIGINT)
    assert watch.process.wait(TIMEOUT_S) == 0


# --- doctor, and the probe at the start ---------------------------------------------------------------------


def test_given_a_bus_that_is_well_then_our_own_messages_come_back_and_one_daemon_answers(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon()
    assert probe_delivery(daemon.url) == (True, True)
    done = ran(daemon.url, "doctor", "-c", daemon.folder / "vehicle.yaml", "--json")
    output = {each["subject"]: each for each in json.loads(done.stdout)["findings"]}
    assert output["own message"]["level"] == "ok"
    assert f"process {daemon.process.pid} on" in output["daemon"]["observed"]
    assert output["vehicle file"]["level"] == output["state"]["level"] == "ok"
    assert done.returncode in (0, 1)


def test_given_two_daemons_on_one_bus_then_each_warns_of_the_other_until_it_ends_and_doctor_finds_both(
    start_daemon: StartDaemon, tmp_path: Path
) -> None:
    first = start_daemon()
    second = start_daemon(folder=tmp_path / "second")
    pids = {first.process.pid, second.process.pid}

    def is_reported(pid: int, other: int) -> bool:
        health = first.health(lambda health: health.pid == pid and "servers" in dict(health.warnings))
        return f"process {other} on" in dict(health.warnings)["servers"]

    assert is_reported(first.process.pid, second.process.pid)
    assert is_reported(second.process.pid, first.process.pid)
    done = invoke(first.url, "doctor")
    assert done.returncode == 3
    assert "2 answer at once" in done.stdout
    assert all(f"process {pid} on" in done.stdout for pid in pids)
    assert second.end() == 0
    first.health(lambda health: health.pid == first.process.pid and "servers" not in dict(health.warnings))


def unshare_command() -> list[str]:
    """The words before a command that give it a network of its own, without any route."""
    words = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--net", "--map-root-user"]
    if shutil.which("unshare") is None or shutil.which("ip") is None:
        pytest.skip("unshare or ip is missing, so there is no network to take away")
    if subprocess.run([*words, "true"], capture_output=True).returncode:
        pytest.skip("this system gives nobody a network of its own (unshare --net)")
    return words


SCRIPT = """\
"$@" run -c vehicle.yaml 2>run.log; echo run $?
"$@" doctor --json >before.json; echo before $?
python - <<'END' >fix.sh
import json
findings = json.load(open("before.json"))["findings"]
print(next(each["command"] for each in findings if each["level"] == "error").replace("sudo ", ""))
END
sh -e fix.sh; echo fixed $?
"$@" doctor --json >after.json; echo after $?
"""


def test_given_a_machine_without_a_route_then_the_daemon_refuses_and_doctors_command_fixes_it(tmp_path: Path) -> None:
    words = unshare_command()
    write_vehicle(tmp_path)
    python = MODELSERVER[0]
    done = subprocess.run(
        [*words, "sh", "-c", SCRIPT.replace("python -", f"{python} -"), "sh", *MODELSERVER],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT_S,
        env=os.environ | {"LCM_DEFAULT_URL": ""},
    )
    codes = dict(line.split() for line in done.stdout.splitlines())
    assert (codes["run"], codes["before"], codes["fixed"]) == ("1", "3", "0"), done.stdout + done.stderr
    assert "ip route replace 239.255.76.67/32 dev lo" in (tmp_path / "run.log").read_text()
    assert codes["after"] in ("0", "1")
    found = {each["subject"]: each for each in json.loads((tmp_path / "after.json").read_text())["findings"]}
    assert (found["own message"]["level"], found["multicast route"]["level"]) == ("ok", "ok")


# --- metrics --------------------------------------------------------------------------------------------------


def test_given_a_real_daemon_then_prometheus_reads_its_metrics_and_whether_it_is_gone(
    start_daemon: StartDaemon,
) -> None:
    daemon = start_daemon()
    daemon.health()
    environment = os.environ | {"LCM_DEFAULT_URL": daemon.url}
    with subprocess.Popen(
        [*MODELSERVER, "status", "--metrics", "0"], env=environment, stdout=subprocess.PIPE, text=True
    ) as serving:
        try:
            assert serving.stdout is not None
            address = serving.stdout.readline().split()[0]
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/metrics", address)

            def wait_for(line: str) -> str:
                deadline = time.monotonic() + TIMEOUT_S
                while True:
                    with urllib.request.urlopen(address, timeout=TIMEOUT_S) as answer:
                        text: str = answer.read().decode()
                    if f"\n{line}\n" in text:
                        return text
                    assert time.monotonic() < deadline, text
                    time.sleep(0.1)

            text = wait_for("modelserver_up 1.0")
            assert 'modelserver_source_silent{source="GPS"} 1.0' in text
            assert "modelserver_pose_valid 0.0" in text
            assert text.endswith("\n# EOF\n")
            daemon.process.kill()
            text = wait_for("modelserver_up 0.0")
            assert "modelserver_pose_valid" not in text
            serving.send_signal(signal.SIGINT)
            assert serving.wait(TIMEOUT_S) == 0
        finally:
            serving.kill()
