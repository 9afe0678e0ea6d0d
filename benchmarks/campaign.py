"""Campaign: hours of simulated drives with each fault on a cluster, and their table with confidence intervals.

    python -m benchmarks campaign --hours 1000 --out build/campaign
    python -m benchmarks campaign --hours 1000 --out build/campaign --scheduler tcp://10.0.0.1:8786
    python -m benchmarks campaign --out build/campaign --table        the table of what is there, as Markdown

Drives, faults and figures are those of `integrity`, with seeds from a digest of fault, vehicle and number: a longer
campaign has the drives of a shorter one. All faults and vehicles advance together, so that one that is interrupted has
a whole table. Each drive is a line of `FOLDER/CODE.jsonl`, by the digest of the code: a campaign that runs again
computes what is missing, and drives of other code are not counted.

Intervals: 95 %, percentiles of resampled drives (Efron and Tibshirani (1993) 13.3). Where no drive has an error beyond
its limit, the upper bound is 3 / hours events an hour: the probability of none in n is (1 - p)^n, which is 5 % at
p = 3 / n (Hanley and Lippman-Hand (1983)).
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads only wait for each other

import numpy as np

from benchmarks.integrity import BY_NAME, FAULTS, Task, run_task
from benchmarks.integrity_drives import VEHICLES
from modelserver.errors import ModelServerError
from mstools.archive.cluster import hash_code, open_cluster
from mstools.archive.statistics import compute_ratio_interval
from mstools.archive.storage import digest
from mstools.terminal.output import show_progress

ROUND_HOURS: Final = sum(fault.quick[1] for fault in FAULTS) * len(VEHICLES) / 60.0
"""Simulated hours of one drive for each fault and vehicle."""


def plan_tasks(hours: float) -> Iterator[Task]:
    """Yield the drives of a campaign, one of each fault and vehicle after another."""
    for number in range(math.ceil(hours / ROUND_HOURS)):
        for fault in FAULTS:
            for vehicle in VEHICLES:
                seed = blake2b(f"{fault.name} {vehicle} {number}".encode(), digest_size=4).digest()
                yield Task(fault.name, vehicle, int.from_bytes(seed, "big"), fault.quick[1] * 60.0)


def run_drive(task: Task) -> dict[str, Any]:
    """Run a drive; return its task and figures as JSON data."""
    result = run_task(task)
    detected = [event.detected for event in result.events]
    longest = max((breach.seconds for breach in result.breaches), default=0.0)
    return {
        "task": task,
        **{name: getattr(result, name) for name in ("seconds", "valid", "wrong", "beyond_level", "beyond_protection")},
        "longest": longest,
        "breaches": len(result.breaches),
        "detected": [each for each in detected if not math.isnan(each)],
        "events": len(detected),
        "cpu": result.cpu,
    }


def read_drives(path: Path) -> list[dict[str, Any]]:
    """Return the drives of a file, each once; a line that was cut by an interruption is none."""
    found: dict[Task, dict[str, Any]] = {}
    if path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                drive = json.loads(line)
            except ValueError:
                continue
            found[Task(*drive["task"])] = drive
    return list(found.values())


def run(tasks: Iterable[Task], path: Path, scheduler: str, workers: int) -> None:
    """Append the drives that a file lacks."""
    done = {Task(*drive["task"]) for drive in read_drives(path)}
    missing = [task for task in tasks if task not in done]
    if not missing:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    total = sum(task.seconds for task in missing) / 3600.0
    computed, started = 0.0, time.monotonic()
    with (
        open_cluster(scheduler, workers) as cluster,
        path.open("a", encoding="utf-8") as out,
        show_progress("campaign", total) as show,
    ):
        print(f"  {len(missing)} drives, {total:.0f} h; dashboard: {cluster.dashboard}", flush=True)
        out.write("\n")  # ends a line that was cut
        for task, drive in cluster.run(run_drive, missing):
            if isinstance(drive, ModelServerError):
                print(f"  {task}: {drive}", file=sys.stderr)
                continue
            out.write(json.dumps(drive) + "\n")
            out.flush()
            computed += task.seconds / 3600.0
            show(computed)
    print(f"  {computed:.1f} h in {time.monotonic() - started:.0f} s", flush=True)


HEADER: Final = (
    "| fault | h | valid, % | HMI, s/h | longest, s | beyond protection level, % | detected, s |\n"
    "|---|---|---|---|---|---|---|"
)


def format_table(drives: Iterable[dict[str, Any]]) -> str:
    """Return the table of drives as Markdown: a row for each fault."""
    of_fault: dict[str, list[dict[str, Any]]] = {}
    for drive in drives:
        of_fault.setdefault(drive["task"][0], []).append(drive)
    rows = [format_row(name, of_fault[name]) for name in BY_NAME if name in of_fault]
    return "\n".join([HEADER, *rows])


def format_row(name: str, drives: list[dict[str, Any]]) -> str:
    seconds, valid, wrong, beyond = (
        np.array([drive[key] for drive in drives]) for key in ("seconds", "valid", "wrong", "beyond_protection")
    )
    hours = float(seconds.sum()) / 3600.0

    def interval(values: np.ndarray[Any, Any], factor: float, digits: int) -> str:
        low, high = compute_ratio_interval(values, seconds)
        if values.any():
            middle = factor * float(values.sum() / seconds.sum())
            return f"{middle:.{digits}f} ({factor * low:.{digits}f}-{factor * high:.{digits}f})"
        return "0"

    hmi = interval(wrong, 3600.0, 1) if wrong.any() else f"0 (<{3.0 / hours:.1f}/h)"
    detected = [each for drive in drives for each in drive["detected"]]
    events = sum(drive["events"] for drive in drives)
    found = f"{np.median(detected):.0f} ({len(detected)}/{events})" if detected else f"(0/{events})"
    return (
        f"| {name} | {hours:.1f} | {interval(valid, 100.0, 1)} | {hmi} | "
        f"{max(drive['longest'] for drive in drives):.0f} | {interval(beyond, 100.0, 2)} | "
        f"{found if events else ''} |"
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks campaign", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--hours", type=float, default=ROUND_HOURS, help="of all drives together; default: one of each")
    parser.add_argument("--out", type=Path, default=Path("build/campaign"), metavar="FOLDER")
    parser.add_argument("--scheduler", default="", metavar="ADDRESS", help="of a Dask cluster; default: this machine")
    parser.add_argument("--workers", type=int, default=0, help="processes on this machine; default: one per core")
    parser.add_argument("--table", action="store_true", help="only print the table of what is there")
    options = parser.parse_args(arguments or [])
    path = options.out / f"{digest(hash_code())}.jsonl"
    try:
        if not options.table:
            run(plan_tasks(options.hours), path, options.scheduler, options.workers)
    except ModelServerError as error:
        print(f"campaign: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(f"interrupted; run it again to go on from {path}", file=sys.stderr)
        return 130
    drives = read_drives(path)
    if not drives:
        print(f"no drive of this code in {options.out}", file=sys.stderr)
        return 1
    print(format_table(drives))
    hours, cpu = sum(drive["seconds"] for drive in drives) / 3600.0, sum(drive["cpu"] for drive in drives) / 3600.0
    print(
        f"\n  {len(drives)} drives, {hours:.0f} h, {cpu:.2f} h of processor: {hours / cpu:.0f} times real time a core"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
