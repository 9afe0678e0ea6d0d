#!/usr/bin/env python3
"""Write the Python that follows from lcmtypes/*.lcm: the package mslcm, the values and their codec, and contract.lock.

A build or an installation runs it (`wheel_hook.py`); after a change of an .lcm file, `make types` does.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path

import message_generator

ROOT = Path(__file__).resolve().parent.parent

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
    spec = find_spec("lcm")
    if spec is None or spec.origin is None:
        raise RuntimeError("the package lcm, which has lcm-gen, is missing: pip install lcm")
    program = Path(spec.origin).resolve().parent.parent / "bin" / "lcm-gen"
    subprocess.run([program, "--python", "--ppath", folder, *sorted(types.glob("*.lcm"))], check=True)


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
    return LOCK_HEADER + "".join(f"{name} 0x{fingerprints[name]}\n" for name in sorted(fingerprints))


def read_lock(text: str) -> dict[str, str]:
    """Return the fingerprint in hex of each type that contract.lock names."""
    return dict(re.findall(r"^(\w+) 0x([0-9a-f]{16})$", text, re.MULTILINE))


def write(root: Path) -> dict[str, str]:
    """Write all modules below the repository `root`, and return the fingerprints; files that are right stay."""
    types = root / "lcmtypes"
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        generate(types, folder)
        fingerprints = read_fingerprints(folder, [path.stem for path in sorted(types.glob("*.lcm"))])
        texts = {f"lcmtypes/mslcm/{path.name}": path.read_text("utf-8") for path in (folder / "mslcm").glob("*.py")}
    for path in (types / "mslcm").glob("*.py"):
        if f"lcmtypes/mslcm/{path.name}" not in texts:
            path.unlink()
    for name, text in (texts | message_generator.generate(types, fingerprints)).items():
        path = root / name
        if not path.is_file() or path.read_text("utf-8") != text:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return fingerprints


def main() -> int:
    """Write all files and contract.lock, and print the changes of the contract."""
    fingerprints = write(ROOT)
    lock = ROOT / "lcmtypes" / "contract.lock"
    before = read_lock(lock.read_text(encoding="utf-8")) if lock.exists() else {}
    lock.write_text(format_lock(fingerprints), encoding="utf-8")
    for name in sorted(before.keys() | fingerprints.keys()):
        if before.get(name) != fingerprints.get(name):
            print(f"{name}: {before.get(name, 'new')} -> {fingerprints.get(name, 'removed')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
