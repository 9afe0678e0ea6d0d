"""`modelserver demo` as a person runs it: the whole service in three processes, and nothing left behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from modelserver.errors import NoServerError
from mstools import demo

DEMO = [sys.executable, "-c", "from mstools.cli import main; main()", "demo"]


def start(*arguments: str) -> subprocess.Popen[str]:
    # unbuffered: what it prints is waited for line by line
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        [*DEMO, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def url_in(text: str) -> str:
    found = re.search(r"--url '(\S+)'", text)
    assert found, text
    return found[1]


def still_running(url: str) -> list[str]:
    """Return the command lines of processes that were given this bus, which is the demo's alone."""
    running = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = place.read_bytes().split(b"\0")
        except OSError:
            continue  # it ended meanwhile
        if url.encode() in words:
            running.append(b" ".join(words).decode(errors="replace"))
    return running


def test_given_nothing_else_when_the_demo_runs_then_it_shows_a_valid_pose_and_ends_by_itself():
    process = start("--seconds", "7")
    try:
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert "Raptor, FrontNoddingSICK, BackNoddingSICK, Digiclops" in out
    assert "0.2990  -0.0560  0.4330  m" in out
    assert re.search(r"^ +\d\.\d\d s .* valid$", out, re.MULTILINE)
    assert "not valid: heading is not known before the vehicle moves" in out
    assert "Digiclops:ImagePlane in World:UTM" in out
    assert "Nearest: Digiclops:ImagePlane" in out
    assert err == ""
    assert still_running(url_in(out)) == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_given_a_running_demo_when_it_is_told_to_end_then_its_children_end_too(number, code):
    process = start("--seconds", "60")
    assert process.stdout is not None
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if re.match(r" +1\.\d\d s ", line):  # by now all three processes are at work
                break
        url = url_in("".join(lines))
        assert len(still_running(url)) == 2
        process.send_signal(number)
        process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == code
    assert still_running(url) == []


def test_given_a_daemon_that_fails_when_its_answer_is_waited_for_then_what_it_said_is_told(tmp_path):
    def nobody() -> list[str]:
        children._started[0].process.wait()
        raise NoServerError("no reply")

    with demo.Children(tmp_path, verbose=False) as children:
        children.start("daemon", "-c", "import sys; sys.exit('the geometry is wrong')")
        with pytest.raises(demo.DemoError, match=r"the daemon ended with exit code 1(.|\n)*the geometry is wrong"):
            demo.first_answer(nobody, children)


def test_given_an_error_in_the_demo_when_it_leaves_then_its_children_are_ended(tmp_path):
    children = demo.Children(tmp_path, verbose=False)

    def fail() -> None:
        with children:
            children.start("patient child", "-c", "import signal; signal.pause()")
            raise RuntimeError("trouble")

    with pytest.raises(RuntimeError, match="trouble"):
        fail()
    assert [child.process.poll() for child in children._started] == [-signal.SIGTERM]


def test_the_vehicle_file_is_found():
    assert demo.vehicle_file().read_text().startswith("# The DRDC Raptor")
