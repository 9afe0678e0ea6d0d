"""What every test may use."""

from __future__ import annotations

import os
import sys

# Modules are compiled once, also where the environment forbids it: each worker and each of the hundreds of processes
# that tests start would compile the whole package again, which doubles the time until a daemon serves. Before the
# imports, for pytest compiles what it rewrites when it is imported.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from collections.abc import Iterator  # noqa: E402
from pathlib import Path  # noqa: E402

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402
from support_lcm import reserved_url  # noqa: E402

# The same examples on every run and every machine; a loaded machine must not fail a test by its slowness.
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recorded real data; the test is skipped where it is absent."""
    given = os.environ.get("MODELSERVER_DATA")
    place = Path(given) if given else Path(__file__).resolve().parents[1] / "../shared/data"
    if not place.is_dir():
        pytest.skip(f"the recorded data are not at {place}; set MODELSERVER_DATA to their folder")
    return place.resolve()


@pytest.fixture
def lcm_url() -> Iterator[str]:
    """An LCM provider on loopback that no other test uses."""
    with reserved_url() as url:
        yield url
