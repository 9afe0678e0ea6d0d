#!/usr/bin/env python3
"""Regenerate what follows from the wire contract: `make types`.

lcmtypes/mslcm and lcmtypes/contract.lock come from lcmtypes/*.lcm.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import message_generator

from mstools.spy.lcm_wheel import find_binary

ROOT = Path(__file__).resolve().parent.parent
TYPES = ROOT / "lcmtypes"

LOCK_HEADER = """\
# The wire contract: every type and its fingerprint, which lcm-gen computes from the names, types and sizes of
# the fields (not from comments and constants), and from those of the nested types.
#
# A changed fingerprint means that programs built before and after do not understand each other on that channel.
# Until version 1.0 a change is free: edit the .lcm file, `make types`, commit both, note it in CHANGELOG.md.
# From 1.0 on no line here changes or goes: a change is a new type, NAME_v2_t, on a new channel, and the old one
# is published beside it for one release. Constants only grow; a number keeps its meaning.
"""


def generate(types: Path, folder: Path) -> None:
    """Write the Python package mslcm of the .lcm files in `types` into `folder`."""
    files = sorted(types.glob("*.lcm"))
    subprocess.run([find_binary("lcm-gen"), "--python", "--ppath", folder, *files], check=True)


def read_fingerprints(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the fingerprint in hex of each type of the package mslcm in `folder`.

    In a process of its own: this one may have imported another mslcm.
    """
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import mslcm\n"
        "for name in sys.argv[2:]: print(name, getattr(mslcm, name)._get_packed_fingerprint().hex())"
    )
    done = subprocess.run([sys.executable, "-c", code, folder, *names], check=True, capture_output=True, text=True)
    return dict(line.split() for line in done.stdout.splitlines())


def format_lock(fingerprints: Mapping[str, str]) -> str:
    """Return the text of contract.lock."""
    return LOCK_HEADER + "".join(f"{name} 0x{fingerprints[name]}\n" for name in sorted(fingerprints))


def read_lock(text: str) -> dict[str, str]:
    """Return the fingerprint in hex of each type that contract.lock names."""
    return dict(re.findall(r"^(\w+) 0x([0-9a-f]{16})$", text, re.MULTILINE))


def generate_modules(types: Path, fingerprints: Mapping[str, str]) -> dict[str, str]:
    """Return the formatted text of each generated Python module by its path in the repository."""
    texts = message_generator.generate(types, fingerprints)
    return {path: format_python(text, path) for path, text in texts.items()}


def format_python(text: str, path: str) -> str:
    """Return Python code without unused imports, with sorted ones, formatted."""
    for command in (("check", "--fix-only", "--quiet"), ("format", "--quiet")):
        ruff = [sys.executable, "-m", "ruff", *command, "--stdin-filename", str(ROOT / path), "-"]
        text = subprocess.run(ruff, input=text, capture_output=True, text=True, check=True).stdout
    return text


def main() -> int:
    """Write all files, and print the changes of the contract."""
    names = [path.stem for path in sorted(TYPES.glob("*.lcm"))]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        generate(TYPES, folder)
        fingerprints = read_fingerprints(folder, names)
        fresh = {path.name for path in (folder / "mslcm").glob("*.py")}
        for path in (TYPES / "mslcm").glob("*.py"):
            if path.name not in fresh:
                path.unlink()
        for name in fresh:
            shutil.copyfile(folder / "mslcm" / name, TYPES / "mslcm" / name)
    lock = TYPES / "contract.lock"
    before = read_lock(lock.read_text(encoding="utf-8")) if lock.exists() else {}
    lock.write_text(format_lock(fingerprints), encoding="utf-8")
    for path, text in generate_modules(TYPES, fingerprints).items():
        (ROOT / path).write_text(text, encoding="utf-8")
    for name in sorted(before.keys() | fingerprints.keys()):
        if before.get(name) != fingerprints.get(name):
            print(f"{name}: {before.get(name, 'new')} -> {fingerprints.get(name, 'removed')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
