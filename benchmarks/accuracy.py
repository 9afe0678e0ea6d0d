"""Accuracy on recordings against withheld fixes, beside required values and other systems' values.

    python -m benchmarks accuracy                        the whole table
    python -m benchmarks.accuracy husky half             one line of it
    python -m benchmarks.accuracy husky p2x --verbose    with every gap
    python -m benchmarks.accuracy kitti half --set gyro_noise=0.001 --mode filter
    python -m benchmarks accuracy --faults               with injected faults, by half of the fixes without

`benchmarks.protocols` defines the lines, `benchmarks.recordings` the sources of the recordings.
Exit code 1 where a required value is missed or estimates diverge, 77 without recordings.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks import plaza_ranges, protocols
from benchmarks.protocols import SHIFTS, ReplayJob, ReplayScore, data_directory, load_scorer
from benchmarks.recordings import dresden, husky, kitti, plaza
from benchmarks.recordings.faults import FAULTS, RecordingFault
from benchmarks.requirements import GAPS, HEALTHY, Required
from benchmarks.support import ROOT

SKIPPED = 77
PROTOCOLS = ("half", "outage", "p2x")
DIVERGED_M = 100.0
"""An error beyond, at fixes that come every second or more often, is no noise of any receiver."""


@dataclass(frozen=True)
class AccuracyTarget:
    """Target of a line, meters; nan = none. `peers`: values of other systems, as text; `bars`: of its integrity."""

    required: float = math.nan
    aim: float = math.nan
    peers: str = ""
    bars: Required = HEALTHY


@dataclass(frozen=True)
class Recording:
    """A recording that is scored by its own fixes, with its targets by protocol."""

    name: str
    file: Callable[[Path], Path]
    convert: Callable[[Path, Path], Mapping[str, int]]
    vehicle: Path
    targets: Mapping[str, AccuracyTarget] = field(default_factory=dict)


RECORDINGS = (
    Recording(
        "husky",
        husky.file,
        husky.convert,
        ROOT / "config" / "husky" / "vehicle.yaml",
        {
            "half": AccuracyTarget(0.36, 0.33, "robot_localization 0.37 (UKF 0.34), 6-state EKF 1.65, FusionCore 0.45"),
            "p2x": AccuracyTarget(
                3.3, 3.0, "robot_localization 3.4 (UKF 4.1), 6-state EKF 3.9, FusionCore 4.8 to 5.6", GAPS
            ),
        },
    ),
    Recording(
        "kitti",
        lambda data: kitti.files(data)[0],
        kitti.convert,
        ROOT / "benchmarks" / "vehicles" / "kitti" / "vehicle.yaml",
        {
            "half": AccuracyTarget(0.27, 0.25, "robot_localization 0.25, 6-state EKF 0.32, KF-GINS 0.93, pyins 0.91"),
            "p2x": AccuracyTarget(
                6.5, 6.0, "robot_localization 25, 6-state EKF 25, KF-GINS 90, pyins 74 (4 gaps)", GAPS
            ),
        },
    ),
    Recording(
        "dresden",
        dresden.file,
        dresden.convert,
        ROOT / "benchmarks" / "vehicles" / "dresden" / "vehicle.yaml",
        {"half": AccuracyTarget(1.58)},
    ),
)
PLAZA = ("plaza1", "plaza2")


@dataclass(frozen=True)
class ResultLine:
    """One line of the table."""

    recording: Recording
    protocol: str
    outcomes: tuple[ReplayScore, ...]
    fault: RecordingFault | None = None

    @property
    def measured(self) -> float:
        """The measured value: RMSE for `half`, the mean gap-end error for the others, meters."""
        return self.outcomes[0].rmse if self.protocol == "half" else protocols.mean_gap_end(self.outcomes)

    @property
    def target(self) -> AccuracyTarget:
        """Target of the line."""
        if self.fault is not None:
            return AccuracyTarget(bars=self.fault.required)
        return self.recording.targets.get(self.protocol, AccuracyTarget(bars=GAPS))

    @property
    def figures(self) -> dict[str, float]:
        """Figures of the integrity by the names of their bars; nan without a valid estimate."""
        runs = [each.integrity for each in self.outcomes]
        seconds = sum(each.seconds for each in runs) or math.nan
        names = ("valid", "beyond_level", "beyond_protection", "misleading")
        valid, level, protection, wrong = (sum(getattr(each, name) for each in runs) / seconds for name in names)
        return {"valid": valid, "beyond_level": level, "beyond_protection": protection, "hmi": wrong * 3600.0}

    @property
    def missed(self) -> list[str]:
        """The bars that are missed; in `half` also whether estimates diverged or are missing."""
        missed = self.target.bars.find_missed(self.figures)
        if not math.isfinite(self.measured) or self.measured > self.target.required:
            missed.insert(0, "error")
        if self.protocol == "half":
            missed += ["missing"] * bool(self.outcomes[0].missing)
            missed += ["diverged"] * (not self.outcomes[0].max < DIVERGED_M)
        return missed

    @property
    def is_met(self) -> bool:
        """Whether no bar is missed."""
        return not self.missed

    def format(self) -> str:
        """Return the line as text."""
        n = (
            sum(each.n for each in self.outcomes)
            if self.protocol == "half"
            else sum(len(o.gaps) for o in self.outcomes)
        )
        missing = sum(each.missing for each in self.outcomes)
        asked = "".join(f"{'' if math.isnan(x) else f'{x:.2f}':>10}" for x in (self.target.required, self.target.aim))
        bad = "" if self.is_met else f"  <-- OUT OF BOUNDS: {', '.join(self.missed)}"
        name = f"{self.recording.name} {self.fault.name if self.fault else self.protocol}"
        return (
            f"{name:22}{self.measured:9.3f}{asked}{n:7}{missing:9}{self._format_integrity()}   {self.target.peers}{bad}"
        )

    def _format_integrity(self) -> str:
        """Return share of time valid, longest time without, misleading, beyond the levels, and level over error."""
        runs = [each.integrity for each in self.outcomes]
        if not any(each.seconds for each in runs):
            return f"{'never valid':>49}"
        longest, ratio = max(each.gap for each in runs), max(each.ratio for each in runs)
        found = self.figures
        shares = "".join(f"{found[name]:8.2%}" for name in ("beyond_level", "beyond_protection"))
        return f"{found['valid']:9.1%}{longest:8.1f}{found['hmi']:8.1f}{shares}{ratio:8.1f}"

    def format_details(self) -> list[str]:
        """Return the details for --verbose."""
        lines = []
        for shift, each in zip(SHIFTS, self.outcomes, strict=False):
            if self.protocol == "half":
                lines.append(f"    p95 {each.p95:.3f} m, max {each.max:.3f} m, {each.valid:.1%} of the poses valid")
            else:
                gaps = "  ".join(f"{gap.start:5.0f} s {gap.end_error:7.2f} m" for gap in each.gaps)
                lines.append(f"    shift {shift:4.0%}: {gaps}   largest {each.max:.2f} m, valid {each.valid:.0%}")
            lines += [f"      rejected {source} {why}: {n}" for (source, why), n in sorted(each.rejected.items())]
        return lines


def main(arguments: Sequence[str] = ()) -> int:
    options = _parse_options(arguments)
    data = data_directory()
    if load_scorer(data) is None:
        print(f"skipped: no tools/score_trajectory.py beside {data}; set MODELSERVER_DATA to the folder of recordings")
        return SKIPPED
    present = [each for each in RECORDINGS if each.name in options.names and each.file(data).is_file()]
    ranges = [name for name in PLAZA if name in options.names and plaza.files(data, name)[0].is_file()]
    for name in sorted(options.names - {each.name for each in present} - set(ranges)):
        print(f"{name}: skipped, no such files below {data}")
    if not present and not ranges:
        return SKIPPED
    holds = True
    with tempfile.TemporaryDirectory() as directory:
        cache = Path(options.cache or directory)
        cache.mkdir(parents=True, exist_ok=True)
        if present:
            names = f"{'valid':>9}{'gap s':>8}{'HMI s/h':>8}{'> lev':>8}{'> prot':>8}{'lev/95':>8}"
            print(f"{'':22}{'ours m':>9}{'required':>10}{'aim':>10}{'n':>7}{'missing':>9}{names}   others, m")
            for line in _run_all(present, options, data, cache):
                holds = holds and line.is_met
                print("\n".join([line.format(), *(line.format_details() if options.verbose else ())]), flush=True)
        for name in () if options.faults else ranges:
            print(plaza_ranges.report(name, data, options.settings, options.mode), flush=True)
    return 0 if holds else 1


def _run_all(present: Iterable[Recording], options: AccuracyOptions, data: Path, cache: Path) -> Iterator[ResultLine]:
    """Run all requested lines, in as many processes as there are cores, and yield them in order."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        logs = {}
        for each in present:
            logs[each.name] = cache / f"{each.name}.lcm"
            if not logs[each.name].is_file():
                each.convert(data, logs[each.name])
        waiting: list[tuple[Recording, str, RecordingFault | None, list[Future[ReplayScore]]]] = []
        for each in present:
            lines = [("half", fault) for fault in FAULTS] if options.faults else [(p, None) for p in options.protocols]
            for protocol, fault in lines:
                # a single recording runs with every requested protocol, the whole table only with targets
                if protocol not in each.targets and len(options.names) > 1:
                    continue
                shifts: tuple[str | float, ...] = SHIFTS if protocol == "p2x" else SHIFTS[:1]
                shifts = ("half",) if protocol == "half" else shifts
                futures = [
                    pool.submit(
                        protocols.run,
                        ReplayJob(logs[each.name], each.vehicle, data, shift, options.settings, options.mode, fault),
                    )
                    for shift in shifts
                ]
                waiting.append((each, protocol, fault, futures))
        for recording, protocol, fault, futures in waiting:
            yield ResultLine(recording, protocol, tuple(future.result() for future in futures), fault)


@dataclass(frozen=True)
class AccuracyOptions:
    """Command line options."""

    names: frozenset[str]
    protocols: tuple[str, ...]
    settings: Mapping[str, str]
    mode: str
    cache: str
    verbose: bool
    faults: bool
    processes: int


def _parse_options(arguments: Sequence[str]) -> AccuracyOptions:
    known = [*(each.name for each in RECORDINGS), *PLAZA]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.accuracy", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("what", nargs="*", metavar="WHAT", help=f"{', '.join(known)}; {', '.join(PROTOCOLS)}")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting of localization.filter, or with dots a place in the vehicle file",
    )
    parser.add_argument("--mode", default="", help="localization.mode")
    parser.add_argument(
        "--cache", default="", metavar="FOLDER", help="keep the converted logs here; empty it when a converter changed"
    )
    parser.add_argument("--verbose", "-v", action="store_true", help="every gap, and what was rejected")
    parser.add_argument(
        "--faults", action="store_true", help="faults injected into the recordings, instead of protocols"
    )
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args(list(arguments))
    unknown = [word for word in given.what if word not in known and word not in PROTOCOLS]
    if unknown:
        parser.error(f"no recording or protocol {', '.join(unknown)}; there are {', '.join([*known, *PROTOCOLS])}")
    if any("=" not in pair for pair in given.set):
        parser.error("--set takes KEY=VALUE")
    return AccuracyOptions(
        frozenset(word for word in given.what if word in known) or frozenset(known),
        tuple(word for word in PROTOCOLS if word in given.what) or PROTOCOLS,
        dict(pair.split("=", 1) for pair in given.set),
        given.mode,
        given.cache,
        given.verbose,
        given.faults,
        given.processes,
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
