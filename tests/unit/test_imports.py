"""The architecture, enforced: imports point one way, and what is pure touches neither clock, bus, disk nor log."""

from __future__ import annotations

import ast
import graphlib
from functools import cache
from pathlib import Path

import pytest
from support_source import parse

ROOT = Path(__file__).resolve().parents[2]

VALUES = {"errors", "version", "named_tuples", "transforms"}
GEOMETRY = VALUES | {"geometry"}
POSES = VALUES | {"messages", "earth", "estimation.history"}
CORE = GEOMETRY | POSES | {"dynamics", "joints", "estimation", "query"}
FILES = {"files"}
WIRE = VALUES | {"messages", "wire", "mslcm", "files"}
SIGNING = {"signing", "key_files"}
CONFIG = {"config.vehicle_file", "config.reader"}
DRIVERS = {"msdrivers.endpoint", "msdrivers.devices", "msdrivers.emulate"}
TOOLS = {
    # each imports only those before it
    "terminal": set(),
    "edit": {"terminal"},
    "meshes": set(),
    "shapes": set(),
    "recordings": {"terminal"},
    "report": {"terminal"},
    "archive": {"terminal", "recordings", "report"},
    "calibration": {"terminal", "report"},
    "tuning": {"terminal", "report"},
    "launch": {"terminal"},
    "deployment": {"terminal"},
    "foxglove": {"terminal", "meshes", "recordings", "report", "shapes"},
    "view": {"terminal", "edit", "meshes", "recordings", "report", "shapes"},
}
SERVER = CORE | WIRE | CONFIG | FILES | SIGNING | {"core", "formats", "yaml_tree"}
BELOW_TOOLS = SERVER | DRIVERS | {"server", "client", "simulation", "msdrivers", "extras"}

MAY_IMPORT: dict[str, set[str]] = {
    "version": set(),
    "named_tuples": set(),
    # folders
    "config": set(),
    "files": set(),
    "errors": set(),
    "transforms": {"errors"},
    "geometry": VALUES | {"plugins"},
    "dynamics": GEOMETRY | {"extras"},
    "messages": VALUES | {"earth"},
    "signing": VALUES | {"messages"},
    "key_files": VALUES | {"messages", "signing", "files"},
    "earth": VALUES,
    "estimation.history": VALUES | {"messages"},
    "joints": GEOMETRY | {"messages"},
    # load code, and neither compute nor read anything
    "estimation.filterpy_import": set(),
    "plugins": set(),
    # reads the metadata of this installation, for messages
    "extras": set(),
    "formats": GEOMETRY | FILES | {"yaml_tree"},
    "estimation": GEOMETRY | POSES | {"estimation.filterpy_import", "plugins"},
    "query": CORE,
    "core": CORE,
    "simulation": GEOMETRY | {"messages", "earth"},
    "config.vehicle_file": GEOMETRY | FILES | {"messages", "dynamics", "estimation", "config.reader"},
    "config.reader": {"errors", "yaml_tree"},
    "yaml_tree": {"errors"},
    "wire": WIRE,
    "server": SERVER,
    "client": WIRE | GEOMETRY | POSES | SIGNING | {"formats", "joints", "query"},
    "msdrivers.endpoint": VALUES | {"messages"},
    "msdrivers.devices": VALUES | {"messages", "msdrivers.endpoint"},
    "msdrivers.emulate": VALUES | {"messages", "earth", "simulation", "msdrivers.devices", "msdrivers.endpoint"},
    "msdrivers": WIRE | DRIVERS | {"config.reader", "earth", "plugins", "signing"},
    "mslcm": set(),
    **{f"mstools.{name}": BELOW_TOOLS | {f"mstools.{each}" for each in below} for name, below in TOOLS.items()},
    "mstools.commands": BELOW_TOOLS | {"mstools", *(f"mstools.{name}" for name in TOOLS)},
    "mstools": BELOW_TOOLS | {"mstools.terminal"},
    # the public names, loaded when they are first used
    "modelserver": VALUES | CONFIG | {"geometry", "messages", "formats", "client"},
}
"""Package -> packages it may import, besides itself. A name without the package is inside modelserver."""

PURE = {
    "errors",
    "named_tuples",
    "transforms",
    "geometry",
    "dynamics",
    "earth",
    "estimation",
    "messages",
    "signing",
    "estimation.history",
    "joints",
    "query",
    "core",
    "simulation",
} | DRIVERS

IMPURE_MODULES = {
    "asyncio", "concurrent", "ctypes", "fcntl", "glob", "http", "importlib", "io", "lcm", "logging", "mmap",
    "multiprocessing", "os", "pathlib", "pymodbus", "can", "queue", "requests", "sched", "secrets", "select",
    "selectors", "serial", "shutil", "signal", "socket", "sqlite3", "ssl", "subprocess", "sys", "syslog", "tempfile",
    "termios", "threading", "time", "urllib", "uuid", "warnings",
}  # fmt: skip
"""A clock, a bus, a disk, a thread, a log, or another process."""

IMPURE_CALLS = {"open", "print", "input", "exec", "eval", "breakpoint", "__import__"}

CLOCK_READS = {"now", "utcnow", "today"}


def sources() -> list[Path]:
    found = [path for folder in ("modelserver", "drivers", "tools") for path in (ROOT / folder).rglob("*.py")]
    assert found, f"no source under {ROOT}"
    return sorted(found)


def module_of(path: Path) -> str:
    """Return the dotted name that a file is imported by."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    if parts[0] in ("drivers", "tools"):
        parts = parts[1:]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module: str) -> str:
    """Return the key of MAY_IMPORT that a module of this project belongs to, empty for a foreign one."""
    parts = module.split(".")
    if parts[0] == "modelserver":
        deeper = ".".join(parts[1:3])
        return deeper if deeper in MAY_IMPORT else parts[1] if len(parts) > 1 else "modelserver"
    deeper = ".".join(parts[:2])
    return deeper if deeper in MAY_IMPORT else parts[0] if parts[0] in MAY_IMPORT else ""


@cache
def iterate_imports(tree: ast.AST, module: str, is_package: bool) -> list[tuple[int, str]]:
    """Return line and dotted name of everything imported, inside functions and TYPE_CHECKING blocks too."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = module.split(".")[: None if is_package and node.level == 1 else -node.level + is_package]
                base = ".".join([*above, base] if base else above)
            # `from modelserver import core` imports the module core; names of deeper modules stay in their package
            found += [(node.lineno, f"{base}.{alias.name}") for alias in node.names]
        elif (
            isinstance(node, ast.Call)
            and node.args
            and getattr(node.func, "attr", getattr(node.func, "id", "")).endswith("import_module")
        ):
            first = node.args[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                found.append((node.lineno, first.value))
    return found


def find_misdirected(tree: ast.AST, module: str, is_package: bool) -> list[tuple[int, str]]:
    package = package_of(module)
    if not package:
        return []  # a script beside the packages
    if package not in MAY_IMPORT:
        return [
            (1, f"package {package} is not in the table MAY_IMPORT of {Path(__file__).name}: give it its place there")
        ]
    allowed = MAY_IMPORT[package] | {package}
    wrong = []
    for line, name in iterate_imports(tree, module, is_package):
        other = package_of(name)
        if name.startswith("modelserver.") and other not in MAY_IMPORT:
            other = "modelserver"  # a name that the package itself exports, e.g. __version__
        if other and other not in allowed:
            wrong.append((line, f"{package} imports {name}; it may import only {', '.join(sorted(allowed))}"))
    return wrong


def impure(tree: ast.AST, module: str, is_package: bool) -> list[tuple[int, str]]:
    if package_of(module) not in PURE:
        return []
    wrong = [
        (line, f"{module} is pure and imports {name}")
        for line, name in iterate_imports(tree, module, is_package)
        if name.split(".")[0] in IMPURE_MODULES
    ]
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        parts = name.split(".")
        called = f"{module} is pure and calls {name}()"
        if name in IMPURE_CALLS:
            wrong.append((node.lineno, called))
        elif parts[-1] in CLOCK_READS and {"datetime", "date"} & set(parts[:-1]):
            wrong.append((node.lineno, f"{called}: time comes in with events"))
        elif any(isinstance(inner, ast.Call) for inner in ast.walk(node.func)):
            continue  # a method of what a call returned; that call is looked at by itself
        elif (parts[0] == "random" or "random" in parts[:-1]) and not (
            parts[-1] in ("Random", "default_rng", "Generator", "SeedSequence", "PCG64", "Philox") and node.args
        ):
            wrong.append((node.lineno, f"{called}: only a generator made with a seed is repeatable"))
        elif parts[-1] in ("default_rng", "Random") and not node.args:
            wrong.append((node.lineno, f"{called} without a seed"))
    return wrong


def findings(rule) -> list[str]:
    report = []
    for path in sources():
        tree = parse(path)
        report += [
            f"{path.relative_to(ROOT)}:{line}: {message}"
            for line, message in rule(tree, module_of(path), path.name == "__init__.py")
        ]
    return report


def complain(report: list[str], rule: str) -> None:
    if report:
        pytest.fail(f"{rule}\n  " + "\n  ".join(report), pytrace=False)


def test_imports_point_one_way():
    complain(findings(find_misdirected), "Imports point one way (table MAY_IMPORT). These do not:")


def test_pure_packages_touch_no_clock_bus_disk_thread_or_log():
    complain(findings(impure), "Time, data and chance enter a pure package as arguments. These reach out:")


def test_no_module_imports_itself_through_others() -> None:
    modules = {module_of(path): path for path in sources()}
    graph: dict[str, set[str]] = {}
    for module, path in modules.items():
        found = {
            name if name in modules else name.rpartition(".")[0]
            for _, name in iterate_imports(parse(path), module, path.name == "__init__.py")
        }
        # a package that a module is inside of is loaded before it in any case
        graph[module] = {name for name in found & modules.keys() if not f"{module}.".startswith(f"{name}.")}
    graphlib.TopologicalSorter(graph).prepare()


def test_the_table_itself_has_no_cycle():
    graphlib.TopologicalSorter({package: others - {package} for package, others in MAY_IMPORT.items()}).prepare()
    assert set(MAY_IMPORT) >= PURE
    assert set().union(*MAY_IMPORT.values()) <= set(MAY_IMPORT)
    # what is pure imports only what is pure, the version, or modules that load code or know the installation
    loading = {"version", "estimation.filterpy_import", "plugins", "extras"}
    assert set().union(*(MAY_IMPORT[package] for package in PURE)) <= PURE | loading


@pytest.mark.parametrize(
    ("module", "code", "message"),
    [
        (
            "modelserver.transforms.pose",
            "from modelserver.geometry import Model",
            "transforms imports modelserver.geometry.Model",
        ),
        ("modelserver.core", "def f():\n    from modelserver import server", "core imports modelserver.server"),
        ("modelserver.core", "from . import server", "core imports modelserver.server"),
        ("modelserver.core", "from .wire import codec", "core imports modelserver.wire.codec"),
        ("modelserver.core", "if TYPE_CHECKING:\n    import modelserver.wire", "core imports modelserver.wire"),
        ("modelserver.core", "import mslcm", "core imports mslcm"),
        ("modelserver.server.loop", "from mstools import cli", "server imports mstools.cli"),
        ("modelserver.server.loop", "from ..client import remote", "server imports modelserver.client.remote"),
        (
            "modelserver.geometry.model",
            "import importlib\nimportlib.import_module('modelserver.wire')",
            "modelserver.wire",
        ),
        ("msdrivers.devices.nmea", "from msdrivers import runner", "msdrivers.devices imports msdrivers.runner"),
        ("mstools.recordings.drive", "from mstools.view import page", "mstools.recordings imports mstools.view.page"),
        ("mstools.view.page", "from mstools import cli", "mstools.view imports mstools.cli"),
        ("modelserver.novelty", "import math", "package novelty is not in the table"),
    ],
)
def test_the_check_sees_what_points_the_wrong_way(module, code, message):
    ((_, found),) = find_misdirected(ast.parse(code), module, False)
    assert message in found


@pytest.mark.parametrize(
    ("module", "code"),
    [
        ("modelserver.transforms.pose", "from modelserver.transforms import so3\nfrom . import so3\nimport numpy"),
        ("modelserver.core", "from modelserver import messages\nfrom modelserver.geometry.model import Model"),
        ("modelserver.wire.codec", "from mslcm.gps_t import gps_t\nfrom modelserver import messages"),
        ("msdrivers.gps", "from msdrivers.devices import nmea\nfrom msdrivers import transport"),
    ],
)
def test_the_check_lets_pass_what_points_the_right_way(module, code):
    assert find_misdirected(ast.parse(code), module, False) == []


@pytest.mark.parametrize(
    "code",
    [
        "import time",
        "from time import monotonic",
        "def f():\n    import socket",
        "import logging.handlers",
        "import threading",
        "from os import path",
        "open('x')",
        "print('x')",
        "datetime.now()",
        "datetime.datetime.utcnow()",
        "random.random()",
        "random.Random()",
        "np.random.normal(0, 1)",
        "np.random.default_rng()",
        "default_rng()",
    ],
)
def test_the_check_sees_what_is_not_pure(code):
    assert len(impure(ast.parse(code), "modelserver.core", False)) == 1
    assert impure(ast.parse(code), "modelserver.server.loop", False) == []


@pytest.mark.parametrize(
    "code",
    ["random.Random(3).gauss(0, 1)", "np.random.default_rng(seed)", "rng.random()", "import datetime", "f.open()"],
)
def test_the_check_lets_pass_what_is_pure(code):
    assert impure(ast.parse(code), "modelserver.core", False) == []
