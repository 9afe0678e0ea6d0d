"""`modelserver status --spy`: the jar is built once and whole; what is missing is named with what to do."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support_lcm import MODELSERVER

from modelserver.wire.channels import DEFAULT_URL
from mstools.cli import main
from mstools.commands import status
from mstools.commands.status import MissingToolError, find_type_files

BUILD = "from mstools.commands.status import get_types_jar; print(get_types_jar())"

needs_javac = pytest.mark.skipif(shutil.which("javac") is None, reason="no Java compiler (default-jdk-headless)")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "modelserver"


@pytest.fixture
def only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is all of PATH: programs are there when a test puts them in."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    return folder


def _program(path: Path, text: str = "exit 0") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def _failure(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main(["status", "--spy", *arguments])
    assert ended.value.code == 1
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def built_jar(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Build the jar in a process of its own, once; return the empty cache that it began with and its output."""
    folder = tmp_path_factory.mktemp("cache")
    done = subprocess.run(
        [sys.executable, "-c", BUILD],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "XDG_CACHE_HOME": str(folder)},
    )
    assert done.returncode == 0, done.stderr
    return folder / "modelserver", done.stdout


@pytest.mark.slow
@needs_javac
def test_given_an_empty_cache_when_built_then_the_jar_holds_every_type_and_is_retained(
    built_jar: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    cache, out = built_jar
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache.parent))
    jar = Path(out.strip())
    assert jar.is_relative_to(cache)
    with zipfile.ZipFile(jar) as archive:
        classes = {name for name in archive.namelist() if "$" not in name}
    assert classes == {f"mslcm/{path.stem}.class" for path in find_type_files()}
    assert [path.name for path in jar.parent.iterdir()] == ["mslcm.jar"]
    built = jar.stat().st_mtime_ns
    assert status.get_types_jar() == jar
    assert jar.stat().st_mtime_ns == built


def test_given_a_retained_jar_when_there_is_no_compiler_then_it_is_used(cache: Path, only: Path) -> None:
    jar = cache / status.hash_contract(find_type_files()) / "mslcm.jar"
    jar.parent.mkdir(parents=True)
    jar.write_bytes(b"")
    assert status.get_types_jar() == jar


def test_given_no_compiler_when_built_then_it_reports_what_to_install(cache: Path, only: Path) -> None:
    with pytest.raises(MissingToolError, match="sudo apt install default-jdk-headless"):
        status.get_types_jar()


def test_given_a_compiler_that_fails_when_built_then_it_reports_it_and_leaves_nothing(cache: Path, only: Path) -> None:
    _program(only / "javac", "echo 'error: out of luck' >&2; exit 1")
    with pytest.raises(MissingToolError, match="javac failed: error: out of luck"):
        status.get_types_jar()
    assert [path for path in cache.rglob("*") if path.is_file()] == []


def test_given_no_java_when_run_then_it_reports_what_to_install(
    cache: Path, only: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "sudo apt install default-jre default-jdk-headless" in _failure(capsys)


def test_given_no_display_when_run_then_it_reports_it(
    only: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    _program(only / "java")
    assert "DISPLAY is empty" in _failure(capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "default", "expected"),
    [
        ((), "", DEFAULT_URL),
        ((), "udpm://239.255.76.67:7000?ttl=0", "udpm://239.255.76.67:7000?ttl=0"),
        (("--url", "udpm://239.255.76.67:7001?ttl=0"), "udpm://x", "udpm://239.255.76.67:7001?ttl=0"),
    ],
)
def test_given_all_it_needs_when_run_then_lcm_spy_takes_its_place_with_jar_and_url(
    cache: Path,
    only: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    default: str,
    expected: str,
) -> None:
    jar = cache / status.hash_contract(find_type_files()) / "mslcm.jar"
    jar.parent.mkdir(parents=True)
    jar.write_bytes(b"")
    # stands for java: what lcm-spy, which is a shell script, starts in the end
    _program(only / "java", 'echo "$CLASSPATH"; for word; do last="$word"; done; echo "$last"; exit 7')
    for tool in ("dirname", "sh"):
        (only / tool).symlink_to(shutil.which(tool, path=os.defpath) or tool)
    monkeypatch.setenv("DISPLAY", ":1")
    monkeypatch.setenv("CLASSPATH", "/mine.jar")
    monkeypatch.setenv("LCM_DEFAULT_URL", default)
    done = subprocess.run([*MODELSERVER, "status", "--spy", *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 7, done.stderr
    assert done.stdout.splitlines() == [f"{jar}{os.pathsep}/mine.jar", f"--lcm-url={expected}"]
