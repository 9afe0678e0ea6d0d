"""Share of small mutations of the product that the tests notice.

    python tests/mutations.py                         # 110 mutations, the tests beside them
    python tests/mutations.py --tests OTHER/tests       # the same mutations before the tests of another checkout
    python tests/mutations.py --only 3,17               # some of them again
    python tests/mutations.py --known OLD/results.json  # first the tests that noticed in an earlier run

A mutation changes one expression inside a function: a comparison, an operator, a number, a condition, `and` and `or`.
All stand in one copy of the tree, each behind a switch, and the environment variable MUTANT turns one on. So a run
without any of them shows which tests reach which mutation, also through the processes that they start, and a mutation
is tried with those tests alone, cheapest first, until one fails; with the tests of processes (tests/scenario) only if
no other test reaches it. A test that fails without a mutation is left out.

The sample depends on the seed and on the product's sources alone. Each mutation prints a line; the results stand in
FOLDER/results.json, and a run that was interrupted goes on from there. Two to three hours on two cores.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import os
import random
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("modelserver", "drivers/msdrivers", "tools/mstools")
LEAST_TIMEOUT_S = 60.0
SLOWDOWN = 4.0
"""A mutation whose tests take this many times what they take without it, and the least time, has made an endless loop,
and is noticed: the suite would not end."""

COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">",
    ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not", ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.MatMult: "-",
}  # fmt: skip

SWITCH = '''
"""Switch of mutations, and the record of the tests that reach them."""
import builtins, os
_active = int(os.environ.get("MUTANT", "-1"))
_record = os.environ.get("MUTANT_RECORD")
_seen = set()
def _is_on(number):
    if _record:
        test = os.environ.get("PYTEST_CURRENT_TEST", "")
        if (number, test) not in _seen:
            _seen.add((number, test))
            with open(_record, "a") as file:
                file.write(f"{number}\\t{test}\\n")
    return number == _active
builtins.__mutant__ = _is_on
'''

PLUGIN = """
import json, os, time
import pytest

ORDER = os.environ.get("MUTANT_TESTS")
COSTS = os.environ.get("MUTANT_COSTS")

@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    if ORDER:
        with open(ORDER) as file:
            rank = {name: k for k, name in reversed([*enumerate(json.load(file))])}
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in rank])
        items[:] = sorted((item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid])

def pytest_runtest_logreport(report):
    if COSTS and not os.environ.get("PYTEST_XDIST_WORKER"):
        with open(COSTS, "a") as file:
            file.write(json.dumps([report.nodeid, report.duration, report.outcome]) + "\\n")
"""


@dataclass(frozen=True)
class Mutation:
    """One changed expression: where it stands (offsets in bytes), and both its texts."""

    file: str
    line: int
    begin: int
    end: int
    before: str
    after: str


def candidates(file: Path) -> Iterator[Mutation]:
    """Yield what can be changed inside the functions of a file, at most one mutation for each expression."""
    text = file.read_bytes()
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def make(node: ast.expr, after: str) -> Mutation:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        name = file.relative_to(ROOT).as_posix()
        return Mutation(name, node.lineno, begin, end, text[begin:end].decode(), after)

    def visit(node: ast.AST) -> Iterator[Mutation]:
        # f-strings have no exact positions before Python 3.12; patterns and annotations are no expressions
        if isinstance(node, ast.JoinedStr | ast.pattern | ast.AnnAssign | ast.Assert):
            return
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            operator = COMPARISONS[type(node.ops[0])]
            yield make(node, f"{ast.unparse(node.left)} {operator} {ast.unparse(node.comparators[0])}")
        elif isinstance(node, ast.BinOp) and type(node.op) in OPERATORS and not isinstance(node.left, ast.Constant):
            yield make(node, f"({ast.unparse(node.left)}) {OPERATORS[type(node.op)]} ({ast.unparse(node.right)})")
        elif isinstance(node, ast.BoolOp):
            other = " or " if isinstance(node.op, ast.And) else " and "
            yield make(node, other.join(f"({ast.unparse(value)})" for value in node.values))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield make(node, ast.unparse(node.operand))
        elif isinstance(node, ast.IfExp):
            yield make(
                node, f"({ast.unparse(node.orelse)}) if ({ast.unparse(node.test)}) else ({ast.unparse(node.body)})"
            )
        elif isinstance(node, ast.Constant) and type(node.value) in (int, float) and math.isfinite(node.value):
            yield make(node, repr(node.value + 1))
        elif isinstance(node, ast.Constant) and type(node.value) is bool:
            yield make(node, repr(not node.value))
        for child in ast.iter_child_nodes(node):
            yield from visit(child)

    for function in ast.walk(ast.parse(text)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            for statement in function.body:
                if not isinstance(statement, ast.FunctionDef | ast.ClassDef):
                    yield from visit(statement)


def package_of(name: str) -> str:
    """Return the package that a file belongs to, e.g. modelserver/wire."""
    parts = Path(name).parts
    deep = 3 if parts[0] != "modelserver" or parts[1] == "estimation" else 2
    return "/".join(parts[: min(deep, len(parts) - 1)])


def draw_sample(count: int, seed: int) -> list[Mutation]:
    """Return a sample over all packages, large ones with less than their share so that small ones have some too."""
    by_package: dict[str, list[Mutation]] = defaultdict(list)
    for top in PACKAGES:
        for file in sorted((ROOT / top).rglob("*.py")):
            for found in candidates(file):
                by_package[package_of(found.file)].append(found)
    source = random.Random(seed)
    total = sum(len(found) ** 0.7 for found in by_package.values())
    sample: list[Mutation] = []
    for _, found in sorted(by_package.items()):
        source.shuffle(found)
        for mutation in found[: max(1, round(count * len(found) ** 0.7 / total))]:
            # two mutations of which one contains the other cannot stand in one copy
            if all(mutation.file != other.file or mutation.end <= other.begin or other.end <= mutation.begin
                   for other in sample):  # fmt: skip
                sample.append(mutation)
    return sample


def write_mutants(tree: Path, sample: Sequence[Mutation]) -> None:
    """Put all mutations of a sample into a copy of the tree, each behind its switch."""
    for name in {mutation.file for mutation in sample}:
        text = (tree / name).read_bytes()
        of_file = [(number, each) for number, each in enumerate(sample) if each.file == name]
        for number, each in sorted(of_file, key=lambda pair: -pair[1].begin):
            if text[each.begin : each.end].decode() != each.before:
                raise SystemExit(f"{name}:{each.line}: not {each.before!r} any more; draw another sample")
            switched = f"(({each.after}) if __mutant__({number}) else ({each.before}))"
            text = text[: each.begin] + switched.encode() + text[each.end :]
        (tree / name).write_bytes(text)


def prepare(tree: Path, tests: Path, sample: Sequence[Mutation]) -> None:
    """Make a copy of the checkout with the mutations and the tests, and an environment for it."""
    if not tree.exists():
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True).stdout
        for name in filter(None, listed.split("\0")):
            if not name.startswith("tests/") and (ROOT / name).is_file():
                (tree / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, tree / name)
        write_mutants(tree, sample)
        subprocess.run(["make", ".venv/.installed-dev"], cwd=tree, check=True, stdout=sys.stderr)
        (packages,) = (tree / ".venv/lib").glob("python*/site-packages")
        (packages / "mutant_switch.py").write_text(SWITCH)
        (packages / "mutant_switch.pth").write_text("import mutant_switch\n")
        (packages / "mutant_plugin.py").write_text(PLUGIN)
    shutil.rmtree(tree / "tests", ignore_errors=True)
    shutil.copytree(tests, tree / "tests", ignore=shutil.ignore_patterns("__pycache__"))


def run_tests(tree: Path, arguments: Sequence[str], log: Path, seconds: float | None = None, **variables: str) -> int:
    """Run pytest in the copy and return its exit code."""
    environment = {
        **os.environ,
        "MODELSERVER_DATA": str(data_folder()),
        "MODELSERVER_SHARED_DRIVES": "off",
        **variables,
    }
    command = [str(tree / ".venv/bin/python"), "-m", "pytest", "-p", "mutant_plugin", "-p", "no:cacheprovider"]
    with log.open("w") as output:
        return subprocess.run(
            [*command, *arguments], cwd=tree, env=environment, stdout=output, stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL, timeout=seconds, check=False,
        ).returncode  # fmt: skip


def data_folder() -> Path:
    return Path(os.environ.get("MODELSERVER_DATA") or ROOT / "../shared/data").resolve()


@dataclass(frozen=True)
class Reach:
    """The tests that reach a mutation, cheapest first, and the seconds that they take without it."""

    tests: tuple[str, ...] = ()
    seconds: float = 0.0


def record(tree: Path, folder: Path) -> dict[int, Reach]:
    """Return what reaches each mutation, from a run with none turned on."""
    reached, costs_file = folder / "reached.tsv", folder / "costs.json"
    if not (folder / "recorded").exists():
        for left in (reached, costs_file):
            left.unlink(missing_ok=True)
        run_tests(tree, ["-n", "auto"], folder / "record.log", MUTANT_RECORD=str(reached), MUTANT_COSTS=str(costs_file))
        (folder / "recorded").touch()
    costs: Counter[str] = Counter()
    bad = set()
    for line in costs_file.read_text().splitlines():
        test, seconds, outcome = json.loads(line)
        costs[test] += seconds
        if outcome == "failed":
            bad.add(test)
    print(f"{len(costs)} tests, {len(bad)} fail without a mutation and are left out", flush=True)
    tests_of: dict[int, set[str]] = defaultdict(set)
    by_file: dict[str, list[str]] = defaultdict(list)
    for test in costs:
        by_file[test.partition("::")[0]].append(test)
    for line in reached.read_text().splitlines():
        number, _, where = line.partition("\t")
        test, _, phase = where.rpartition(" ")
        # what a fixture reaches may be shared by all tests of its file
        tests_of[int(number)].update(by_file[test.partition("::")[0]] if phase == "(setup)" else [test])
    for found in tests_of.values():
        found -= bad
        # processes are slow: they are tried only where no other test reaches the mutation
        others = {test for test in found if not test.startswith("tests/scenario/")}
        found &= others or found
    return {
        number: Reach(tuple(sorted(found, key=lambda test: (costs[test], test))), sum(costs[test] for test in found))
        for number, found in tests_of.items()
    }


def try_mutation(number: int, reach: Reach, tree: Path, folder: Path) -> str:
    """Return how a mutation ended: the test that noticed it, 'lives', or 'unreached'."""
    tests = reach.tests
    timeout = LEAST_TIMEOUT_S + SLOWDOWN * reach.seconds
    if not tests:
        return "unreached"
    order = folder / f"tests-{number}.json"
    order.write_text(json.dumps(tests))
    log = folder / f"mutant-{number}.log"
    files = sorted({test.partition("::")[0] for test in tests})
    try:
        code = run_tests(
            tree, ["-x", "-p", "no:xdist", "-o", "addopts=-q --strict-markers", *files], log, timeout,
            MUTANT=str(number), MUTANT_TESTS=str(order),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"noticed: not done in {timeout:.0f} s"
    if code == 0:
        return "lives"
    first = next(
        (line for line in log.read_text().splitlines() if line.startswith(("FAILED", "ERROR"))), f"exit {code}"
    )
    return f"noticed: {first[:160]}"


def main(arguments: Sequence[str] = ()) -> int:
    """Draw a sample, run the tests before it, and print the share that they notice."""
    parser = argparse.ArgumentParser(prog="python tests/mutations.py", description=__doc__)
    parser.add_argument("--count", type=int, default=110, help="about how many mutations (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the sample (default %(default)s)")
    parser.add_argument("--tests", type=Path, default=ROOT / "tests", help="folder of the tests (default: this one's)")
    parser.add_argument("--folder", type=Path, default=ROOT / "build/mutations", help="for the copy and the results")
    parser.add_argument("--known", type=Path, help="results of an earlier run, to try the tests that noticed first")
    parser.add_argument("--only", default="", help="numbers of mutations, with commas (default: all)")
    parser.add_argument("--list", action="store_true", help="print the sample and stop")
    given = parser.parse_args(list(arguments))
    sample = draw_sample(given.count, given.seed)
    if given.list:
        for number, each in enumerate(sample):
            print(f"{number:3} {each.file}:{each.line}: {each.before!r} -> {each.after!r}")
        return 0
    folder: Path = given.folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    prepare(folder / "tree", given.tests, sample)
    reached = record(folder / "tree", folder)
    results_file = folder / "results.json"
    results: dict[str, str] = json.loads(results_file.read_text()) if results_file.exists() else {}
    only = [int(each) for each in given.only.split(",") if each]
    todo = only or [number for number in range(len(sample)) if str(number) not in results]
    known: dict[str, str] = json.loads(given.known.read_text()) if given.known else {}

    def attempt(number: int) -> None:
        reach = reached.get(number, Reach())
        first = [test for test in reach.tests if f" {test} " in f"{known.get(str(number), '')} "]
        found = try_mutation(number, replace(reach, tests=(*first, *reach.tests)), folder / "tree", folder)
        results[str(number)] = found
        results_file.write_text(json.dumps(results, indent=1))
        each = sample[number]
        print(f"{number:3} {each.file}:{each.line}: {each.before!r} -> {each.after!r}: {found}", flush=True)

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        list(pool.map(attempt, todo))
    count = sum(found.startswith("noticed") for found in results.values())
    lives = sorted(int(number) for number, found in results.items() if not found.startswith("noticed"))
    print(f"noticed {count} of {len(results)} ({count / len(results):.0%}); not noticed: {lives}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
