"""The report on a replay: one HTML page that holds all it needs, with findings, tables and drawings."""

from __future__ import annotations

import html
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from itertools import pairwise

from modelserver.messages import Decision, Invalid, Mode, Verdict
from modelserver.version import __version__
from mstools.report import consistency, panels
from mstools.report.data import Replayed, StateSample
from mstools.report.finding import FindingLevel, ReportFinding
from mstools.report.findings import findings
from mstools.report.panels import Band, Curve, Dots, Level, Panel, StripRow
from mstools.report.svg import Axis, decades
from mstools.terminal.output import counted, safe

HELD_S = 1.0
"""Seconds for which a state still counts where no newer one follows."""

NIS_WINDOW_S = 20.0

COMPONENTS: dict[str, tuple[str, ...]] = {
    "gps_position": ("east, m", "north, m"),
    "gps_height": ("up, m",),
    "gps_velocity": ("east, m/s", "north, m/s", "up, m/s"),
    "gps_baseline": ("azimuth, rad",),
    "wheel_speed": ("m/s",),
    "non_holonomic": ("to the left, m/s", "up, m/s"),
    "zero_velocity": ("east, m/s", "north, m/s", "up, m/s"),
    "zero_rate": ("about x, rad/s", "about y, rad/s", "about z, rad/s"),
    "imu_tilt": ("east", "north"),
    "imu_yaw": ("yaw, rad",),
    "magnetometer": ("azimuth, rad",),
    "range": ("distance, m",),
    "absolute_pose": ("east, m", "north, m", "up, m", "about east, rad", "about north, rad", "about up, rad"),
    "relative_pose": ("x, m/s", "y, m/s", "z, m/s", "about x, rad/s", "about y, rad/s", "about z, rad/s"),
}
"""What the numbers of each kind of measurement are; those of other kinds are numbered."""

GRADES = {FindingLevel.WRONG: "wrong", FindingLevel.DOUBTFUL: "doubtful", FindingLevel.NOTE: "note"}


def page(replayed: Replayed) -> str:
    """Return the page."""
    found = findings(replayed)
    sections = [
        ("findings", "Findings", _findings(found)),
        ("track", "Track", _track(replayed)),
        ("validity", "Validity and events", _validity(replayed)),
        ("motion", "Heading, speed and how sure", _motion(replayed)),
        ("consistency", "Consistency", _consistency(replayed)),
        ("innovations", "Innovations", _innovations(replayed)),
        ("states", "Biases, wheels and other states", _states(replayed)),
        ("sensors", "Sensors", _sensors(replayed)),
        ("verdicts", "Verdicts", _verdicts(replayed)),
    ]
    links = " ".join(f'<a href="#{name}">{title}</a>' for name, title, _ in sections)
    body = "\n".join(
        f'<section id="{name}"><h2>{title}</h2>\n{content}\n</section>' for name, title, content in sections
    )
    name = html.escape(safe(replayed.vehicle))
    log = html.escape(safe(replayed.log))
    began = datetime.fromtimestamp(replayed.first_utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{name}: replay of {log}</title>
<style>{STYLE}</style>
</head>
<body>
<header>
<p class="kicker">Replay report</p>
<h1>{name}</h1>
<p>{log}, begun {began}, {replayed.seconds:.0f} s</p>
{_figures(replayed)}
<nav>{links}</nav>
</header>
{body}
<footer>modelserver {__version__}; what each drawing should look like stands in docs/tuning.md</footer>
</body>
</html>
"""


# --- key figures and findings -------------------------------------------------------------------------------


def _figures(replayed: Replayed) -> str:
    states = replayed.snapshots
    # the way over ground, without what the estimate trembles by while standing
    way = sum(abs(b.speed) * (b.t - a.t) for a, b in pairwise(states) if math.isfinite(b.speed) and b.t - a.t < HELD_S)
    driven = (f"{way:.0f} m", "driven")
    if not any(math.isfinite(each.speed) for each in states):
        raw = replayed.raw.driven()
        by = "wheels" if replayed.raw.wheels else "fixes"
        driven = (f"{raw:.0f} m", f"driven, by the {by}") if math.isfinite(raw) else ("unknown", "driven")
    sigmas = sorted(each.sigma for each in states if math.isfinite(each.sigma))
    verdicts = Counter(each.verdict for each in replayed.fixes)
    figures = [
        (f"{replayed.seconds:.0f} s", "recorded"),
        driven,
        (f"{_valid_share(replayed):.1%}", "of the time valid"),
        (f"{verdicts['used']} of {len(replayed.fixes)}", "fixes used as positions"),
        (f"{verdicts['rejected']}", "positions rejected"),
        (f"{sigmas[len(sigmas) // 2]:.2f} m" if sigmas else "none", "middle position sigma"),
    ]
    cells = "".join(f"<div><strong>{value}</strong><span>{what}</span></div>" for value, what in figures)
    return f'<div class="figures">{cells}</div>\n<p>{html.escape(_figure_words(replayed))}</p>'


def _valid_share(replayed: Replayed) -> float:
    """Return the share of the recorded time in which the state was valid."""
    held = [min(b.t - a.t, HELD_S) for a, b in pairwise(replayed.snapshots) if not a.invalid and b.t > a.t]
    return min(sum(held) / replayed.seconds, 1.0) if replayed.seconds > 0.0 else 0.0


def _figure_words(replayed: Replayed) -> str:
    """Return what the figures count, and what became of the fixes that were not used."""
    verdicts = Counter(each.verdict for each in replayed.fixes)
    words = ["Valid is of the time recorded, from the log's first event on."]
    if replayed.fixes:
        rest = [
            f"{counted(verdicts[verdict], 'fix', 'fixes')} {what}"
            for verdict, what in (
                ("monitored", "at rest or unused"),
                ("took_up", "took the position up"),
                ("", "came before heading was known, or were still open at the end"),
            )
            if verdicts[verdict]
        ]
        if rest:
            words.append(f"Of the fixes not used as positions (gps_position): {', '.join(rest)}.")
        heights = sum(each.kind == "gps_height" and each.verdict is Verdict.REJECTED for each in replayed.decisions)
        if heights:
            words.append(f"{counted(heights, 'height')} (gps_height) of fixes rejected.")
    return " ".join(words)


def _findings(found: Sequence[ReportFinding]) -> str:
    if not found:
        return '<p class="good">Nothing suspicious was found. The drawings below may still know more.</p>'
    return "\n".join(
        f'<div class="finding {GRADES[each.grade]}"><h3><span>{GRADES[each.grade]}</span> '
        f"{html.escape(safe(each.title))}</h3><p>{html.escape(safe(each.seen))}</p>"
        f"<p>{html.escape(safe(each.advice))}</p></div>"
        for each in found
    )


# --- track --------------------------------------------------------------------------------------------------

FIX_COLOURS = (
    ("monitored", "at rest or unused", panels.SKY),
    ("", "before heading", panels.GREY),
    ("used", "used", panels.GREEN),
    ("took_up", "took up", panels.AMBER),
    ("rejected", "rejected", panels.RED),
)


def _track(replayed: Replayed) -> str:
    placed = [each for each in replayed.snapshots if each.place is not None]
    if not placed:
        return "<p>There was never a pose in the world.</p>"
    dots = []
    for verdict, words, colour in FIX_COLOURS:
        there = [each.place for each in replayed.fixes if each.verdict == verdict and each.place is not None]
        if there:
            dots.append(Dots(f"fixes {words}", [p[0] for p in there], [p[1] for p in there], colour, 4.4))
    lines = []
    for name, bad, colour, width in (("pose", False, "#12344d", 1.1), ("pose, not valid", True, panels.ORANGE, 2.2)):
        x, y = _pieces(placed, bad)
        if any(map(math.isfinite, x)):
            lines.append(Curve(name, x, y, colour, width))
    chart = panels.plan("Track", [*dots, *lines])
    origin = replayed.origin
    words = "The antenna's way and the fixes."
    if origin is not None:
        words += (
            f" The origin is at {origin.easting:.1f} E, {origin.northing:.1f} N in UTM zone {origin.zone}"
            f"{'' if origin.north else ' (south)'}."
        )
    return f"<figure>{chart}<figcaption>{words}</figcaption></figure>"


def _pieces(placed: Sequence[StateSample], bad: bool) -> tuple[list[float], list[float]]:
    """Return the track where states are valid, or not (`bad`); nan interrupts it elsewhere, at gaps and new epochs."""
    x: list[float] = []
    y: list[float] = []
    for a, b in pairwise(placed):
        assert a.place is not None
        assert b.place is not None
        if bool(b.invalid) != bad:
            continue
        if b.t - a.t > HELD_S or a.epoch != b.epoch:
            x.append(math.nan)
            y.append(math.nan)
            continue
        if not x or (x[-1], y[-1]) != a.place[:2]:
            x += [math.nan, a.place[0]]
            y += [math.nan, a.place[1]]
        x.append(b.place[0])
        y.append(b.place[1])
    return x, y


# --- validity and events ------------------------------------------------------------------------------------


def _validity(replayed: Replayed) -> str:
    states = replayed.snapshots
    if not states:
        return "<p>No sample could be used.</p>"
    rows = [StripRow("valid", _stretches(states, [not each.invalid for each in states]), panels.GREEN)]
    rows += [
        StripRow(
            (flag.name or "").lower(),
            _stretches(states, [flag in each.invalid for each in states], flag.explain()),
            panels.RED,
        )
        for flag in Invalid
        if any(flag in each.invalid for each in states)
    ]
    rows.append(StripRow("standing", _stretches(states, [each.standing for each in states]), panels.SKY))
    for phase in dict.fromkeys(each.phase for each in states if each.phase is not None):
        rows.append(
            StripRow(
                f"phase {phase.name.lower()}", _stretches(states, [each.phase is phase for each in states]), panels.GREY
            )
        )
    for mode in dict.fromkeys(each.mode for each in states if each.mode is not None):
        rows.append(
            StripRow(
                f"mode {mode.name.lower()}", _stretches(states, [each.mode is mode for each in states]), panels.AMBER
            )
        )
    events = _events(replayed)
    chart = panels.strip("Validity over time", 0.0, replayed.seconds, rows, events)
    table = _table(("at, s", "what happened"), [(f"{when:.1f}", words) for when, words in events[:40]], numbers=(0,))
    more = f"<p>and {len(events) - 40} more</p>" if len(events) > 40 else ""
    return (
        f"<figure>{chart}<figcaption>Reasons for which the pose may not be used, each on its row; upright lines are "
        f"the events below.</figcaption></figure>\n{table if events else '<p>No events.</p>'}{more}"
    )


def _stretches(
    states: Sequence[StateSample], chosen: Sequence[bool], words: str = ""
) -> list[tuple[float, float, str]]:
    """Return from when to when a state is chosen; each counts until the next, for `HELD_S` at most."""
    found: list[tuple[float, float, str]] = []
    for n, each in enumerate(states):
        if not chosen[n]:
            continue
        follower = states[n + 1].t if n + 1 < len(states) else each.t + 0.2
        end = min(follower, each.t + HELD_S)
        if found and each.t - found[-1][1] < 1e-9:
            found[-1] = (found[-1][0], end, words)
        else:
            found.append((each.t, end, words))
    return found


def _events(replayed: Replayed) -> list[tuple[float, str]]:
    """Return what happened once: phases, modes, epochs, and what was taken up."""
    events = [
        (replayed.t(each.utime), f"{each.kind}: {each.reason}" if each.kind != "mode" else each.reason)
        for each in replayed.decisions
        if each.verdict is Verdict.TOOK_UP
    ]
    for before, after in pairwise(replayed.snapshots):
        if before.phase is not after.phase and after.phase is not None:
            events.append((after.t, f"phase {after.phase.name.lower()}"))
        if before.epoch != after.epoch:
            events.append((after.t, f"epoch {after.epoch}: the pose jumped"))
    return sorted(events)


# --- motion -------------------------------------------------------------------------------------------------


def _motion(replayed: Replayed) -> str:
    states = [each for each in replayed.snapshots if each.place is not None]
    if not states:
        return "<p>There was never a pose in the world.</p>"
    t = [each.t for each in states]
    heading = [(90.0 - math.degrees(each.yaw)) % 360.0 for each in states]
    # where it passes north the line is interrupted, and does not run through the whole picture
    broken = [math.nan if n and abs(value - heading[n - 1]) > 180.0 else value for n, value in enumerate(heading)]
    speed = [each.speed for each in states]
    turn = [math.degrees(each.turn) for each in states]
    sigma = [each.sigma for each in states]
    bound = [each.horizontal_bound for each in states]
    yaw = [math.degrees(each.yaw_sigma) for each in states]
    yaw_bound = [math.degrees(each.heading_bound) for each in states]
    drawn = [
        Panel("Heading", Axis("deg", 0.0, 360.0), [Curve("", t, broken)]),
        Panel("Speed, forward", Axis("m/s", *panels.spread(speed, least=0.5)), [Level("", 0.0), Curve("", t, speed)]),
        Panel("Yaw rate", Axis("deg/s", *panels.spread(turn, least=2.0)), [Level("", 0.0), Curve("", t, turn)], 90.0),
        _log_panel("Horizontal position", "m", t, sigma, bound),
        _log_panel("Heading", "deg", t, yaw, yaw_bound),
    ]
    chart = panels.stack("Heading, speed and how sure", 0.0, replayed.seconds, drawn, _epochs(replayed))
    return (
        f"<figure>{chart}<figcaption>Heading is clockwise from grid north. Below: one sigma, and the bound that the "
        "truth is beyond once in the time that localization.filter.risk_per_hour says.</figcaption></figure>"
    )


def _epochs(replayed: Replayed) -> list[tuple[float, str]]:
    return [(when, words) for when, words in _events(replayed) if words.startswith("epoch")]


def _log_panel(title: str, unit: str, t: Sequence[float], sigma: Sequence[float], bound: Sequence[float]) -> Panel:
    known = [value for value in (*sigma, *bound) if math.isfinite(value) and value > 0.0]
    axis = decades(unit, known) if known else Axis(unit, 0.1, 10.0, logarithmic=True)
    return Panel(
        f"{title}: how sure",
        axis,
        [Curve("sigma", t, sigma, panels.BLUE), Curve("bound", t, bound, panels.ORANGE)],
        110.0,
    )


# --- consistency and innovations ----------------------------------------------------------------------------


def _consistency(replayed: Replayed) -> str:
    found = consistency.by_kind(replayed.decisions)
    if not found:
        return f"<p>Nothing was compared: {_why_nothing(replayed)}.</p>"
    rows = [
        (
            each.kind,
            str(each.count),
            str(each.refused),
            f"{each.mean:.2f}",
            f"{each.beyond:.1%}",
            "as stated" if 0.5 <= each.mean <= 1.5 else "errs more" if each.mean > 1.5 else "errs less",
        )
        for each in found
    ]
    head = ("kind", "compared", "refused by the gate", "NIS, mean", "beyond 95 %", "against its sigma")
    curves = []
    colours = iter(panels.PALETTE * 4)
    for each in found:
        if each.count >= 10:
            utimes, means = consistency.running((d for d in replayed.decisions if d.kind == each.kind), NIS_WINDOW_S)
            curves.append(Curve(each.kind, [replayed.t(u) for u in utimes], means, next(colours)))
    axis = Axis("NIS / numbers", 0.01, 100.0, logarithmic=True)
    chart = panels.stack(
        "NIS over time",
        0.0,
        replayed.seconds,
        [Panel(f"NIS, mean of {NIS_WINDOW_S:.0f} s", axis, [Level("expected", 1.0), *curves], 220.0)],
        _epochs(replayed),
    )
    return (
        f"{_table(head, rows, numbers=(1, 2, 3, 4))}\n<figure>{chart}<figcaption>NIS: residuals squared over what was "
        "expected of them. 1 in the mean and 5 % beyond the 95 % limit is as stated. Below 1 a measurement could count "
        "for more; far above 1 it is taken for too good, or something else is wrong. Kinds whose noise lasts are "
        "widened on purpose, since neighbours do not count as new: they lie well below 1.</figcaption></figure>"
    )


def _innovations(replayed: Replayed) -> str:
    kinds: dict[str, list[Decision]] = {}
    for each in replayed.decisions:
        if each.dof:
            kinds.setdefault(each.kind, []).append(each)
    drawn = [
        panel
        for kind, found in sorted(kinds.items())
        for n in range(max(each.dof for each in found))
        if (panel := _innovation(replayed, kind, n, [each for each in found if each.dof > n])) is not None
    ]
    if not drawn:
        return "<p>Nothing was compared.</p>"
    chart = panels.stack("Innovations", 0.0, replayed.seconds, drawn)
    return (
        f"<figure>{chart}<figcaption>Measured less expected, and the 2 sigma that were expected of it: 95 % lie "
        "within, without a pattern. What is beyond a panel stands at its edge.</figcaption></figure>"
    )


def _innovation(replayed: Replayed, kind: str, n: int, found: Sequence[Decision]) -> Panel | None:
    names = COMPONENTS.get(kind, ())
    name = names[n] if n < len(names) and (len(names) > 1 or found[0].dof == 1) else f"number {n + 1}"
    sigma = [2.0 * math.sqrt(max(each.innovation_covariance[n * (each.dof + 1)], 0.0)) for each in found]
    # the first of a kind are expected to be of any size: they would hide all others
    order = sorted(sigma)
    typical = order[int(0.95 * (len(order) - 1))]
    residuals = [each.residual[n] for each in found]
    low, high = panels.spread(residuals, 0.99)
    reach = max(min(1.15 * typical, 12.0 * max(-low, high)), -low, high, 1e-9)
    t = [replayed.t(each.utime) for each in found]
    marks: list[panels.Mark] = [
        Band("2 sigma", t, [-value for value in sigma], sigma, panels.SKY),
        Level("", 0.0),
    ]
    for verdict, colour in (
        (Verdict.MONITORED, panels.AMBER),
        (Verdict.USED, panels.BLUE),
        (Verdict.REJECTED, panels.RED),
    ):
        chosen = [k for k, each in enumerate(found) if each.verdict is verdict]
        if chosen:
            name_of = verdict.name.lower()
            marks.append(Dots(name_of, [t[k] for k in chosen], [residuals[k] for k in chosen], colour, 2.4))
    return Panel(f"{kind}, {name}", Axis("", -reach, reach), marks, 56.0 if kind.startswith("zero_") else 90.0)


# --- states -------------------------------------------------------------------------------------------------

KNOWN_STATES: tuple[tuple[str, tuple[str, ...], str, float], ...] = (
    ("Gyro bias", ("gyro_bias_x", "gyro_bias_y", "gyro_bias_z"), "deg/s", math.degrees(1.0)),
    (
        "Accelerometer bias",
        ("accelerometer_bias_x", "accelerometer_bias_y", "accelerometer_bias_z"),
        "m/s²",
        1.0,
    ),
    ("Wheel scale", ("wheel_scale",), "%", 100.0),
    ("Wheel yaw, the wheels' way to the left of the geometry's x", ("wheel_yaw",), "deg", math.degrees(1.0)),
    ("Latency of fixes", ("gps_latency",), "s", 1.0),
    (
        "What lingers in fixes, in units of their sigma",
        ("gps_wander_east", "gps_wander_north", "gps_wander_up"),
        "sigma",
        1.0,
    ),
)
"""Heading, states, unit and what a state is multiplied by for it; others are drawn as they are."""


def _states(replayed: Replayed) -> str:
    states = [each for each in replayed.snapshots if each.values]
    if not states:
        return f"<p>The filter had no state: {_why_nothing(replayed)}.</p>"
    names = list(dict.fromkeys(name for each in states for name in each.values))
    core = ("position_", "velocity_", "attitude_")
    listed = {name for _, group, _, _ in KNOWN_STATES for name in group}
    own = tuple((name, (name,), "", 1.0) for name in names if name not in listed and not name.startswith(core))
    drawn = []
    for title, group, unit, factor in (*KNOWN_STATES, *own):
        present = [name for name in group if name in names]
        if present:
            drawn.append(_state_panel(states, title, present, unit, factor))
    chart = panels.stack("States", 0.0, replayed.seconds, drawn, _epochs(replayed))
    return (
        f"<figure>{chart}<figcaption>Estimates, each with one sigma around it. A bias settles and stays; one that "
        "follows the turns of the drive stands for something else.</figcaption></figure>"
    )


def _state_panel(states: Sequence[StateSample], title: str, names: Sequence[str], unit: str, factor: float) -> Panel:
    marks: list[panels.Mark] = [Level("", 0.0)]
    lines: list[panels.Mark] = []
    reach: list[float] = [0.0]
    for name, colour in zip(names, panels.PALETTE, strict=False):
        held = [each for each in states if name in each.values]
        t = [each.t for each in held]
        value = [factor * each.values[name] for each in held]
        sigma = [factor * each.sigmas[name] for each in held]
        low = [v - s for v, s in zip(value, sigma, strict=True)]
        high = [v + s for v, s in zip(value, sigma, strict=True)]
        marks.append(Band("", t, low, high, colour))
        lines.append(Curve(name.rsplit("_", 1)[1] if len(names) > 1 else "", t, value, colour))
        settled = len(held) // 10
        reach += [*panels.spread(low[settled:]), *panels.spread(high[settled:]), *panels.spread(value)]
    return Panel(title, Axis(unit, *panels.spread(reach)), [*marks, *lines], 130.0)


# --- sensors and verdicts -----------------------------------------------------------------------------------


def _sensors(replayed: Replayed) -> str:
    rows, table = [], []
    for sensor in replayed.sensors:
        gaps = sensor.gaps()
        rows.append(StripRow(sensor.name, _present(sensor.times, gaps), panels.GREEN))
        longest = max((b - a for a, b in gaps), default=0.0)
        table.append(
            (
                sensor.name,
                str(len(sensor.times)),
                f"{1.0 / sensor.period:.1f}" if sensor.period > 0.0 else "",
                str(len(gaps)),
                f"{longest:.2f}" if gaps else "",
                f"{sum(b - a for a, b in gaps):.1f}" if gaps else "",
            )
        )
    if replayed.frozen:
        rows.append(StripRow("unit frozen", [(a, b, "it repeats one value") for a, b in replayed.frozen], panels.RED))
    if not rows:
        return "<p>No sample could be used.</p>"
    chart = panels.strip("Sensors over time", 0.0, replayed.seconds, rows)
    head = ("source", "samples", "a second", "gaps", "longest, s", "in all, s")
    return (
        f"{_table(head, table, numbers=(1, 2, 3, 4, 5))}\n<figure>{chart}<figcaption>When each source spoke. A gap is "
        "longer than three of its periods and 0.2 s.</figcaption></figure>"
    )


def _present(times: Sequence[float], gaps: Iterable[tuple[float, float]]) -> list[tuple[float, float, str]]:
    found, begin = [], times[0]
    for a, b in gaps:
        found.append((begin, a, ""))
        begin = b
    return [*found, (begin, times[-1], "")]


def _verdicts(replayed: Replayed) -> str:
    counts = Counter((each.kind, each.verdict, each.reason) for each in replayed.decisions)
    rows = [
        (kind, verdict.name.lower().replace("_", " "), reason, str(count))
        for (kind, verdict, reason), count in sorted(counts.items())
    ]
    first = _table(("kind", "verdict", "reason", "count"), rows, numbers=(3,)) if rows else ""
    rejected = [(source, reason, str(count)) for (source, reason), count in sorted(replayed.rejected.items())]
    second = _table(("not used, of", "reason", "count"), rejected, numbers=(2,)) if rejected else ""
    return f"{first}\n{second}" if rows or rejected else f"<p>Nothing was decided: {_why_nothing(replayed)}.</p>"


def _why_nothing(replayed: Replayed) -> str:
    """Return why the filter decided nothing."""
    if replayed.mode is Mode.RAW:
        return "raw mode"
    if replayed.silent:
        return "there is nothing on channel " + ", ".join(channel for _, channel in replayed.silent)
    return "it never came to level, or never knew heading"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    right = frozenset(numbers)

    def cells(row: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=n' if n in right else ''}>{html.escape(safe(each))}</{tag}>" for n, each in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><thead><tr>{cells(head, 'th')}</tr></thead>\n<tbody>{body}</tbody></table>"


def summary(found: Sequence[ReportFinding], path: str) -> list[str]:
    """Return what is printed when the page is written: where it is, and the headlines of its findings."""
    lines = [f"report: {safe(path)}, {counted(len(found), 'finding')}"]
    return lines + [f"  {GRADES[each.grade]}: {safe(each.title)}" for each in found]


STYLE = """
:root { --ink: #1c2430; --soft: #5b6675; --line: #dfe4ea; --paper: #ffffff; --wash: #f5f7f9; }
* { box-sizing: border-box; }
body { font: 15px/1.5 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; color: var(--ink);
  background: var(--paper); max-width: 1120px; margin: 0 auto; padding: 0 24px 40px; }
header { padding: 28px 0 8px; border-bottom: 1px solid var(--line); }
header p { margin: 0; color: var(--soft); }
.kicker { text-transform: uppercase; letter-spacing: .1em; font-size: 12px; }
h1 { margin: 2px 0; font-size: 30px; }
h2 { margin: 38px 0 12px; font-size: 20px; }
h3 { margin: 0 0 2px; font-size: 15px; }
nav { margin: 14px 0 8px; display: flex; flex-wrap: wrap; gap: 4px 18px; }
nav a { color: #0072b2; text-decoration: none; }
nav a:hover { text-decoration: underline; }
.figures { display: flex; flex-wrap: wrap; gap: 10px; margin: 18px 0 6px; }
.figures div { flex: 1 1 130px; background: var(--wash); border-radius: 8px; padding: 10px 14px; }
.figures strong { display: block; font-size: 20px; font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: 13px; }
.finding { border-left: 4px solid var(--tone); background: var(--wash); border-radius: 0 8px 8px 0;
  padding: 10px 16px; margin: 8px 0; }
.finding p { margin: 2px 0; }
.finding p + p { color: var(--soft); }
.finding h3 span { color: var(--tone); text-transform: uppercase; font-size: 11px; letter-spacing: .06em;
  margin-right: 6px; }
.wrong { --tone: #c22f2f; } .doubtful { --tone: #b36b00; } .note { --tone: #0072b2; }
.good { border-left: 4px solid #009e73; background: var(--wash); padding: 10px 16px; }
figure { margin: 14px 0; }
figcaption { color: var(--soft); font-size: 13px; margin: 4px 0 0 8px; max-width: 90ch; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 10px 0; }
th, td { text-align: left; padding: 4px 18px 4px 4px; border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); font-size: 13px; }
.n { text-align: right; }
svg { width: 100%; height: auto; display: block; }
svg text { font: 11.5px system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; fill: #3c4654; }
svg .title { font-weight: 600; font-size: 13px; fill: #1c2430; }
svg .box { fill: #fbfcfd; stroke: #c6cdd6; }
svg .grid { stroke: #e6eaef; }
svg .track { fill: #f0f2f5; }
svg .band { opacity: .22; }
svg .event { stroke: #7a4fb5; stroke-dasharray: 2 2; }
footer { margin-top: 40px; color: var(--soft); font-size: 13px; border-top: 1px solid var(--line); padding-top: 10px; }
@media print { body { max-width: none; } section { break-inside: avoid; } nav { display: none; } }
"""
