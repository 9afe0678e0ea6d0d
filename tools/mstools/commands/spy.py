"""`modelserver spy`: every channel decoded, in lcm-spy with this project's types or in the terminal."""

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
from mstools.commands.asking import UrlOption
from mstools.spy.lcm_wheel import MissingToolError, binary, java_library, type_files


def command(
    terminal: Annotated[
        bool, typer.Option("--terminal", "-t", help="A table in the terminal, also where there is a screen.")
    ] = False,
    window: Annotated[
        bool, typer.Option("--window", help="lcm-spy's window, and an error where it cannot be opened.")
    ] = False,
    channel: Annotated[
        str, typer.Option("--channel", metavar="NAME", help="In the terminal: show this channel's fields.")
    ] = "",
    once: Annotated[bool, typer.Option("--once", help="In the terminal: listen for 2 s, print, and end.")] = False,
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="N", min=0.0, max=86400.0, help="The same, for so many seconds.")
    ] = 0.0,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", metavar="FILE", help="The vehicle file, for its bus.")
    ] = None,
    url: UrlOption = "",
    build_only: Annotated[
        bool, typer.Option("--build-only", help="Build the types for Java, print the jar's path, and end.")
    ] = False,
) -> None:
    """Watch the channels, decoded.

    With a screen and Java this starts lcm-spy; double-click a channel there to see its fields. Its first run needs a
    Java compiler (default-jdk-headless) too: the types are compiled once for each version of the wire contract and kept
    in the user's cache.

    Without, as over ssh, or with --terminal, it is a table in the terminal: every channel that is heard with its type,
    rate, jitter, size and age; bad counts damaged messages. Up and down choose a channel, enter shows the fields of its
    last message, q ends. Where the output is no terminal, the table is printed once.

    \b
    Examples:
      modelserver spy
      modelserver spy --terminal --channel POSE
      modelserver spy --once --channel MODELSERVER_HEALTH
    """
    if build_only:
        typer.echo(str(types_jar()))
        return
    plain = terminal or bool(channel) or once or bool(seconds)
    if window and plain:
        raise typer.BadParameter(
            "lcm-spy knows none of --terminal, --channel, --once and --seconds", param_hint="--window"
        )
    if config is not None and not url:
        from modelserver.config import load_config

        url = load_config(config).lcm.url
    if not plain:
        start_window(url, window)
    from modelserver.wire.provider import open_lcm, resolve_url
    from mstools.spy.terminal import LISTEN_S, show

    show(open_lcm(resolve_url(url)), channel, seconds or (LISTEN_S if once else 0.0))


def start_window(url: str, is_wanted: bool) -> None:
    """Make this process lcm-spy. Return where it cannot be, and say why, unless there is no screen at all.

    Raises MissingToolError instead where it is wanted all the same.
    """
    if not (is_wanted or os.environ.get("DISPLAY")):
        return
    try:
        check_java()
        jar = types_jar()
        spy = binary("lcm-spy")
    except MissingToolError as error:
        if is_wanted:
            raise
        typer.echo(f"modelserver: {error}. Until then, in the terminal:", err=True)
        return
    environment = dict(os.environ)
    environment["CLASSPATH"] = os.pathsep.join(filter(None, (str(jar), environment.get("CLASSPATH", ""))))
    provider = url or environment.get("LCM_DEFAULT_URL", "") or DEFAULT_URL
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
            "lcm-spy opens a window, and there is no display (DISPLAY is empty). Over ssh use ssh -X, or "
            "modelserver spy --terminal"
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
