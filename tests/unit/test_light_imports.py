"""A question on the command line must not wait for the imports of the filter, of plots or of map projections."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("filterpy", "matplotlib", "scipy", "pyproj")

CART = """\
modelserver: geometry/1
name: cart
bodies:
  Cart:
    frames:
      Origin: {}
      Top: {xyz: [0, 0, 1]}
  Camera:
    frames:
      Mount: {}
      Lens: {xyz: [0.1, 0, 0]}
constraints:
  CameraFixed: {from: Cart:Top, to: Camera:Mount}
"""

WATCH = f"""
import atexit, sys
def report():
    loaded = {{name.partition('.')[0] for name in sys.modules}} & set({HEAVY!r})
    sys.stderr.write('\\nLOADED ' + ' '.join(sorted(loaded)))
atexit.register(report)
"""


def heavy_after(code: str, *arguments: str) -> tuple[list[str], subprocess.CompletedProcess[str]]:
    """Run `code` in a fresh interpreter; return which heavy packages it had loaded at its end, and the run."""
    run = subprocess.run(
        [sys.executable, "-c", WATCH + code, *arguments], capture_output=True, text=True, timeout=60, check=False
    )
    printed, mark, loaded = run.stderr.rpartition("LOADED")
    assert mark, f"the program did not come to its end: {run.stderr}"
    return loaded.split(), subprocess.CompletedProcess(run.args, run.returncode, run.stdout, printed)


COMMAND = "from mstools.cli import main; main(sys.argv[1:])"


@pytest.fixture
def cart(tmp_path):
    path = tmp_path / "cart.yaml"
    path.write_text(CART, encoding="utf-8")
    return str(path)


def test_importing_the_package_loads_nothing_heavy():
    loaded, run = heavy_after("import modelserver")
    assert (loaded, run.returncode) == ([], 0), run.stderr


def test_loading_and_asking_a_model_in_a_program_loads_nothing_heavy(cart):
    code = """
import modelserver as ms
answer = ms.load_model(sys.argv[1]).get_transformation("Camera:Lens", "Cart:Origin")
print(*answer.position)
"""
    loaded, run = heavy_after(code, cart)
    assert (loaded, run.returncode, run.stdout.split()) == ([], 0, ["0.1", "0.0", "1.0"]), run.stderr


@pytest.mark.slow
def test_query_with_a_file_loads_nothing_heavy(cart):
    loaded, run = heavy_after(COMMAND, "query", "Camera:Lens", "Cart:Origin", "--model", cart)
    assert (loaded, run.returncode) == ([], 0), run.stderr
    assert "Camera:Lens" in run.stdout


def test_check_loads_nothing_heavy(cart):
    loaded, run = heavy_after(COMMAND, "check", cart)
    assert (loaded, run.returncode) == ([], 0), run.stderr


@pytest.mark.slow
def test_the_service_and_its_filter_load_pyproj_alone_of_what_is_heavy():
    loaded, run = heavy_after("import modelserver.server.daemon, modelserver.estimation.filter.localizer")
    assert (loaded, run.returncode) == (["pyproj"], 0), run.stderr


def test_the_watch_sees_what_is_heavy():
    loaded, _ = heavy_after("import scipy")
    assert loaded == ["scipy"]
