"""Every command of README, quick start, tutorial and guides runs as it is written, in one bash for each page.

A page is a program: its ```sh and ```console blocks run in their order, its `<!-- file: NAME -->` blocks are written
first at their place. The bus is a port of its own with ttl=0; what a page starts ends with its bash. Marks, in the line
before a block, are visible in the Markdown:

- `<!-- file: NAME -->`: the reader writes this file.
- `<!-- output varies -->`: the output shown is an example; otherwise it is compared, `...` standing for anything.
- `<!-- output varies; exit code varies -->`: for commands that grade the machine they run on.
- `<!-- not run: REASON -->`: a reason of REASONS.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from support_bags import ROBOT, write_drive
from support_lcm import invoke, reserved_url

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
TIME_LIMIT_S = 90
"""For a page on a loaded machine; alone the longest takes 20 s."""

REASONS = (
    "installs an environment; .ci/run runs it",
    "needs root",
    "needs a device",
    "needs systemd units",
    "needs a recording of a magnetometer",
    "needs a signed vehicle; tests/scenario/test_joint_motion.py runs it",
    "needs a signed vehicle; tests/scenario/test_pose_set.py runs it",
    "needs a Raptor vehicle file with that change; tests/scenario/test_demo.py runs it",
    "needs that copy; tests/scenario/test_demo.py runs it",
    "needs other machines; tests/scenario/test_archive.py runs it",
    "takes minutes",
)
MOST_NOT_RUN = 17

TUTORIAL = DOCS / "tutorial.md"
IN_SOURCE = [ROOT / "README.md", DOCS / "quick-start.md", DOCS / "own-device.md", DOCS / "dynamics.md"]
"""Pages whose commands run in the source folder."""
ON_THE_ROVER = [DOCS / "clients.md", DOCS / "monitoring.md"]
"""Guides whose commands need the rover of the tutorial, driving."""
FROM_ROS = DOCS / "coming-from-ros.md"
COMMANDS_FROM_ROS = 6
"""To a report and to live lookups."""
AFTER_THE_ROVER = [
    DOCS / name
    for name in (
        "drivers.md",
        "publish-samples.md",
        "moving-geometry.md",
        "recordings.md",
        "archives.md",
        "calibration.md",
        "tuning.md",
        "deployment.md",
        "network.md",
        "journal.md",
        "device-gps.md",
        "device-gx1.md",
        "device-wheels.md",
        "device-axis.md",
    )
]
"""Guides whose commands run in the folder of the tutorial, after the drive."""
ELSEWHERE = {DOCS / "moving-geometry.md": "python"}
"""Blocks of a page that another test runs: see tests/scenario/test_joint_motion.py."""
SHOWN = {DOCS / "own-device.md": "python", DOCS / "clients.md": "text"}
"""Blocks of a page that are parts of a program: see tests/unit/drivers/test_own_device.py."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text, and the mark above it."""

    line: int
    language: str
    text: str
    mark: str

    @property
    def file(self) -> str:
        """The file that the reader writes with it; empty for none."""
        return self.mark.removeprefix("file: ") if self.mark.startswith("file: ") else ""

    @property
    def is_run(self) -> bool:
        return not self.file and not self.mark.startswith("not run:") and self.language in ("sh", "console", "python")


BLOCK = re.compile(r"(?:^<!-- ([^\n]*) -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks_of(page: Path) -> list[Block]:
    """Return the fenced blocks of a page."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(text.count("\n", 0, each.start(2)) + 1, each[2], each[3], (each[1] or "").strip())
        for each in BLOCK.finditer(text)
    ]


def commands_of(block: Block) -> list[tuple[str, str]]:
    """Return the commands of a console block with the output that is shown below each."""
    parts = re.split(r"^\$ ", block.text, flags=re.MULTILINE)
    return [(command, output) for command, _, output in (part.partition("\n") for part in parts[1:])]


def script_of(page: Path, folder: Path) -> str:
    """Return a page as a bash script, which puts the output of each compared command into a file of `folder`."""
    lines = ["set -eu", "trap 'jobs -p | xargs -r kill 2>/dev/null || true' EXIT"]
    for number, block in enumerate(blocks_of(page)):
        lines.append(f"echo '--- {page.name}:{block.line}' >&2")
        if block.file:
            (folder / f"{number}.file").write_text(block.text, encoding="utf-8")
            lines.append(f"cp '{folder}/{number}.file' '{block.file}'")
        elif not block.is_run or block.language == ELSEWHERE.get(page) or block.language == SHOWN.get(page):
            continue
        elif block.language == "sh":
            lines.append(block.text)
        elif block.language == "python":
            (folder / f"{number}.py").write_text(block.text, encoding="utf-8")
            lines.append(f"python '{folder}/{number}.py'")
        else:
            for index, (command, output) in enumerate(commands_of(block)):
                tail = " || true" if "exit code varies" in block.mark else ""
                lines.append(f"{{ {command}; }} > '{folder}/{number}.{index}.out'{tail}")
                if "output varies" not in block.mark:
                    (folder / f"{number}.{index}.expected").write_text(output, encoding="utf-8")
    return "\n".join(lines) + "\n"


def run_page(page: Path, where: Path, scratch: Path, url: str) -> None:
    """Run the commands of a page in a folder; fail where one fails or its output differs from what is shown."""
    scratch.mkdir()
    environment = os.environ | {
        "LCM_DEFAULT_URL": url,
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "XDG_STATE_HOME": str(scratch / "state"),
        "HOME": str(scratch),
        "COLUMNS": "100",
    }
    environment.pop("DISPLAY", None)
    script = scratch / "page.sh"
    script.write_text(script_of(page, scratch), encoding="utf-8")
    with (scratch / "log").open("w+b") as log:
        process = subprocess.Popen(
            ["bash", str(script)], cwd=where, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            code = process.wait(TIME_LIMIT_S)
        except subprocess.TimeoutExpired:
            code = -1
        finally:
            end_session(process)
        log.seek(0)
        output = log.read().decode(errors="replace")
    if code:
        logs = "".join(f"\n{each.name}:\n{each.read_text()[-1500:]}" for each in sorted(where.rglob("*.log")))
        pytest.fail(f"{page.name} ended with {code}:\n{output[-3000:]}{logs}")
    for expected in sorted(scratch.glob("*.expected")):
        printed = expected.with_suffix(".out").read_text(encoding="utf-8")
        pattern = re.escape(expected.read_text(encoding="utf-8").rstrip()).replace(r"\.\.\.", ".*?")
        assert re.fullmatch(pattern, printed.rstrip(), re.DOTALL), f"{page.name} shows another output than:\n{printed}"


def end_session(process: subprocess.Popen[bytes]) -> None:
    """End what a page has started: all in the session that the test made for it."""
    try:
        os.killpg(process.pid, signal.SIGTERM)
    except ProcessLookupError:
        return
    finally:
        process.wait()


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that looks like the source folder after `make demo`."""
    folder = tmp_path_factory.mktemp("source")
    shutil.copytree(ROOT / "config", folder / "config")
    (folder / "examples").symlink_to(ROOT / "examples")
    (folder / ".venv").symlink_to(sys.prefix)
    return folder


@pytest.fixture(scope="module")
def rover(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the tutorial after all its commands."""
    folder = tmp_path_factory.mktemp("tutorial")
    with reserved_url() as url:
        run_page(TUTORIAL, folder, folder / "scratch", url)
        # the guides after it name the journal of a drive with devices
        (folder / "rover" / "journal").symlink_to("emulated/journal")
        yield folder / "rover"


def test_given_the_tutorial_then_every_command_runs_and_the_pose_becomes_valid(rover: Path) -> None:
    assert (rover / "drive.html").stat().st_size > 50_000
    rows = (rover / "poses.csv").read_text().splitlines()
    assert any(row.split(",")[8] == "1" for row in rows[1:])


@pytest.mark.parametrize("page", IN_SOURCE, ids=lambda page: page.stem)
def test_given_a_page_for_the_source_folder_then_every_command_runs(
    source: Path, tmp_path: Path, page: Path, lcm_url: str
) -> None:
    run_page(page, source, tmp_path / "scratch", lcm_url)


def test_given_the_guides_for_a_running_service_then_every_command_runs(
    rover: Path, tmp_path: Path, lcm_url: str
) -> None:
    """The rover is started once more for all of them, as in the tutorial."""
    both = tmp_path / "both.md"
    until = "until modelserver status > status.txt; do sleep 0.5; done"
    start = f"```sh\nmodelserver up --emulate > up.log 2>&1 &\n{until}\n```\n"
    both.write_text(start + "".join(page.read_text(encoding="utf-8") for page in ON_THE_ROVER), encoding="utf-8")
    run_page(both, rover, tmp_path / "scratch", lcm_url)


@pytest.mark.parametrize("page", AFTER_THE_ROVER, ids=lambda page: page.stem)
def test_given_a_guide_then_every_command_runs(rover: Path, tmp_path: Path, page: Path, lcm_url: str) -> None:
    if page.name == "calibration.md":  # it names the log that this page writes
        run_page(DOCS / "publish-samples.md", rover, tmp_path / "before", lcm_url)
    run_page(page, rover, tmp_path / "scratch", lcm_url)


EKF = f"""
ekf_filter_node:
  ros__parameters:
    frequency: 50.0
    two_d_mode: true
    base_link_frame: base_link
    odom0: odom
    odom0_config: [{"false, " * 6}true, {"false, " * 4}true, false, false, false]
    imu0: imu/data
    imu0_config: [{"false, " * 11}true, true, false, false]
    odom1: odometry/gps
"""


def test_given_a_bag_a_urdf_and_an_ekf_then_the_page_leads_to_a_report_and_to_lookups(
    tmp_path: Path, lcm_url: str
) -> None:
    (tmp_path / "robot.urdf").write_text(ROBOT)
    (tmp_path / "ekf.yaml").write_text(EKF)
    write_drive(tmp_path / "drive.bag", tmp_path / "robot.urdf")
    run_page(FROM_ROS, tmp_path, tmp_path / "scratch", lcm_url)
    poses = ("--poses", str(tmp_path / "poses.csv"), "--json")
    done = invoke("", "replay", str(tmp_path / "drive.lcm"), "-c", str(tmp_path / "rover" / "vehicle.yaml"), *poses)
    found = json.loads(done.stdout)
    assert found["valid"] > 0.7 * found["poses"]
    assert (tmp_path / "report.html").stat().st_size > 50_000
    assert (tmp_path / "scratch" / "log").read_text().count("base_link:Origin in World:ENU\n") >= 3
    assert sum(block.text.count("modelserver ") for block in blocks_of(FROM_ROS)) == COMMANDS_FROM_ROS


# --- the marks --------------------------------------------------------------------------------------------------------

TESTED = [TUTORIAL, FROM_ROS, DOCS / "operation.md", *IN_SOURCE, *ON_THE_ROVER, *AFTER_THE_ROVER]


def test_given_the_pages_then_blocks_that_do_not_run_are_few_and_have_a_known_reason() -> None:
    marks = {
        f"{page.name}:{block.line}": block.mark.removeprefix("not run: ")
        for page in TESTED
        for block in blocks_of(page)
        if block.mark.startswith("not run")
    }
    unknown = {place: reason for place, reason in marks.items() if reason not in REASONS}
    assert not unknown
    assert len(marks) <= MOST_NOT_RUN, marks


def test_given_the_pages_then_no_other_page_has_commands() -> None:
    others = {page for page in DOCS.rglob("*.md") if page not in TESTED}
    assert not [page.name for page in others for block in blocks_of(page) if block.language in ("sh", "console")]


def test_given_a_mark_then_it_is_a_known_one() -> None:
    known = ("file: ", "not run: ", "output varies")
    assert not [
        f"{page.name}:{block.line}: {block.mark}"
        for page in TESTED
        for block in blocks_of(page)
        if block.mark and not block.mark.startswith(known) and block.language in ("sh", "console", "python", "yaml")
    ]
