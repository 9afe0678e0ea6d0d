#!/usr/bin/env python3
"""Build a Debian package of this source: `make deb`.

The package holds an environment of its own in /usr/lib/modelserver: ModelServer and the packages that it needs, in the
versions of the environment that runs this script, for the same Python of Debian. Left out is what only filterpy's other
filters and plots need, matplotlib and scipy, and the packages' own tests. Installing it starts nothing:
`modelserver install --vehicle FILE` does, and removing it stops what that started.
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
from importlib.metadata import Distribution, distribution
from pathlib import Path
from types import MappingProxyType
from typing import Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from mstools.cli import COMPLETION_VARIABLE

ROOT: Final = Path(__file__).resolve().parent.parent
PREFIX: Final = "usr/lib/modelserver"
PYTHON: Final = f"python{sys.version_info.major}.{sys.version_info.minor}"

NEEDED_OF: Final = {"filterpy": {"numpy"}}
"""For a package, those of its requirements that are needed: filterpy's KalmanFilter imports numpy only."""

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


def list_needed(wheel: Path) -> list[Distribution]:
    """Return the packages that the wheel needs at run time, as they are installed here."""
    found: dict[str, Distribution] = {}
    waiting, seen = read_requirements(wheel), set[str]()
    while waiting:
        wanted = waiting.pop()
        if str(wanted) in seen:
            continue
        seen.add(str(wanted))
        name = canonicalize_name(wanted.name)
        found[name] = distribution(name)
        for each in map(Requirement, found[name].requires or ()):
            if applies(each, wanted.extras) and canonicalize_name(each.name) in NEEDED_OF.get(
                name, {canonicalize_name(each.name)}
            ):
                waiting.append(each)
    return sorted(found.values(), key=lambda each: canonicalize_name(each.name))


def read_requirements(wheel: Path) -> list[Requirement]:
    """Return what a wheel needs without extras."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (each for each in archive.namelist() if each.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(archive.read(name))
    return [each for each in map(Requirement, metadata.get_all("Requires-Dist") or ()) if applies(each)]


def applies(requirement: Requirement, extras: Iterable[str] = ()) -> bool:
    """Return whether a requirement counts here, of a package with these extras."""
    marker = requirement.marker
    return marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *extras))


def copy_distribution(source: Distribution, site: Path) -> None:
    """Copy the files of an installed package, without its scripts, its tests and compiled Python."""
    for file in source.files or ():
        if file.parts[0] == ".." or file.suffix == ".pyc" or "tests" in file.parts[:-1]:
            continue
        target = site / file
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(str(file.locate()), target)


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this source in `folder`."""
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check", "--no-deps"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(ROOT)], check=True)
    (wheel,) = folder.glob("modelserver-*.whl")
    return wheel


def make_environment(folder: Path, wheel: Path) -> None:
    """Make the environment below `folder`, which is /usr/lib/modelserver on the vehicle."""
    site = folder / "lib" / PYTHON / "site-packages"
    for each in list_needed(wheel):
        copy_distribution(each, site)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
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


def build(output: Path, maintainer: str, wheel: Path | None = None, compression: str = "xz") -> Path:
    """Build the package in the folder `output`, of a wheel or of this source, and return its path."""
    with tempfile.TemporaryDirectory(prefix="modelserver-deb-") as scratch:
        root = Path(scratch, "root")
        environment = root / PREFIX
        environment.mkdir(parents=True)
        wheel = wheel or build_wheel(Path(scratch))
        version = wheel.name.split("-")[1]
        make_environment(environment, wheel)
        for folder in ("usr/bin", "usr/share/doc/modelserver", "usr/share/bash-completion/completions", "DEBIAN"):
            (root / folder).mkdir(parents=True)
        (root / "usr/bin/modelserver").symlink_to(f"/{PREFIX}/bin/modelserver")
        shutil.copyfile(ROOT / "LICENSE", root / "usr/share/doc/modelserver/copyright")
        shutil.copyfile(ROOT / "CHANGELOG.md", root / "usr/share/doc/modelserver/CHANGELOG.md")
        command = (sys.executable, "-c", "from mstools.cli import main; main()")
        script = read_output(*command, environment={COMPLETION_VARIABLE: "source_bash"})
        (root / "usr/share/bash-completion/completions/modelserver").write_text(f"{script}\n")
        size = sum(path.lstat().st_size for path in root.rglob("*"))
        architecture = read_output("dpkg", "--print-architecture")
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
        subprocess.run(
            ["dpkg-deb", "--root-owner-group", f"-Z{compression}", "--build", str(root), str(package)], check=True
        )
        return package


def main() -> int:
    """Build the package, and print its path and size."""
    parser = argparse.ArgumentParser(description="Build a Debian package of this source.")
    parser.add_argument("--output", type=Path, default=ROOT / "build", help="folder of the package (default: build)")
    parser.add_argument("--maintainer", default="The ModelServer developers <root@localhost>", help="name and address")
    parser.add_argument("--wheel", type=Path, help="wheel of ModelServer (default: built from this source)")
    parser.add_argument("--compression", default="xz", help="of dpkg-deb: xz (default), zstd, gzip, none")
    arguments = parser.parse_args()
    if shutil.which("dpkg-deb") is None:
        print("dpkg-deb is missing: sudo apt install dpkg", file=sys.stderr)
        return 2
    package = build(arguments.output, arguments.maintainer, arguments.wheel, arguments.compression)
    print(f"{package}: {package.stat().st_size / 1e6:.1f} MB; install it: sudo apt install {package}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
