"""`modelserver spy`: all channels decoded, in lcm-spy with this project's types."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from modelserver.wire.channels import DEFAULT_URL
from mstools.lcm_wheel import MissingToolError, find_binary, find_java_library, find_type_files
from mstools.terminal.options import UrlOption, option


def command(
    config: Annotated[Path | None, option("--config -c FILE", "The vehicle file, for its bus.")] = None,
    url: UrlOption = "",
    build_only: Annotated[
        bool, option("--build-only", "Compile the types for Java, print the jar's path, and exit.")
    ] = False,
) -> None:
    """Show all channels decoded, in lcm-spy with this project's types; double-click a channel to see its fields.

    It needs a display and Java (default-jre), and at the first run a Java compiler (default-jdk-headless): the types
    are compiled once for each version of the wire contract, and stored in the user's cache. In a terminal,
    `modelserver status --watch` shows the channels of the service.

    Example: modelserver spy -c vehicle.yaml
    """
    if build_only:
        typer.echo(str(get_types_jar()))
        return
    if config is not None and not url:
        from modelserver.config.vehicle_file import load_config

        url = load_config(config).lcm.url
    check_java()
    jar = get_types_jar()
    spy = find_binary("lcm-spy")
    environment = dict(os.environ)
    environment["CLASSPATH"] = os.pathsep.join(filter(None, (str(jar), environment.get("CLASSPATH", ""))))
    provider = url or environment.get("LCM_DEFAULT_URL", "") or DEFAULT_URL
    sys.stdout.flush()
    # exec, so that signals reach lcm-spy and its exit code is ours
    os.execve(spy, [str(spy), f"--lcm-url={provider}"], environment)


def check_java() -> None:
    """Raise MissingToolError if lcm-spy cannot open its window."""
    java = shutil.which("java")
    libraries = Path(java or "").resolve().parent.parent / "lib"
    wrong = ""
    if java is None:
        wrong = "needs Java, which is missing: sudo apt install default-jre default-jdk-headless"
    elif (libraries / "libjava.so").exists() and not (libraries / "libawt_xawt.so").exists():
        wrong = "opens a window, but this Java is headless: sudo apt install default-jre"
    elif not os.environ.get("DISPLAY"):
        ways = "Over ssh use ssh -X, or modelserver status --watch"
        wrong = f"opens a window, but there is no display (DISPLAY is empty). {ways}"
    if wrong:
        raise MissingToolError(f"lcm-spy {wrong}")


def get_types_jar() -> Path:
    """Return the jar of the wire types, compiled once for each version of them."""
    files = find_type_files()
    folder = get_cache_folder() / hash_contract(files)
    jar = folder / "mslcm.jar"
    if not jar.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _build_jar(files, jar)
    return jar


def get_cache_folder() -> Path:
    """Return this program's folder in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():
        try:
            cache = Path.home() / ".cache"
        except RuntimeError:
            raise MissingToolError("no home directory for the compiled types; set XDG_CACHE_HOME") from None
    return cache / "modelserver"


def hash_contract(files: Sequence[Path]) -> str:
    """Return a hash of these types and of the version of lcm."""
    digest = hashlib.sha256(version("lcm").encode())
    for path in files:
        digest.update(b"\0%b\0%b" % (path.name.encode(), path.read_bytes()))
    return digest.hexdigest()[:16]


def _build_jar(files: Sequence[Path], jar: Path) -> None:
    compiler = shutil.which("javac")
    if compiler is None:
        raise MissingToolError(
            "the types are not compiled yet, and the Java compiler is missing: sudo apt install default-jdk-headless"
        )
    typer.echo(f"compiling the types into {jar}", err=True)
    with tempfile.TemporaryDirectory(dir=jar.parent) as scratch:
        work = Path(scratch)
        _run([find_binary("lcm-gen"), "--java", "--jpath", work / "src", *files])
        sources = sorted((work / "src").rglob("*.java"))
        _run([compiler, "-nowarn", "-cp", find_java_library(), "-d", work / "classes", *sources])
        finished = work / jar.name
        with zipfile.ZipFile(finished, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted((work / "classes").rglob("*.class")):
                archive.write(path, path.relative_to(work / "classes"))
        # atomic, also for two builds at once or an interrupted one
        finished.replace(jar)


def _run(arguments: Sequence[str | Path]) -> None:
    done = subprocess.run(arguments, capture_output=True, text=True)
    if done.returncode:
        output = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise MissingToolError(f"{Path(arguments[0]).name} failed: {output[0]}")
