"""A journal written by one Python is replayed by another, with another numpy, where the machine has both.

$MODELSERVER_OTHER_PYTHON names the other interpreter: of an environment in which modelserver's dependencies are
installed, best with another numpy. CI sets it; without it these tests are skipped.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support_journal import OPEN, JournalRig

from modelserver.server.journal.verify import TOLERANCE, VerificationResult

ROOT = Path(__file__).resolve().parents[3]
OTHER = os.environ.get("MODELSERVER_OTHER_PYTHON", "")

pytestmark = pytest.mark.skipif(not OTHER, reason="MODELSERVER_OTHER_PYTHON names no second interpreter")

WRITE = (
    "import sys; from pathlib import Path; from support_journal import OPEN, JournalRig; "
    "rig = JournalRig(Path(sys.argv[1]), OPEN); rig.drive(6.0); rig.finish()"
)


def ran(python: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    paths = [ROOT, ROOT / "lcmtypes", ROOT / "tools", ROOT / "drivers", ROOT / "tests"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, paths))}
    return subprocess.run(
        [python, *arguments], env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def verify_with(python: str, journal: Path) -> None:
    found = ran(python, "-c", "from mstools.cli import main; main()", "replay", "--verify", str(journal), "--json")
    assert found.returncode in (0, VerificationResult.WITHIN_TOLERANCE), found.stdout + found.stderr
    report = json.loads(found.stdout)
    assert report["difference"] is None
    assert report["poses"] + sum(report["close"].values()) > 800
    assert max(report["largest"]["meters"], report["largest"]["radians"]) <= TOLERANCE


def test_given_a_journal_of_this_python_then_the_other_reproduces_it(tmp_path: Path) -> None:
    rig = JournalRig(tmp_path, OPEN)
    rig.drive(6.0)
    rig.finish()
    verify_with(OTHER, rig.directory)


def test_given_a_journal_of_the_other_python_then_this_one_reproduces_it(tmp_path: Path) -> None:
    written = ran(OTHER, "-c", WRITE, str(tmp_path))
    assert written.returncode == 0, written.stderr
    verify_with(sys.executable, tmp_path / "journal")
