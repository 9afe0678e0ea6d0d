"""`modelserver spy`: lcm-spy with this project's types, so that it shows every message decoded."""

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
from mstools.asking import UrlOption
from mstools.lcm_wheel import MissingToolError, binary, java_library, type_files


def command(
    url: UrlOption = "",
    build_only: Annotated[
        bool, typer.Option("--build-only", help="Build the types for Java, print the jar's path, and end.")
    ] = False,
) -> None:
    """Watch the channels with lcm-spy, decoded. Double-click a channel to see its fields.

    Needs Java (default-jre), and at its first run a Java compiler (default-jdk-headless): the types are compiled
    once for each version of the wire contract and kept in the user's cache.

    Example: modelserver spy --url "udpm://239.255.76.67:7667?ttl=0"
    """
    if build_only:
        typer.echo(str(types_jar()))
        return
    check_java()
    jar = types_jar()
    environment = dict(os.environ)
    environment["CLASSPATH"] = os.pathsep.join(filter(None, (str(jar), environment.get("CLASSPATH", ""))))
    provider = url or environment.get("LCM_DEFAULT_URL", "") or DEFAULT_URL
    spy = binary("lcm-spy")
    sys.stdout.flush()
    # lcm-spy takes this process's place, so that signals reach it and its exit code is ours
    os.execve(spy, [str(spy), f"--lcm-url={provider}"], environment)


def check_java() -> None:
    """Raise MissingToolError where lcm-spy could not open its window."""
    java = shutil.which("java")
    if java is None:
        raise MissingToolError(
            "lcm-spy needs Java, which is missing: sudo apt install default-jre default-jdk-headless"
        )
    libraries = Path(java).resolve().parent.parent / "lib"
    if (libraries / "libjava.so").exists() and not (libraries / "libawt_xawt.so").exists():
        raise MissingToolError("lcm-spy opens a window, and this Java has no windows: sudo apt install default-jre")
    if not os.environ.get("DISPLAY"):
        raise MissingToolError(
            "lcm-spy opens a window, and there is no display (DISPLAY is empty). Over ssh use ssh -X, or watch from "
            "another machine on the same bus"
        )


def types_jar() -> Path:
    """Return the jar of the wire types, built when this version of them was not built before."""
    files = type_files()
    folder = cache_folder() / contract_hash(files)
    jar = folder / "mslcm.jar"
    if not jar.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        _build(files, jar)
    return jar


def cache_folder() -> Path:
    """Return the folder for what can be made again, in the user's cache."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if not cache.is_absolute():
        try:
            cache = Path.home() / ".cache"
        except RuntimeError:
            raise MissingToolError("there is no home directory to keep the types in; set XDG_CACHE_HOME") from None
    return cache / "modelserver"


def contract_hash(files: Sequence[Path]) -> str:
    """Return a name for these types as compiled against this version of lcm."""
    digest = hashlib.sha256(version("lcm").encode())
    for path in files:
        digest.update(b"\0%b\0%b" % (path.name.encode(), path.read_bytes()))
    return digest.hexdigest()[:16]


def _build(files: Sequence[Path], jar: Path) -> None:
    compiler = shutil.which("javac")
    if compiler is None:
        raise MissingToolError(
            "the types are not compiled yet, and the Java compiler is missing: sudo apt install default-jdk-headless"
        )
    typer.echo(f"compiling the types into {jar}", err=True)
    with tempfile.TemporaryDirectory(dir=jar.parent) as scratch:
        work = Path(scratch)
        _run([binary("lcm-gen"), "--java", "--jpath", work / "src", *files])
        sources = sorted((work / "src").rglob("*.java"))
        _run([compiler, "-nowarn", "-cp", java_library(), "-d", work / "classes", *sources])
        finished = work / jar.name
        with zipfile.ZipFile(finished, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted((work / "classes").rglob("*.class")):
                archive.write(path, path.relative_to(work / "classes"))
        # whole or not at all, also when two builds run at once or one is interrupted
        finished.replace(jar)


def _run(arguments: Sequence[str | Path]) -> None:
    done = subprocess.run(arguments, capture_output=True, text=True)
    if done.returncode:
        said = (done.stderr or done.stdout).strip().splitlines() or [f"exit code {done.returncode}"]
        raise MissingToolError(f"{Path(arguments[0]).name} failed: {said[0]}")
