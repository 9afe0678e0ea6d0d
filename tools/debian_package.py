#!/usr/bin/env python3
"""Build a Debian package of this source: `make deb`.

The package holds an environment of its own in /usr/lib/modelserver: ModelServer and the packages that it needs, in the
versions of the environment that runs this script, for the same Python of Debian, with the extras of `PACKAGED_EXTRAS`.
Pure Python is copied from that environment; for another architecture compiled packages are downloaded as wheels of the
same version. Left out is what only filterpy's other filters and plots need, matplotlib and scipy, plotly's Python, of
which reports use only the script, the extras dynamics (380 MB), archive and map (110 MB), and the packages' own tests.
Installing it starts nothing: `modelserver install --vehicle FILE` does, and removing it stops what that started.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Mapping
from email import message_from_bytes
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from modelserver.extras import DEBIAN_INSTALLER
from mstools.cli import COMPLETION_VARIABLE

ROOT: Final = Path(__file__).resolve().parent.parent
PREFIX: Final = "usr/lib/modelserver"
PYTHON: Final = f"python{sys.version_info.major}.{sys.version_info.minor}"

PACKAGED_EXTRAS: Final = ("bags", "foxglove", "report", "view")
"""Extras whose packages are in the Debian package."""

NEEDED_OF: Final[dict[str, set[str]]] = {"filterpy": {"numpy"}, "plotly": set()}
"""For a package, those of its requirements that are needed: filterpy's KalmanFilter imports numpy only."""

NEEDED_FILES: Final = {"plotly": {"plotly.min.js"}}
"""For a package, those of its files that are needed, besides its metadata: reports contain plotly's script."""

MACHINES: Final = {"amd64": "x86_64", "arm64": "aarch64"}
"""Names of Python's platforms (PEP 600) by those of Debian's architectures."""

OLDEST_GLIBC: Final = 17
"""Minor version of glibc 2 of the oldest manylinux wheels for both architectures (manylinux2014)."""

XZ_OPTIONS: Final = ("-z3",)
"""Level of xz: 67 MB in 22 s on two cores, where the default level needs 55 s for 60 MB."""

LIBRARIES: Final = "libglib2.0-0 | libglib2.0-0t64, libstdc++6, zlib1g"
"""Debian's packages of the shared libraries that the wheels leave to the system: liblcm's GLib, C++, zlib."""

CONTROL: Final = """\
Package: modelserver
Version: {version}
Architecture: {architecture}
Maintainer: {maintainer}
Installed-Size: {kilobytes}
Depends: {python}, {libraries}
Recommends: iproute2, udev
Section: misc
Priority: optional
Description: Vehicle geometry and localization as a service on LCM
 Where is A relative to B, now or at time t, and how certain is that? One service
 answers this for every program on an unmanned vehicle without ROS.
 .
 Installing this package starts nothing: modelserver install --vehicle FILE does.
"""

POSTINST: Final = f"""\
#!/bin/sh
set -e
if [ "$1" = configure ]; then
  # the units may not write here
  /{PREFIX}/bin/python -m compileall -q -j 0 /{PREFIX}/lib || true
fi
"""

PRERM: Final = f"""\
#!/bin/sh
set -e
# the units would start a program that is gone; edited files and the state stay
if [ "$1" = remove ] && [ -f /etc/modelserver/installed.json ]; then
  /{PREFIX}/bin/modelserver install --remove
fi
find /{PREFIX}/lib -name __pycache__ -type d -prune -exec rm -rf {{}} +
"""

COMMAND: Final = f"""\
#!/{PREFIX}/bin/python
import sys

from mstools.cli import main

sys.exit(main())
"""


def list_needed(wheel: Path, machine: str) -> list[Distribution]:
    """Return the packages that the wheel needs at run time on a machine, in the versions that are installed here."""
    found: dict[str, Distribution] = {}
    waiting, seen = read_requirements(wheel, machine), set[str]()
    while waiting:
        wanted = waiting.pop()
        if str(wanted) in seen:
            continue
        seen.add(str(wanted))
        name = canonicalize_name(wanted.name)
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            extras = ",".join(PACKAGED_EXTRAS)
            raise SystemExit(f"{name} is not installed: make deb, or: pip install -e '{ROOT}[{extras}]'") from None
        for each in map(Requirement, found[name].requires or ()):
            if applies(each, machine, wanted.extras) and canonicalize_name(each.name) in NEEDED_OF.get(
                name, {canonicalize_name(each.name)}
            ):
                waiting.append(each)
    return sorted(found.values(), key=lambda each: canonicalize_name(each.name))


def read_requirements(wheel: Path, machine: str) -> list[Requirement]:
    """Return what a wheel needs with the extras that the package has."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(archive.read(name))
    wanted = map(Requirement, metadata.get_all("Requires-Dist") or ())
    return [each for each in wanted if applies(each, machine, PACKAGED_EXTRAS)]


def applies(requirement: Requirement, machine: str, extras: Iterable[str] = ()) -> bool:
    """Return whether a requirement counts on a machine, of a package with these extras."""
    marker = requirement.marker
    return marker is None or any(
        marker.evaluate({"extra": extra, "platform_machine": machine}) for extra in ("", *extras)
    )


def is_pure(package: Distribution) -> bool:
    """Return whether an installed package is the same on every machine: it was a wheel for any."""
    return "-none-any" in (package.read_text("WHEEL") or "")


def is_needed(package: str, file: PurePath) -> bool:
    """Return whether a file of a package is needed: no script, no test, no compiled Python."""
    if file.parts[0] == ".." or file.suffix == ".pyc" or "tests" in file.parts[:-1]:
        return False
    needed = NEEDED_FILES.get(canonicalize_name(package))
    return needed is None or file.name in needed or file.parts[0].endswith(".dist-info")


def copy_distribution(source: Distribution, site: Path) -> None:
    """Copy the files of an installed package, without its scripts, its tests and compiled Python."""
    for file in source.files or ():
        if not is_needed(source.name, file):
            continue
        target = site / file
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(str(file.locate()), target)


def download_wheels(packages: Iterable[Distribution], machine: str, folder: Path) -> list[Path]:
    """Download the wheels of installed versions for another machine with this one's glibc. Raises SystemExit."""
    newest = int(platform.libc_ver()[1].split(".")[1])
    platforms = [f"--platform=manylinux_2_{minor}_{machine}" for minor in range(newest, OLDEST_GLIBC - 1, -1)]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    command += ["--only-binary=:all:", f"--python-version={platform.python_version()}", *platforms]
    command += [f"--platform=manylinux2014_{machine}", f"--dest={folder}"]
    done = subprocess.run([*command, *(f"{each.name}=={each.version}" for each in packages)], check=False)
    if done.returncode:
        raise SystemExit(f"a wheel for {machine} is missing, see above: build the package on the vehicle's machine")
    return sorted(folder.glob("*.whl"))


def unpack_wheel(wheel: Path, site: Path) -> None:
    """Unpack the modules of a wheel, as `copy_distribution` copies those of an installed package."""
    with zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            file = PurePath(name)
            if file.parts[0].endswith(".data"):
                # of headers, scripts and modules, only the latter
                if file.parts[1] not in ("purelib", "platlib"):
                    continue
                file = PurePath(*file.parts[2:])
            if name.endswith("/") or not is_needed(wheel.name.split("-")[0], file):
                continue
            (site / file).parent.mkdir(parents=True, exist_ok=True)
            (site / file).write_bytes(archive.read(name))


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this source in `folder`."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(ROOT)], check=True)
    (wheel,) = folder.glob("modelserver-*.whl")
    return wheel


def make_environment(folder: Path, wheel: Path, machine: str) -> None:
    """Make the environment below `folder`, which is /usr/lib/modelserver on the vehicle."""
    site = folder / "lib" / PYTHON / "site-packages"
    needed = list_needed(wheel, machine)
    foreign = [] if machine == platform.machine() else [each for each in needed if not is_pure(each)]
    for each in needed:
        if each not in foreign:
            copy_distribution(each, site)
    with tempfile.TemporaryDirectory(prefix="modelserver-wheels-") as downloads:
        for path in download_wheels(foreign, machine, Path(downloads)) if foreign else ():
            unpack_wheel(path, site)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (metadata,) = site.glob("modelserver-*.dist-info")
    (metadata / "INSTALLER").write_text(f"{DEBIAN_INSTALLER}\n")
    (folder / "bin").mkdir()
    (folder / "bin" / "python").symlink_to(f"/usr/bin/{PYTHON}")
    version = platform.python_version()
    (folder / "pyvenv.cfg").write_text(f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {version}\n")
    write_script(folder / "bin" / "modelserver", COMMAND)


def read_output(*command: str, environment: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the standard output of a program, which gets more variables in its environment."""
    done = subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, **environment})
    return done.stdout.strip()


def write_script(path: Path, text: str) -> None:
    path.write_text(text)
    path.chmod(0o755)


def build(output: Path, maintainer: str, wheel: Path | None, compression: str, architecture: str) -> Path:
    """Build the package in the folder `output`, of a wheel or of this source, and return its path."""
    with tempfile.TemporaryDirectory(prefix="modelserver-deb-") as scratch:
        root = Path(scratch, "root")
        environment = root / PREFIX
        environment.mkdir(parents=True)
        wheel = wheel or build_wheel(Path(scratch))
        version = wheel.name.split("-")[1]
        make_environment(environment, wheel, MACHINES[architecture])
        for folder in ("usr/bin", "usr/share/doc/modelserver", "usr/share/bash-completion/completions", "DEBIAN"):
            (root / folder).mkdir(parents=True)
        (root / "usr/bin/modelserver").symlink_to(f"/{PREFIX}/bin/modelserver")
        shutil.copyfile(ROOT / "LICENSE", root / "usr/share/doc/modelserver/copyright")
        shutil.copyfile(ROOT / "CHANGELOG.md", root / "usr/share/doc/modelserver/CHANGELOG.md")
        command = (sys.executable, "-c", "from mstools.cli import main; main()")
        script = read_output(*command, environment={COMPLETION_VARIABLE: "source_bash"})
        (root / "usr/share/bash-completion/completions/modelserver").write_text(f"{script}\n")
        size = sum(path.lstat().st_size for path in root.rglob("*"))
        control = CONTROL.format(
            version=version,
            architecture=architecture,
            maintainer=maintainer,
            kilobytes=size // 1024,
            python=PYTHON,
            libraries=LIBRARIES,
        )
        (root / "DEBIAN/control").write_text(control)
        write_script(root / "DEBIAN/postinst", POSTINST)
        write_script(root / "DEBIAN/prerm", PRERM)
        # readable by all, whatever the umask of who builds
        for path in root.rglob("*"):
            if not path.is_symlink():
                path.chmod(0o755 if path.is_dir() or os.access(path, os.X_OK) else 0o644)
        output.mkdir(parents=True, exist_ok=True)
        package = output / f"modelserver_{version}_{architecture}.deb"
        options = [f"-Z{compression}", *XZ_OPTIONS] if compression == "xz" else [f"-Z{compression}"]
        subprocess.run(["dpkg-deb", "--root-owner-group", *options, "--build", str(root), str(package)], check=True)
        return package


def main() -> int:
    """Build the package, and print its path and size."""
    parser = argparse.ArgumentParser(description="Build a Debian package of this source.")
    parser.add_argument("--output", type=Path, default=ROOT / "build", help="folder of the package (default: build)")
    parser.add_argument("--maintainer", default="The ModelServer developers <root@localhost>", help="name and address")
    parser.add_argument("--wheel", type=Path, help="wheel of ModelServer (default: built from this source)")
    parser.add_argument("--compression", default="xz", help="of dpkg-deb: xz (default), zstd, gzip, none")
    own = next((name for name, machine in MACHINES.items() if machine == platform.machine()), None)
    parser.add_argument("--arch", choices=MACHINES, default=own, help="architecture (default: this machine's)")
    arguments = parser.parse_args()
    if arguments.arch is None:
        parser.error(f"there is no package for {platform.machine()}, only for {', '.join(MACHINES)}")
    if shutil.which("dpkg-deb") is None:
        print("dpkg-deb is missing: sudo apt install dpkg", file=sys.stderr)
        return 2
    package = build(arguments.output, arguments.maintainer, arguments.wheel, arguments.compression, arguments.arch)
    print(f"{package}: {package.stat().st_size / 1e6:.1f} MB; install it: sudo apt install {package}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
