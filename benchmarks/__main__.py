"""List and run the benchmarks.

    python -m benchmarks              run them all
    python -m benchmarks NAME ...     run some
    python -m benchmarks NAME --...   run one with its options (--help lists them)
    python -m benchmarks --list       list them

Each is a module of this package with a function `main() -> int`: 0 = within its bounds, 1 = out of bounds, 77 =
skipped, with the reason printed. The first line of its docstring states what it measures.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

SKIPPED = 77


def list_benchmarks() -> list[str]:
    return sorted(path.stem for path in Path(__file__).parent.glob("[a-z]*.py") if _has_main(path))


def _has_main(path: Path) -> bool:
    return any(isinstance(node, ast.FunctionDef) and node.name == "main" for node in _parse(path).body) and (
        path.stem != "__main__"
    )


def _parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def summary(name: str) -> str:
    doc = ast.get_docstring(_parse(Path(__file__).with_name(f"{name}.py"))) or ""
    return doc.partition("\n")[0]


def main(arguments: Sequence[str]) -> int:
    known = list_benchmarks()
    if "--list" in arguments[:1]:
        print("\n".join(f"{name:20} {summary(name)}" for name in known))
        return 0
    first_option = next((k for k, each in enumerate(arguments) if each.startswith("-")), len(arguments))
    arguments, options = arguments[:first_option], list(arguments[first_option:])
    unknown = [name for name in arguments if name not in known]
    if unknown:
        print(f"no benchmark {', '.join(unknown)}; there are: {', '.join(known)}", file=sys.stderr)
        return 2
    if options and len(arguments) != 1:
        print(f"{' '.join(options)}: options are for one benchmark; name it before them", file=sys.stderr)
        return 2
    codes = []
    for name in arguments or known:
        print(f"== {name}: {summary(name)}", flush=True)
        main_of = importlib.import_module(f"benchmarks.{name}").main
        codes.append(main_of(options) if options else main_of())
    return 1 if any(code not in (0, SKIPPED) for code in codes) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
