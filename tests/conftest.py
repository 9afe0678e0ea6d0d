"""Fixtures of all tests, and the order in which test files run."""

from __future__ import annotations

import gc
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

from collections.abc import Iterator  # noqa: E402
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
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
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
    """Order the files, the units of `--dist loadfile`: the slowest first.

    Scenario files, which mostly wait, alternate with files that compute.
    """
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    slow = {path: sum(map(_is_slow, found)) / len(found) for path, found in files.items()}
    waiting = sorted((path for path in files if path.parent.name == "scenario"), key=_rank)
    computing = sorted((path for path, share in slow.items() if share and path not in waiting), key=lambda p: -slow[p])
    mixed = [path for pair in zip_longest(waiting, computing) for path in pair if path is not None]
    rest = [path for path in files if path not in mixed]
    items[:] = [item for path in (*mixed, *rest) for item in files[path]]


def _is_slow(item: pytest.Item) -> bool:
    return item.get_closest_marker("slow") is not None or item.path.parent.name == "realdata"


def pytest_collection_finish() -> None:
    """Exclude the collected tests from garbage collection."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000, 50, 50)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Share nothing with tests that patch the code under test."""
    support_shared.begin_test(getattr(item, "fixturenames", ()))


LONGEST = (
    "docs_commands",
    "drivers",
    "service",
    "monitoring",
    "systemd",
    "demo",
    "faults_data",
    "faults_processes",
    "faults_drivers",
)
"""The slowest scenario files, slowest first."""


def _rank(path: Path) -> int:
    name = path.stem.removeprefix("test_")
    return LONGEST.index(name) if name in LONGEST else len(LONGEST)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recorded real data; skip the test where it is absent."""
    given = os.environ.get("MODELSERVER_DATA")
    place = Path(given) if given else Path(__file__).resolve().parents[1] / "../shared/data"
    if not place.is_dir():
        pytest.skip(f"the recorded data are not at {place}; set MODELSERVER_DATA to their folder")
    return place.resolve()


@pytest.fixture
def lcm_url() -> Iterator[str]:
    """Yield an LCM provider on loopback that no other test uses."""
    with reserved_url() as url:
        yield url
