"""The Debian package: what it contains, and that its environment runs by itself, wherever it is unpacked."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support_lcm import TIMEOUT_S, invoke
from support_nspawn import build_package

ROOT = Path(__file__).resolve().parents[2]
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
INSTALLED_MB = 220.0
"""Largest size of all files: half of an installation by pip with filterpy's plots, 441 MB."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("dpkg-deb") is None, reason="dpkg-deb is not installed"),
    pytest.mark.skipif(not Path(f"/usr/bin/{PYTHON}").exists(), reason=f"there is no /usr/bin/{PYTHON}"),
]


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of the package."""
    pytest.importorskip("hatchling", reason="hatchling, which builds the wheel, is not installed")
    folder = tmp_path_factory.mktemp("debian")
    subprocess.run(["dpkg-deb", "-R", build_package(folder), folder / "root"], check=True, timeout=TIMEOUT_S)
    return folder / "root"


def run(package: Path, *arguments: str, command: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run the package's command; it finds its packages beside itself, and nothing of this environment."""
    folder = package / "usr/lib/modelserver/bin"
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    return subprocess.run(
        [folder / "python", command or folder / "modelserver", *arguments],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env=clean,
        cwd=package,
        check=False,
    )


def test_given_the_package_then_it_holds_what_a_vehicle_needs_and_no_plots(package: Path) -> None:
    site = package / f"usr/lib/modelserver/lib/{PYTHON}/site-packages"
    there = {path.name for path in site.iterdir()}
    assert {"modelserver", "msdrivers", "mstools", "mslcm", "filterpy", "lcm", "numpy", "pyubx2"} <= there
    assert not {"matplotlib", "scipy", "pytest", "mypy", "pip"} & there
    size = sum(path.lstat().st_size for path in package.rglob("*")) / 1e6
    assert size < INSTALLED_MB
    control = (package / "DEBIAN/control").read_text()
    assert f"\nDepends: {PYTHON}" in control
    kilobytes = int(control.partition("\nInstalled-Size: ")[2].split()[0])
    assert kilobytes * 1024 == pytest.approx(size * 1e6, rel=0.01)
    completion = (package / "usr/share/bash-completion/completions/modelserver").read_text()
    assert "complete -o default -F _modelserver_completion modelserver" in completion
    for path in package.rglob("*"):
        assert path.is_symlink() or path.stat().st_mode & 0o444 == 0o444, path


def test_given_the_package_then_its_command_checks_queries_and_replays(package: Path) -> None:
    config = ROOT / "config" / "raptor"
    assert run(package, "--version").stdout.startswith("modelserver ")
    checked = run(package, "check", str(config / "vehicle.yaml"))
    assert (checked.returncode, checked.stderr) == (0, "")
    frames = ("Digiclops:ImagePlane", "FrontNoddingSICK:Origin")
    found = run(package, "query", *frames, "--model", str(config / "geometry.xml"))
    assert found.stdout == invoke("", "query", *frames, "--model", str(config / "geometry.xml")).stdout


OF_EXTRAS = {"rosbags", "viser", "websockets", "trimesh", "foxglove"}
"""Libraries that only the extras bags, view and foxglove need."""

IMPORT_ALL = """
import pkgutil, modelserver, msdrivers, mslcm, mstools
for package in (modelserver, msdrivers, mslcm, mstools):
    for each in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        try:
            __import__(each.name)
        except ModuleNotFoundError as error:
            print(error.name)
from modelserver.server.journal.writer import collect_facts
collect_facts()
"""


def test_given_the_package_then_every_module_finds_what_it_needs(package: Path) -> None:
    script = package / "import_all.py"
    script.write_text(IMPORT_ALL)
    imported = run(package, command=script)
    assert imported.returncode == 0, imported
    assert set(imported.stdout.split()) <= OF_EXTRAS


def find_package(library: Path) -> str:
    """Return the Debian package that a file is of."""
    command = ["dpkg", "-S", f"*/{library.name}"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split(":")[0]


def test_given_the_package_then_debian_has_each_shared_library_that_it_leaves_to_the_system(package: Path) -> None:
    found: set[str] = set()
    # those that a wheel brings are found by the modules that use them
    for library in [each for each in package.rglob("*.so*") if not each.parent.name.endswith(".libs")]:
        lines = subprocess.run(["ldd", library], capture_output=True, text=True, check=False).stdout.splitlines()
        found |= {line.split()[2] for line in lines if "=> /" in line}
        assert not [line for line in lines if "not found" in line], library
    outside = [Path(each).resolve() for each in found if not Path(each).resolve().is_relative_to(package)]
    assert any(each.name.startswith("libglib-2.0") for each in outside)
    owners = {
        subprocess.run(["dpkg", "-S", f"*/{each.name}"], capture_output=True, text=True, check=True).stdout.split(":")[
            0
        ]
        for each in outside
    }
    control = (package / "DEBIAN/control").read_text()
    depends = control.partition("\nDepends: ")[2].partition("\n")[0]
    # what the named packages need themselves
    assert owners - {"libc6", "libgcc-s1", "libpcre2-8-0"} <= set(depends.replace("|", ",").replace(" ", "").split(","))


@pytest.mark.parametrize("script", ["postinst", "prerm"])
def test_given_a_script_of_the_package_then_the_shell_accepts_it(package: Path, script: str) -> None:
    checked = subprocess.run(["sh", "-n", package / "DEBIAN" / script], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")
