"""Fixtures of all tests, and the order in which test files run."""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import warnings

# Modules are compiled once, also where the environment forbids it: each worker and each of the hundreds of processes
# that tests start would compile the whole package again, which doubles the time until a daemon serves. Before the
# imports, for pytest compiles what it rewrites when it is imported.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# As in the `modelserver` command: threads of numpy's linear algebra cost each process 0.1 s and save nothing.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections import Counter  # noqa: E402
from collections.abc import Generator, Iterator  # noqa: E402
from contextlib import suppress  # noqa: E402
from importlib import import_module  # noqa: E402
from itertools import zip_longest  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import pytest  # noqa: E402
import support_shared  # noqa: E402
from hypothesis import settings  # noqa: E402
from support_lcm import reserved_url  # noqa: E402

# A shell script's background jobs ignore SIGINT, and so would the programs that tests start and interrupt.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples on every run and every machine; a loaded machine must not fail a test by its slowness.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=30)
settings.load_profile("repeatable")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Run more workers than processors: the scenario tests spend half of their time waiting."""
    return len(os.sched_getaffinity(0)) + 2


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Import the test files before they are collected, each worker from another one on.

    pytest compiles a test file that was never imported. Workers that begin with the same file compile each of them at
    the same time; these find most of them compiled.
    """
    worker: dict[str, Any] | None = getattr(session.config, "workerinput", None)
    if worker is None:
        return
    paths = [Path(argument.partition("::")[0]) for argument in session.config.args]
    files = sorted(file for path in paths for file in ([path] if path.is_file() else path.rglob("test_*.py")))
    begin = len(files) * int(worker["workerid"].removeprefix("gw")) // worker["workercount"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for file in files[begin:] + files[:begin]:
            folder = str(file.resolve().parent)
            if folder not in sys.path:
                sys.path.insert(0, folder)
            # what is wrong with it is reported when it is collected
            with suppress(Exception, pytest.skip.Exception):
                import_module(file.stem)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Order the files, which `--dist loadfile` hands out whole: the longest first, so that the workers end together.

    Whole files, since what their tests share is computed once in a process. Scenario files, which mostly wait,
    alternate with files that compute.
    """
    files: dict[str, list[pytest.Item]] = {}
    for item in sorted(items, key=lambda item: -DURATIONS.get(_name_file(item.nodeid), 0.0)):
        files.setdefault(_name_file(item.nodeid), []).append(item)
    waiting = [name for name in files if "/scenario/" in name]
    computing = [name for name in files if "/scenario/" not in name]
    mixed = [name for pair in zip_longest(waiting, computing) for name in pair if name is not None]
    items[:] = [item for name in mixed for item in files[name]]


def _name_file(nodeid: str) -> str:
    return nodeid.partition("::")[0]


def pytest_collection_finish() -> None:
    """Exclude the collected tests from garbage collection."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 50, 50)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Share nothing with tests that patch the code under test."""
    support_shared.begin_test(getattr(item, "fixturenames", ()))


DURATIONS_FILE = Path(__file__).with_name("durations.json")
DURATIONS: dict[str, float] = json.loads(DURATIONS_FILE.read_text())
"""Seconds of each test file in a whole run; those of a second and less are left out."""

_measured: Counter[str] = Counter()


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Measure the files; in the process that hands them out this is called for all tests."""
    _measured[_name_file(report.nodeid)] += report.duration


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Store the durations with MODELSERVER_STORE_DURATIONS=1, after a whole run."""
    if os.environ.get("MODELSERVER_STORE_DURATIONS") == "1" and not hasattr(session.config, "workerinput"):
        longest = {name: round(seconds) for name, seconds in _measured.most_common() if seconds > 1.0}
        DURATIONS_FILE.write_text(json.dumps(longest, indent=1) + "\n")


NO_RECORDINGS = "no recordings: tests/realdata/README.md has where to get them; set MODELSERVER_DATA to their folder"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
    """Give all tests that lack the recordings one place, so that pytest prints one line for them."""
    report = yield
    if report.skipped and isinstance(report.longrepr, tuple) and report.longrepr[2].endswith(NO_RECORDINGS):
        report.longrepr = (__file__, 0, report.longrepr[2])
    return report


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recorded real data; skip the test where it is absent."""
    given = os.environ.get("MODELSERVER_DATA")
    place = Path(given) if given else Path(__file__).resolve().parents[1] / "../shared/data"
    if not place.is_dir():
        pytest.skip(NO_RECORDINGS)
    return place.resolve()


@pytest.fixture
def lcm_url() -> Iterator[str]:
    """Yield an LCM provider on loopback that no other test uses."""
    with reserved_url() as url:
        yield url
