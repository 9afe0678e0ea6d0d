"""The Debian package: what it contains, and that its environment runs by itself, wherever it is unpacked."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support_lcm import TIMEOUT_S, invoke
from support_nspawn import build_package, build_wheel
from support_tuning import write_simulated_log
from support_view import record_drive

ROOT = Path(__file__).resolve().parents[2]
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
INSTALLED_MB = 320.0
"""Largest size of all files: an installation by pip with the same extras has 510 MB, with filterpy's plots."""

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
    assert {"rosbags", "mcap", "foxglove", "plotly", "viser"} <= there
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


NOT_PACKAGED = {"pinocchio", "pyarrow", "rasterio"}
"""Libraries of the extras dynamics, archive and map."""

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
    assert set(imported.stdout.split()) <= NOT_PACKAGED


USE_EXTRAS = """
import foxglove, rosbags.highlevel, mcap.reader, viser, websockets, trimesh
from modelserver.extras import describe_missing, make_install_command
from mstools.report.charts import render_page
assert len(render_page("a", "b")) > 1e6
viser.ViserServer(host="127.0.0.1", port=0, verbose=False).stop()
print(describe_missing())
"""


def test_given_the_package_then_the_extras_of_its_commands_work_and_the_missing_one_has_advice(package: Path) -> None:
    script = package / "use_extras.py"
    script.write_text(USE_EXTRAS)
    used = run(package, command=script)
    assert used.returncode == 0, used
    assert used.stdout.endswith(
        "Extras that are not installed: archive,dynamics,map. To add them: the Debian package does not have the extra "
        "archive,dynamics,map; "
        "in a folder with the source: sudo /usr/bin/python3 -m venv --clear /opt/modelserver && "
        "sudo /opt/modelserver/bin/pip install '.[archive,dynamics,map]'\n"
    )


def test_given_the_package_then_a_log_becomes_a_report_and_an_mcap_file(package: Path, tmp_path: Path) -> None:
    log, vehicle = write_simulated_log(tmp_path, 20.0)
    report = tmp_path / "report.html"
    replayed = run(package, "replay", str(log), "-c", str(vehicle), "--report", str(report))
    assert replayed.returncode == 0, replayed
    assert report.stat().st_size > 1e6
    exported = run(package, "export", str(record_drive(tmp_path, 12.0)), str(tmp_path / "served.mcap"))
    assert exported.returncode == 0, exported


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


MACHINE_CODES = {"arm64": 183, "amd64": 62}
"""e_machine of ELF files (System V ABI), at offset 18."""


def list_libraries(package: Path) -> list[Path]:
    """Return the shared libraries and extension modules of a package."""
    return [each for each in package.rglob("*.so*") if each.is_file() and (each.suffix == ".so" or ".so." in each.name)]


def list_outside(libraries: list[Path]) -> set[str]:
    """Return the names of the libraries that these need and are not among them."""
    lines = subprocess.run(["readelf", "-d", *libraries], capture_output=True, text=True, check=True).stdout
    needed = {line.partition("[")[2].rstrip("]") for line in lines.splitlines() if "(NEEDED)" in line}
    return needed - {each.name for each in libraries}


@pytest.mark.skipif(shutil.which("readelf") is None, reason="readelf is not installed (apt install binutils)")
def test_given_another_architecture_then_its_package_has_the_same_content_for_that_machine(
    package: Path, tmp_path: Path
) -> None:
    own = (package / "DEBIAN/control").read_text().partition("\nArchitecture: ")[2].split()[0]
    (other,) = set(MACHINE_CODES) - {own}
    try:
        built = build_package(tmp_path, "--arch", other)
    except AssertionError as error:
        # an index that cannot be reached, in pip's words
        if "Connection" in str(error) or "Temporary failure" in str(error):
            pytest.skip("the index of packages cannot be reached")
        raise
    assert built.name.endswith(f"_{other}.deb")
    root = tmp_path / "root"
    subprocess.run(["dpkg-deb", "-R", built, root], check=True, timeout=TIMEOUT_S)
    assert f"\nArchitecture: {other}\n" in (root / "DEBIAN/control").read_text()
    libraries = list_libraries(root)
    codes = {int.from_bytes(each.read_bytes()[18:20], "little") for each in libraries}
    assert codes == {MACHINE_CODES[other]}
    site = f"usr/lib/modelserver/lib/{PYTHON}/site-packages"
    names = [{each.name.replace("-", "_") for each in (folder / site).iterdir()} for folder in (package, root)]
    assert names[0] ^ names[1] <= {"__pycache__"}
    # nothing more of the system than the package for this machine, whose needs another test checks
    loaders = {"ld-linux-aarch64.so.1", "ld-linux-x86-64.so.2"}
    assert list_outside(libraries) - loaders <= list_outside(list_libraries(package)) - loaders


def test_given_an_environment_without_an_extra_then_the_build_names_what_is_missing(tmp_path: Path) -> None:
    code = f"""
import sys
sys.path.insert(0, {str(ROOT / "tools")!r})
import debian_package as build
def find(name):
    raise build.PackageNotFoundError(name)
build.distribution = find
build.list_needed({str(build_wheel(tmp_path))!r}, "x86_64")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "is not installed: make deb, or: pip install -e '" in done.stderr
