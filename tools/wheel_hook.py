"""Build hook of hatch: a wheel contains the .lcm files in the package of the generated Python, and compiled modules.

With $MODELSERVER_COMPILE=1, mypyc compiles the modules that an IMU sample passes to machine code. Results are the same
bits, since it does the same operations on the same numbers in the same order; the .py files stay in the wheel.
"""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FILTER: Final = "modelserver/estimation/filter"

COMPILED: Final = (
    "modelserver/transforms/so3.py",
    f"{FILTER}/clock_monitor.py",
    f"{FILTER}/eskf.py",
    f"{FILTER}/imu_monitor.py",
    f"{FILTER}/imu_step.py",
    f"{FILTER}/localizer.py",
    f"{FILTER}/odometry.py",
    f"{FILTER}/propagation.py",
    f"{FILTER}/stationary_detector.py",
    f"{FILTER}/step.py",
    f"{FILTER}/timeline.py",
)
"""Modules that gain: floats, and one call after another. Others spend their time in numpy or on attributes of tuples,
which mypyc reads more slowly than CPython's own cache does."""

POSTPONED: Final = "from __future__ import annotations"

NEEDS: Final = ("mypy[mypyc]>=2.4,<3", "numpy>=1.26,<3")

# `make check` is what reports type errors: for mypyc a function has one type, also where a type variable has values.
MYPY: Final = """[mypy]
follow_imports = silent
ignore_missing_imports = true
ignore_errors = true
"""

SETUP: Final = f"""
from mypyc.build import mypycify
from setuptools import setup

modules = {COMPILED!r}
extensions = mypycify(
    ["--config-file", "mypy.ini", *modules], opt_level="2", debug_level="0", group_name="modelserver_filter"
)
for extension in extensions:
    # no fused multiply-add, which some processors have: it rounds once where Python rounds twice
    extension.extra_compile_args += ["-ffp-contract=off"]
setup(name="modelserver-filter", packages=[], ext_modules=extensions)
"""


class WheelHook(BuildHookInterface):
    """Adds every lcmtypes/NAME.lcm as mslcm/lcm/NAME.lcm; and on request the compiled modules beside their sources."""

    _folder: TemporaryDirectory[str] | None = None

    def dependencies(self) -> list[str]:
        """Return what a build needs beside hatchling."""
        return list(NEEDS) if self._is_compiled() else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files to hatch's build data."""
        for file in sorted(Path(self.root, "lcmtypes").glob("*.lcm")):
            build_data["force_include"][str(file)] = f"mslcm/lcm/{file.name}"
        if not self._is_compiled():
            return
        if version == "editable":
            raise RuntimeError("MODELSERVER_COMPILE=1: an editable install is plain Python; install without -e")
        self._folder = TemporaryDirectory()
        folder = Path(self._folder.name)
        _compile(Path(self.root), folder)
        for file in sorted(folder.rglob("*.so")):
            if "build" not in file.relative_to(folder).parts:
                build_data["force_include"][str(file)] = str(file.relative_to(folder))
        build_data["pure_python"], build_data["infer_tag"] = False, True

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the compiler's files."""
        if self._folder is not None:
            self._folder.cleanup()

    def _is_compiled(self) -> bool:
        return os.environ.get("MODELSERVER_COMPILE", "") == "1"


def _compile(root: Path, folder: Path) -> None:
    """Compile a copy of the sources in `folder`; each module ends up beside its source there."""
    shutil.copytree(root / "modelserver", folder / "modelserver", ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name in COMPILED:
        module = folder / name
        module.write_text(_quote_annotations(module.read_text(encoding="utf-8")), encoding="utf-8")
    (folder / "mypy.ini").write_text(MYPY, encoding="utf-8")
    (folder / "setup.py").write_text(SETUP, encoding="utf-8")
    command = [sys.executable, "setup.py", "build_ext", "--inplace"]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        raise RuntimeError(
            f"MODELSERVER_COMPILE=1: the filter does not compile; it needs a C compiler and Python's headers (Debian: "
            f"apt install gcc python3-dev)\n{done.stdout[-4000:]}"
        )


def _quote_annotations(source: str) -> str:
    """Return a module with the annotations of its classes' fields as strings, on the same lines.

    Python treats them so in modules with postponed annotations. mypyc keeps no more than the outermost type of others,
    and nothing of `A | B`, also in a string; but journals and stored states are written by the types of the fields.
    """
    lines = source.replace(POSTPONED, f"{POSTPONED}; from typing import Union", 1).splitlines(keepends=True)
    for node in ast.walk(ast.parse(source)):
        for each in node.body if isinstance(node, ast.ClassDef) else ():
            if isinstance(each, ast.AnnAssign):
                kind = each.annotation
                number = kind.lineno - 1
                line = lines[number].encode()
                text = repr(_write_union(kind)).encode()
                lines[number] = (line[: kind.col_offset] + text + line[kind.end_col_offset :]).decode()
    return "".join(lines)


def _write_union(kind: ast.expr) -> str:
    """Return the text of an annotation, `A | B` as `Union[A, B]`."""
    if isinstance(kind, ast.BinOp):
        return f"Union[{_write_union(kind.left)}, {_write_union(kind.right)}]"
    return ast.unparse(kind)
