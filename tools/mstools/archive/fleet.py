"""Figures over the drives of an archive: a page with the worst ones first, and the comparison of two archives.

Comparison: the drives of both archives are paired by the content of their logs, and a figure's difference over all of
them is sum(b - a) / sum(seconds), with its bootstrap interval over the pairs (`statistics`): the drives differ far more
than two versions do on one drive. A figure is worse where its interval lies on the wrong side of zero. With k figures
each interval is at 1 - 0.05 / k (Bonferroni), so that equal builds are called worse with at most 2.5 %.
"""

from __future__ import annotations

import html
import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow.dataset as ds

from modelserver.errors import ModelServerError
from mstools.archive.statistics import compute_ratio_interval
from mstools.archive.storage import Storage, digest, unify_errors
from mstools.report import charts
from mstools.report.charts import Axis, Panel, Series, escape_text, render_figure, render_key_figures, render_table
from mstools.terminal.output import format_count

MAX_LISTED: Final = 100
"""Drives in the table of the page: the worst ones."""


MIN_PAIRS: Final = 8
"""Fewest drives of a comparison. The interval of n drives excludes zero where all changed alike, which chance does with
2^-n on each side: 0.4 %, for each of five figures."""


@dataclass
class ArchivedDrive:
    """A drive of an archive with its figures. `invalid`: seconds by reason; `nis`: mean per degree of freedom by kind.

    `findings`: titles of the findings; `rejected` samples and measurements by source and reason; `level`: median of the
    horizontal level, m, nan without one; `resets` of the position.
    """

    log: str
    content: str
    begin: datetime | None
    seconds: float
    distance: float
    poses: int
    valid: int
    error: str
    invalid: dict[str, float] = field(default_factory=dict)
    rejected: Counter[str] = field(default_factory=Counter)
    nis: dict[str, float] = field(default_factory=dict)
    findings: Counter[str] = field(default_factory=Counter)
    level: float = math.nan
    resets: int = 0

    @property
    def valid_share(self) -> float:
        return self.valid / self.poses if self.poses else 0.0

    @property
    def invalid_seconds(self) -> float:
        return self.seconds * (1.0 - self.valid_share)


def read_drives(url: str) -> list[ArchivedDrive]:
    """Return the drives of an archive, worst first: those with an error, then by invalid time.

    Raises ModelServerError for what is no archive.
    """
    rows = _read(url, "drives")
    if not rows:
        raise ModelServerError(f"{url}: no archive there: modelserver archive run LOGS -c vehicle.yaml --out {url}")
    drives = {
        row["log"]: ArchivedDrive(
            row["log"],
            row["content"],
            row["time"] if row["seconds"] else None,
            *(row["seconds"], row["distance"], row["poses"], row["valid"], row["error"]),
        )
        for row in rows
    }
    _add_metrics(drives, _read(url, "metrics"))
    for row in _read(url, "events", ds.field("kind") == "finding"):
        if row["log"] in drives:
            drive = drives[row["log"]]
            # titles have figures of their own: they are one finding
            drive.findings[re.sub(r"\d[\d.,]*", "N", row["text"].partition(": ")[0])] += 1
    for row in _read(url, "rejections"):
        if row["log"] in drives:
            drives[row["log"]].rejected[f"{row['source']} {row['reason']}"] += row["count"]
    return sorted(drives.values(), key=lambda each: (not each.error, -each.invalid_seconds, each.log))


def _add_metrics(drives: Mapping[str, ArchivedDrive], rows: Iterable[Mapping[str, Any]]) -> None:
    sums: defaultdict[str, defaultdict[tuple[str, str], float]] = defaultdict(lambda: defaultdict(float))
    levels: defaultdict[str, list[float]] = defaultdict(list)
    for row in rows:
        if row["name"] == "horizontal_level":
            levels[row["log"]].append(row["value"])
        else:
            sums[row["log"]][row["name"], row["label"]] += row["value"]
    for log, drive in drives.items():
        found = sums[log]
        drive.invalid = {label: value for (name, label), value in found.items() if name == "invalid_seconds"}
        drive.nis = {
            label: value / found["nis_dof", label] for (name, label), value in list(found.items()) if name == "nis_sum"
        }
        drive.resets = int(found["resets", ""])
        drive.level = float(np.median(levels[log])) if levels[log] else math.nan


def _read(url: str, table: str, condition: Any = None) -> list[dict[str, Any]]:
    storage = Storage(url)
    if not storage.exists(table):
        return []
    with unify_errors(url):
        found = ds.dataset(storage.path(table), format="parquet", filesystem=storage.filesystem)
        rows: list[dict[str, Any]] = found.to_table(filter=condition).to_pylist()
    return rows


# --- page ---------------------------------------------------------------------------------------------------


def render_page(url: str, drives: Sequence[ArchivedDrive], find_report: Callable[[ArchivedDrive], str]) -> str:
    """Return the page of an archive; `find_report` gives the link to a drive's own report, empty without one."""
    hours = sum(each.seconds for each in drives) / 3600.0
    poses, failed = sum(each.poses for each in drives), [each for each in drives if each.error]
    figures = [
        (f"{len(drives)}", "drives"),
        (f"{hours:.1f} h", "recorded"),
        (f"{sum(each.distance for each in drives) / 1000.0:.1f} km", "driven"),
        (f"{sum(each.valid for each in drives) / poses:.1%}" if poses else "none", "of the poses valid"),
        (f"{len(failed)}", "drives with an error"),
    ]
    sections = [
        ("worst", "Worst drives", _render_worst(url, drives, find_report)),
        ("reasons", "Reasons of invalid poses", _render_reasons(drives)),
        ("findings", "Findings of sensors and settings", _render_findings(drives)),
        ("distributions", "Distributions", _render_distributions(drives)),
        ("errors", "Errors of logs", _render_errors(failed)),
    ]
    about = "docs/archives.md explains each table"
    return charts.render_report(f"Archive {url}", ("Archive report", url), render_key_figures(figures), sections, about)


def _render_worst(url: str, drives: Sequence[ArchivedDrive], find_report: Callable[[ArchivedDrive], str]) -> str:
    prefix = os.path.commonpath([each.log for each in drives]) if len(drives) > 1 else ""
    lines = []
    for each in drives[:MAX_LISTED]:
        link, name = find_report(each), escape_text(each.log.removeprefix(prefix).lstrip("/"))
        reasons = sorted(each.invalid.items(), key=lambda item: -item[1])[:2]
        kind, nis = max(each.nis.items(), key=lambda item: item[1], default=("", math.nan))
        rejected = each.rejected.most_common(1)
        cells = (
            each.begin.astimezone(UTC).strftime("%Y-%m-%d %H:%M") if each.begin else "",
            f"{each.seconds:.0f}",
            f"{each.distance:.0f}",
            f"{each.valid_share:.1%}",
            f"{each.invalid_seconds:.0f}",
            ", ".join(f"{name} {seconds:.0f} s" for name, seconds in reasons),
            f"{rejected[0][1]} {rejected[0][0]}" if rejected else "",
            f"{kind} {nis:.2f}" if kind else "",
            "; ".join(title for title, _ in each.findings.most_common(2)),
            each.error[:120],
        )
        first = f'<a href="{html.escape(link)}">{name}</a>' if link else name
        rest = "".join(f"<td{' class=n' if 0 < n < 5 else ''}>{escape_text(cell)}</td>" for n, cell in enumerate(cells))
        lines.append(f"<tr><td>{first}</td>{rest}</tr>")
    head = "".join(
        f"<th>{each}</th>"
        for each in (
            "drive",
            "begin, UTC",
            "s",
            "m",
            "valid",
            "invalid, s",
            "mostly",
            "rejected",
            "NIS",
            "findings",
            "error",
        )
    )
    more = f"<p>and {len(drives) - MAX_LISTED} more</p>" if len(drives) > MAX_LISTED else ""
    command = f"modelserver archive report {url} --worst 10"
    return (
        f"<p>All logs in {escape_text(prefix or url)}. A name with a link has its own report; "
        f"<code>{escape_text(command)}</code> writes those of the first ten, --drive LOG that of one.</p>\n"
        f"<table><thead><tr>{head}</tr></thead>\n<tbody>{''.join(lines)}</tbody></table>{more}"
    )


def _render_reasons(drives: Sequence[ArchivedDrive]) -> str:
    total = sum(each.seconds for each in drives)
    reasons: defaultdict[str, float] = defaultdict(float)
    affected: Counter[str] = Counter()
    for each in drives:
        for name, seconds in each.invalid.items():
            reasons[name] += seconds
            affected[name] += 1
    rows = [
        (name, f"{seconds:.0f}", f"{seconds / total:.2%}", f"{affected[name]}")
        for name, seconds in sorted(reasons.items(), key=lambda item: -item[1])
    ]
    return render_table(("reason", "s", "share of the time", "drives"), rows, (1, 2, 3)) if rows else "<p>None.</p>"


def _render_findings(drives: Sequence[ArchivedDrive]) -> str:
    counts = Counter(title for each in drives for title in each.findings)
    rejected: Counter[str] = Counter()
    for each in drives:
        rejected.update(each.rejected)
    rows = [(title, f"{count}") for title, count in counts.most_common(40)]
    found = render_table(("finding", "drives"), rows, (1,)) if rows else "<p>No findings.</p>"
    rows = [(what, f"{count}") for what, count in rejected.most_common(40)]
    return found + (render_table(("rejected: source and reason", "samples"), rows, (1,)) if rows else "")


def _render_distributions(drives: Sequence[ArchivedDrive]) -> str:
    whole = [each for each in drives if each.poses]
    if not whole:
        return "<p>No drive has a pose.</p>"
    x = Axis("share of the drives, %", 0.0, 100.0)
    panels = [
        _draw_distribution("Valid, %", [100.0 * each.valid_share for each in whole]),
        _draw_distribution("Median level of the horizontal position, m", [each.level for each in whole]),
        *(
            _draw_distribution(f"Mean NIS of {kind}", [each.nis[kind] for each in whole if kind in each.nis])
            for kind in sorted({kind for each in whole for kind in each.nis})
        ),
    ]
    caption = "Each drive is a point, in ascending order: at 50 % is the median drive. A NIS of 1 is consistent."
    return render_figure(charts.render_panels("Distributions over the drives", x, panels), caption)


def _draw_distribution(title: str, values: Iterable[float]) -> Panel:
    known = sorted(value for value in values if math.isfinite(value))
    at = [100.0 * (n + 0.5) / len(known) for n in range(len(known))]
    return Panel(
        title, Axis("", *charts.value_range(known, min_width=0.1)), [Series("", at, known, shape="dots", width=4.0)]
    )


def _render_errors(failed: Sequence[ArchivedDrive]) -> str:
    if not failed:
        return "<p>None.</p>"
    return render_table(
        ("log", "read, s", "error"), [(each.log, f"{each.seconds:.0f}", each.error) for each in failed], (1,)
    )


# --- comparison ---------------------------------------------------------------------------------------------


class Figure(NamedTuple):
    """A figure of a drive, of which less is better, as its sum and over what; `unit` of the ratio, times `factor`."""

    name: str
    unit: str
    factor: float
    compute: Callable[[ArchivedDrive], tuple[float, float]]


def _deviate(drive: ArchivedDrive) -> tuple[float, float]:
    return sum(abs(math.log(max(nis, 1e-3))) for nis in drive.nis.values()), float(len(drive.nis))


FIGURES: Final = (
    Figure("invalid", "% of the time", 100.0, lambda each: (each.invalid_seconds, each.seconds)),
    Figure("rejected", "per minute", 60.0, lambda each: (float(each.rejected.total()), each.seconds)),
    Figure("resets", "per hour", 3600.0, lambda each: (float(each.resets), each.seconds)),
    Figure("level", "m", 1.0, lambda each: (0.0 if math.isnan(each.level) else each.level, float(each.level > 0.0))),
    Figure("nis", "|log NIS|", 1.0, _deviate),
)


@dataclass(frozen=True)
class PairedFigure:
    """A figure of two archives, its difference with an interval over the paired drives, and how many changed."""

    name: str
    unit: str
    before: float
    after: float
    low: float
    high: float
    better: int
    worse: int

    @property
    def verdict(self) -> str:
        return "worse" if self.low > 0.0 else "better" if self.high < 0.0 else "equal"


@dataclass(frozen=True)
class ArchiveComparison:
    """The drives of two archives compared; `only`: those of one archive alone."""

    pairs: int
    only: tuple[int, int]
    figures: tuple[PairedFigure, ...]

    @property
    def is_worse(self) -> bool:
        return any(each.verdict == "worse" for each in self.figures)


def compare(before: Sequence[ArchivedDrive], after: Sequence[ArchivedDrive]) -> ArchiveComparison:
    """Compare the drives of two archives log by log. Raises ModelServerError without a common log."""
    first, second = ({each.content: each for each in drives if each.content} for drives in (before, after))
    both = sorted(first.keys() & second.keys())
    if len(both) < MIN_PAIRS:
        raise ModelServerError(
            f"the two archives have {format_count(len(both), 'log')} in common; a change differs from chance in "
            f"{MIN_PAIRS} or more: run both over the same logs"
        )
    level = 1.0 - 0.05 / len(FIGURES)
    found = []
    for figure in FIGURES:
        a, b = (np.array([figure.compute(drives[key]) for key in both]) for drives in (first, second))
        known = (a[:, 1] > 0.0) & (b[:, 1] > 0.0)
        if not known.any():
            continue
        a, b = a[known], b[known]
        weights = 0.5 * (a[:, 1] + b[:, 1])
        difference = b[:, 0] - a[:, 0]
        low, high = compute_ratio_interval(difference, weights, level)
        scale = figure.factor / weights.sum()
        found.append(
            PairedFigure(
                figure.name,
                figure.unit,
                *(float(a[:, 0].sum() * scale), float(b[:, 0].sum() * scale)),
                *(low * figure.factor, high * figure.factor),
                *(int((difference < 0.0).sum()), int((difference > 0.0).sum())),
            )
        )
    return ArchiveComparison(len(both), (len(first) - len(both), len(second) - len(both)), tuple(found))


def name_report(drive: ArchivedDrive) -> str:
    """Return the file name of a drive's own report."""
    stem = re.sub(r"[^A-Za-z0-9._-]", "_", Path(drive.log).stem)[:60]
    return f"{stem}-{digest(drive.log)[:8]}.html"
