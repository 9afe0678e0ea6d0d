"""The command that adds an extra fits how ModelServer was installed; nothing advises a package index that has none."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

from modelserver import extras
from modelserver.extras import describe_missing, make_install_command, make_requirement, make_system_command
from mstools.commands import status

ROOT = Path(__file__).parents[2]
Install = Callable[..., None]


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Install:
    """Return a function that makes this an installation with the given metadata, in an environment of its own."""
    folder = tmp_path / "a venv" / "bin"
    folder.mkdir(parents=True)
    (folder / "pip").touch()
    monkeypatch.setattr(extras.sys, "executable", str(folder / "python"))

    def make(installer: str, url: object = None) -> None:
        class Installed:
            def read_text(self, name: str) -> str | None:
                return {"INSTALLER": f"{installer}\n", "direct_url.json": None if url is None else json.dumps(url)}[
                    name
                ]

        monkeypatch.setattr(extras, "distribution", lambda name: Installed())

    return make


@pytest.mark.parametrize(
    ("url", "requirement"),
    [
        ({"url": "file:///srv/my%20clone", "dir_info": {}}, "/srv/my clone[view]"),
        ({"url": "file:///srv/clone", "dir_info": {"editable": True}}, "-e /srv/clone[view]"),
        (
            {"url": "file:///x/modelserver-0.1.0-py3-none-any.whl", "archive_info": {}},
            "/x/modelserver-0.1.0-py3-none-any.whl[view]",
        ),
        ({"url": "https://a.example/m.whl", "archive_info": {}}, "modelserver[view] @ https://a.example/m.whl"),
        (
            {"url": "https://a.example/m", "vcs_info": {"vcs": "git", "commit_id": "1f"}},
            "modelserver[view] @ git+https://a.example/m@1f",
        ),
        (None, f"{ROOT}[view]"),
        ([], f"{ROOT}[view]"),
    ],
)
def test_given_a_pip_installation_then_its_own_pip_installs_the_same_source_with_the_extra(
    install: Install, url: object, requirement: str
) -> None:
    install("pip", url)
    pip, *words = shlex.split(make_install_command("view"))
    assert pip == f"{Path(extras.sys.executable).parent}/pip"
    assert words[0] == "install"
    flag = words[1:-1]
    assert " ".join([*flag, words[-1]]) == requirement


def test_given_an_environment_without_pip_then_its_installer_is_named(install: Install) -> None:
    install("uv", {"url": "file:///srv/clone", "dir_info": {}})
    assert shlex.split(make_install_command("report")) == [
        *("uv", "pip", "install", "--python", extras.sys.executable, "/srv/clone[report]")
    ]
    Path(extras.sys.executable).with_name("pip").unlink()
    install("pip", {"url": "file:///srv/clone", "dir_info": {}})
    assert shlex.split(make_install_command("report"))[:4] == [extras.sys.executable, "-m", "pip", "install"]


def test_given_an_environment_of_root_then_the_command_has_sudo(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("pip", {"url": "file:///srv/clone", "dir_info": {}})
    monkeypatch.setattr(extras.os, "access", lambda *_: False)
    assert make_install_command("report").startswith("sudo ")


def test_given_the_debian_package_then_its_missing_pip_is_not_used(install: Install) -> None:
    install("dpkg")
    command = make_install_command("dynamics")
    assert command.startswith("the Debian package does not have the extra dynamics; in a folder with the source: ")
    assert command.endswith(make_system_command(".[dynamics]"))


def test_given_the_debian_package_then_lcms_programs_have_advice_without_its_pip(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(status, "read_installation", lambda: ("dpkg", {}))
    monkeypatch.setattr(status, "_get_site_packages", lambda: tmp_path)
    with pytest.raises(status.MissingToolError) as caught:
        status.find_binary("lcm-spy")
    assert str(caught.value) == (
        "lcm-spy is missing: the Debian package does not have it; in a folder with the source: "
        + make_system_command(".")
    )


def test_given_no_installation_then_the_source_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(name: str) -> object:
        raise extras.PackageNotFoundError(name)

    monkeypatch.setattr(extras, "distribution", find)
    assert make_requirement() == str(ROOT)
    monkeypatch.setattr(extras, "SOURCE", Path("/nowhere"))
    assert make_requirement("bags") == ".[bags]"


def test_given_the_extras_then_they_are_those_of_the_project_for_users() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras.EXTRAS) == set(project) - {"test", "bench", "docs", "dev"}


def test_given_missing_extras_then_one_line_names_them_and_one_command(
    install: Install, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("pip", {"url": "file:///srv/clone", "dir_info": {"editable": True}})
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name in ("mcap", "viser") else name)
    line = describe_missing()
    assert line.startswith("Extras that are not installed: bags,view. To add them: ")
    assert line.endswith("/pip' install -e '/srv/clone[bags,view]'")
    assert "\n" not in line
    monkeypatch.setattr(extras, "find_spec", lambda name: name)
    assert describe_missing() == ""


def test_given_the_command_of_this_installation_then_pip_accepts_it(tmp_path: Path) -> None:
    """The requirement is one that pip resolves: a dry run without dependencies and without an index."""
    pytest.importorskip("pip", reason="this environment was made by uv, and has no pip")
    wanted = make_requirement("report")
    options = ("--dry-run", "--no-deps", "--no-index", "--no-build-isolation", "--disable-pip-version-check")
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", tmp_path, wanted],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert "Would install modelserver" in done.stdout, done.stderr


def test_given_all_texts_then_none_advises_an_index_that_does_not_have_it() -> None:
    for folder, pattern in (("modelserver", "*.py"), ("drivers", "*.py"), ("tools", "*.py"), ("docs", "*.md")):
        for path in (ROOT / folder).rglob(pattern):
            assert not re.search(r"pip install '?modelserver", path.read_text(encoding="utf-8")), path
