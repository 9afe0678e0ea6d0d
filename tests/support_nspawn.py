"""A machine with a real systemd for tests: this host's /usr booted in a container, with this project's package.

Nothing of the host is written: the container's root is a tmpfs of its own (`--volatile`), its network a loopback of its
own, and all of it goes with its processes. What a test puts there comes through one folder.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BOOT_S = 20.0
HIDDEN = ("/root", "/home", "/tmp", "/var/tmp", "/run")
"""Where a hardened unit does not see what is installed (ProtectHome, PrivateTmp)."""

PREFIX = "/usr/lib/modelserver"
SHARED = "/opt/shared"
"""In the container: the environment of the Debian package, the test's folder."""

CGROUPS = (Path("/sys/fs/cgroup/unified"), Path("/sys/fs/cgroup/systemd"), Path("/sys/fs/cgroup"))


def interpreter() -> str:
    """Return a Python of this version that a hardened unit may see, empty where there is none."""
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    own = os.path.join(sys.base_prefix, "bin", version)
    for candidate in (own, f"/usr/bin/{version}"):
        path = os.path.realpath(candidate)
        if os.access(path, os.X_OK) and path.startswith("/usr/") and not path.startswith(HIDDEN):
            return path
    return ""


@cache
def skip_reason() -> str:
    """Return why no container can be booted here, empty where one can."""
    if sys.platform != "linux":
        return "systemd is Linux's"
    if os.geteuid() != 0:
        return "systemd-nspawn needs root"
    for program in ("systemd-nspawn", "systemd-analyze", "nsenter", "unshare", "ip", "dpkg-deb"):
        if shutil.which(program) is None:
            return f"{program} is not installed (apt install systemd-container iproute2 dpkg)"
    if not os.path.exists("/lib/systemd/systemd"):
        return "systemd is not installed"
    if os.path.realpath("/lib") != "/usr/lib":
        return "this system has /lib beside /usr, and the container takes all from /usr"
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    if not interpreter():
        return f"no {version} below /usr: the tests' own is in {sys.base_prefix}, which a hardened unit does not see"
    if find_spec("hatchling") is None:
        return "hatchling, which builds the wheel, is not installed (pip install -e '.[test]')"
    tried = subprocess.run(["unshare", "--mount", "--pid", "--net", "--fork", "true"], capture_output=True, text=True)
    if tried.returncode:
        return f"this machine makes no namespaces: {tried.stderr.strip()}"
    return ""


@dataclass
class Machine:
    """A booted container. `leader` is its first process as the host counts."""

    leader: int
    folder: Path
    console: Path

    def run(self, *command: str, check: bool = True, timeout: float = 30.0) -> subprocess.CompletedProcess[str]:
        """Run a command in the container."""
        done = subprocess.run(
            self.command_line(*command), capture_output=True, text=True, timeout=timeout, env=ENVIRONMENT, check=False
        )
        assert not check or done.returncode == 0, f"{command}: {done.stdout}\n{done.stderr}"
        return done

    def command_line(self, *command: str) -> list[str]:
        """Return the arguments that run a command in the container."""
        return ["nsenter", f"--target={self.leader}", "--all", *command]

    def systemctl(self, *arguments: str, check: bool = True) -> str:
        return self.run("systemctl", "--no-pager", *arguments, check=check).stdout.strip()

    def get_property(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.systemctl("show", "--value", f"--property={name}", unit)

    def journal(self, unit: str, *arguments: str) -> str:
        return self.run("journalctl", "--no-pager", "-u", unit, *arguments).stdout


ENVIRONMENT = {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8"}


def build_wheel(folder: Path) -> Path:
    """Return a wheel of this project, built from its source."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel


@contextmanager
def boot_machine(folder: Path) -> Iterator[Machine]:
    """Boot a container that sees `folder` as SHARED; it ends with the block."""
    name = f"modelserver-test-{os.getpid()}"
    console = folder / "console.log"
    booted_by_systemd = os.path.isdir("/run/systemd/system")
    arguments = [
        *("systemd-nspawn", "--quiet", "--directory=/", "--volatile=yes", "--private-network", "--register=no"),
        *(() if booted_by_systemd else ("--keep-unit",)),
        *("--boot", f"--machine={name}", "--console=read-only", f"--bind={folder}:{SHARED}"),
        # a Debian package can be installed: /usr is the host's, with what is written over it
        "--overlay=/usr::/usr",
        *("systemd.unit=basic.target", "systemd.firstboot=off", "systemd.show_status=no"),
    ]
    groups = [] if booted_by_systemd else _own_groups(name)
    # of its own: nspawn makes the container's groups below the one that it runs in
    joined = "".join(f"echo $$ > {group}/cgroup.procs; " for group in groups)
    with console.open("wb") as output:
        process = subprocess.Popen(
            ["sh", "-c", f'{joined}exec "$@"', "sh", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=ENVIRONMENT,
        )
        leader = 0
        try:
            leader = _leader(process, console)
            booted = Machine(leader, folder, console)
            _wait_for_boot(booted)
            yield booted
        finally:
            # the container's first process takes all others with it, and its mounts with them
            if leader:
                with suppress(ProcessLookupError):
                    os.kill(leader, signal.SIGKILL)
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            for group in groups:
                _remove_groups(group)
            with suppress(OSError):
                os.rmdir(f"/run/systemd/nspawn/propagate/{name}")


def _leader(process: subprocess.Popen[bytes], console: Path) -> int:
    """Return the container's first process: the child of nspawn that runs systemd."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    deadline = time.monotonic() + BOOT_S
    while time.monotonic() < deadline:
        assert process.poll() is None, console.read_text(errors="replace")
        for child in children.read_text().split():
            with suppress(OSError):
                if os.readlink(f"/proc/{child}/exe").endswith("/systemd"):
                    return int(child)
        time.sleep(0.02)
    raise AssertionError(f"the container did not start: {console.read_text(errors='replace')}")


def _wait_for_boot(booted: Machine) -> None:
    deadline = time.monotonic() + BOOT_S
    state = ""
    while time.monotonic() < deadline:
        state = booted.run("systemctl", "is-system-running", check=False).stdout.strip()
        if state in ("running", "degraded"):
            return
        time.sleep(0.05)
    raise AssertionError(f"the container's systemd is {state!r}: {booted.console.read_text(errors='replace')}")


def _own_groups(name: str) -> list[Path]:
    made = []
    for root in CGROUPS:
        if (root / "cgroup.procs").exists():
            group = root / name
            group.mkdir(exist_ok=True)
            made.append(group)
    return made


def _remove_groups(group: Path) -> None:
    for folder, _, _ in os.walk(group, topdown=False):
        for _ in range(50):
            with suppress(OSError):
                os.rmdir(folder)
                break
            time.sleep(0.02)


def build_package(folder: Path, *options: str) -> Path:
    """Return a Debian package of this project for the Python of these tests, built from its source."""
    command = [
        sys.executable,
        ROOT / "tools" / "debian_package.py",
        "--compression",
        "none",
        "--output",
        folder,
        *options,
    ]
    wheel = build_wheel(folder)
    done = subprocess.run([*command, "--wheel", wheel], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    (package,) = folder.glob("modelserver_*.deb")
    return package


def install_package(booted: Machine, package: Path) -> str:
    """Install a Debian package in the container, beside those of the host; return the path of its command."""
    database = "/var/lib/dpkg"
    booted.run("mkdir", "-p", *(f"{database}/{each}" for each in ("info", "updates", "triggers")))
    shutil.copy(f"{database}/status", booted.folder / "status")
    booted.run("cp", f"{SHARED}/status", f"{database}/status")
    booted.run("dpkg", "--install", f"{SHARED}/{package.name}", timeout=120.0)
    return "/usr/bin/modelserver"
