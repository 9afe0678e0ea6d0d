"""Report on a replay: one self-contained HTML page with findings, tables and charts."""

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
from mstools.report.findings import collect_findings
from mstools.report.panels import Band, Curve, Dots, HorizontalLine, Panel, StripRow
from mstools.report.replay_data import FindingLevel, ReplayData, ReportFinding, StateSample
from mstools.report.svg import Axis, decade_axis
from mstools.terminal.output import escape, format_count

HOLD_S = 1.0
"""Seconds for which a state holds without a newer one."""

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
"""Names of the components of each kind of measurement; those of other kinds are numbered."""

LEVEL_NAMES = {FindingLevel.ERROR: "error", FindingLevel.WARNING: "warning", FindingLevel.NOTE: "note"}


def render_page(data: ReplayData) -> str:
    """Return the HTML page."""
    found = collect_findings(data)
    sections = [
        ("findings", "Findings", _render_findings(found)),
        ("track", "Track", _render_track(data)),
        ("validity", "Validity and events", _render_validity(data)),
        ("motion", "Heading, speed and uncertainty", _render_motion(data)),
        ("consistency", "Consistency", _render_consistency(data)),
        ("innovations", "Innovations", _render_innovations(data)),
        ("states", "Biases, wheels and other states", _render_states(data)),
        ("sensors", "Sensors", _render_sensors(data)),
        ("verdicts", "Verdicts", _render_verdicts(data)),
    ]
    links = " ".join(f'<a href="#{name}">{title}</a>' for name, title, _ in sections)
    body = "\n".join(
        f'<section id="{name}"><h2>{title}</h2>\n{content}\n</section>' for name, title, content in sections
    )
    name = html.escape(escape(data.vehicle))
    log = html.escape(escape(data.log))
    began = datetime.fromtimestamp(data.first_utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
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
<p>{log}, start {began}, {data.duration:.0f} s</p>
{_render_key_figures(data)}
<nav>{links}</nav>
</header>
{body}
<footer>modelserver {__version__}; docs/tuning.md explains each chart</footer>
</body>
</html>
"""


# --- key figures and findings -------------------------------------------------------------------------------


def _render_key_figures(data: ReplayData) -> str:
    states = data.snapshots
    # integral of the speed: the noise of positions while stationary does not count
    distance = sum(
        abs(b.speed) * (b.t - a.t) for a, b in pairwise(states) if math.isfinite(b.speed) and b.t - a.t < HOLD_S
    )
    driven = (f"{distance:.0f} m", "driven")
    if not any(math.isfinite(each.speed) for each in states):
        raw = data.sensor_motion.distance_travelled()
        by = "wheels" if data.sensor_motion.wheels else "fixes"
        driven = (f"{raw:.0f} m", f"driven, by the {by}") if math.isfinite(raw) else ("unknown", "driven")
    sigmas = sorted(each.sigma for each in states if math.isfinite(each.sigma))
    verdicts = Counter(each.verdict for each in data.fixes)
    figures = [
        (f"{data.duration:.0f} s", "recorded"),
        driven,
        (f"{_valid_share(data):.1%}", "of the time valid"),
        (f"{verdicts['used']} of {len(data.fixes)}", "fixes used as positions"),
        (f"{verdicts['rejected']}", "positions rejected"),
        (f"{sigmas[len(sigmas) // 2]:.2f} m" if sigmas else "none", "median position sigma"),
    ]
    cells = "".join(f"<div><strong>{value}</strong><span>{what}</span></div>" for value, what in figures)
    return f'<div class="figures">{cells}</div>\n<p>{html.escape(_describe_key_figures(data))}</p>'


def _valid_share(data: ReplayData) -> float:
    """Return the share of the recorded time in which the state was valid."""
    held = [min(b.t - a.t, HOLD_S) for a, b in pairwise(data.snapshots) if not a.invalid and b.t > a.t]
    return min(sum(held) / data.duration, 1.0) if data.duration > 0.0 else 0.0


def _describe_key_figures(data: ReplayData) -> str:
    """Return an explanation of the key figures and of the fixes that were not used."""
    verdicts = Counter(each.verdict for each in data.fixes)
    words = ["Valid: share of the recorded time, from the log's first event on."]
    if data.fixes:
        rest = [
            f"{format_count(verdicts[verdict], 'fix', 'fixes')} {what}"
            for verdict, what in (
                ("monitored", "monitored (stationary or unused)"),
                ("reset", "reset the position"),
                ("", "without a decision (before heading alignment, or pending at the end)"),
            )
            if verdicts[verdict]
        ]
        if rest:
            words.append(f"Of the fixes not used as positions (gps_position): {', '.join(rest)}.")
        heights = sum(each.kind == "gps_height" and each.verdict is Verdict.REJECTED for each in data.decisions)
        if heights:
            words.append(f"{format_count(heights, 'height')} (gps_height) of fixes rejected.")
    return " ".join(words)


def _render_findings(found: Sequence[ReportFinding]) -> str:
    if not found:
        return '<p class="good">No findings. Compare the charts below with docs/tuning.md.</p>'
    return "\n".join(
        f'<div class="finding {LEVEL_NAMES[each.level]}"><h3><span>{LEVEL_NAMES[each.level]}</span> '
        f"{html.escape(escape(each.title))}</h3><p>{html.escape(escape(each.observation))}</p>"
        f"<p>{html.escape(escape(each.advice))}</p></div>"
        for each in found
    )


# --- track --------------------------------------------------------------------------------------------------

FIX_COLORS = (
    ("monitored", "monitored", panels.SKY),
    ("", "before heading alignment", panels.GRAY),
    ("used", "used", panels.GREEN),
    ("reset", "position reset", panels.AMBER),
    ("rejected", "rejected", panels.RED),
)


def _render_track(data: ReplayData) -> str:
    placed = [each for each in data.snapshots if each.position is not None]
    if not placed:
        return "<p>No pose in the world.</p>"
    dots = []
    for verdict, words, color in FIX_COLORS:
        there = [each.position for each in data.fixes if each.verdict == verdict and each.position is not None]
        if there:
            dots.append(Dots(f"fixes {words}", [p[0] for p in there], [p[1] for p in there], color, 4.4))
    lines = []
    for name, bad, color, width in (("pose", False, "#12344d", 1.1), ("pose, not valid", True, panels.ORANGE, 2.2)):
        x, y = _track_points(placed, bad)
        if any(map(math.isfinite, x)):
            lines.append(Curve(name, x, y, color, width))
    chart = panels.render_map("Track", [*dots, *lines])
    origin = data.origin
    words = "Path of the antenna, and the fixes."
    if origin is not None:
        words += (
            f" The origin is at {origin.easting:.1f} E, {origin.northing:.1f} N in UTM zone {origin.zone}"
            f"{'' if origin.north else ' (south)'}."
        )
    return f"<figure>{chart}<figcaption>{words}</figcaption></figure>"


def _track_points(placed: Sequence[StateSample], bad: bool) -> tuple[list[float], list[float]]:
    """Return the track of the valid, or invalid (`bad`), states; nan interrupts it at gaps and new epochs."""
    x: list[float] = []
    y: list[float] = []
    for a, b in pairwise(placed):
        assert a.position is not None
        assert b.position is not None
        if bool(b.invalid) != bad:
            continue
        if b.t - a.t > HOLD_S or a.epoch != b.epoch:
            x.append(math.nan)
            y.append(math.nan)
            continue
        if not x or (x[-1], y[-1]) != a.position[:2]:
            x += [math.nan, a.position[0]]
            y += [math.nan, a.position[1]]
        x.append(b.position[0])
        y.append(b.position[1])
    return x, y


# --- validity and events ------------------------------------------------------------------------------------


def _render_validity(data: ReplayData) -> str:
    states = data.snapshots
    if not states:
        return "<p>No sample could be used.</p>"
    rows = [StripRow("valid", _intervals(states, [not each.invalid for each in states]), panels.GREEN)]
    rows += [
        StripRow(
            (flag.name or "").lower(),
            _intervals(states, [flag in each.invalid for each in states], flag.explain()),
            panels.RED,
        )
        for flag in Invalid
        if any(flag in each.invalid for each in states)
    ]
    rows.append(StripRow("stationary", _intervals(states, [each.is_stationary for each in states]), panels.SKY))
    for phase in dict.fromkeys(each.phase for each in states if each.phase is not None):
        rows.append(
            StripRow(
                f"phase {phase.name.lower()}", _intervals(states, [each.phase is phase for each in states]), panels.GRAY
            )
        )
    for mode in dict.fromkeys(each.mode for each in states if each.mode is not None):
        rows.append(
            StripRow(
                f"mode {mode.name.lower()}", _intervals(states, [each.mode is mode for each in states]), panels.AMBER
            )
        )
    events = _events(data)
    chart = panels.render_strip("Validity over time", 0.0, data.duration, rows, events)
    table = _render_table(
        ("at, s", "what happened"), [(f"{when:.1f}", words) for when, words in events[:40]], numbers=(0,)
    )
    more = f"<p>and {len(events) - 40} more</p>" if len(events) > 40 else ""
    return (
        f"<figure>{chart}<figcaption>Reasons for which the pose is invalid, each on its row; vertical lines are "
        f"the events below.</figcaption></figure>\n{table if events else '<p>No events.</p>'}{more}"
    )


def _intervals(
    states: Sequence[StateSample], chosen: Sequence[bool], words: str = ""
) -> list[tuple[float, float, str]]:
    """Return the intervals in which a state is chosen; each state holds until the next, for `HOLD_S` at most."""
    found: list[tuple[float, float, str]] = []
    for n, each in enumerate(states):
        if not chosen[n]:
            continue
        follower = states[n + 1].t if n + 1 < len(states) else each.t + 0.2
        end = min(follower, each.t + HOLD_S)
        if found and each.t - found[-1][1] < 1e-9:
            found[-1] = (found[-1][0], end, words)
        else:
            found.append((each.t, end, words))
    return found


def _events(data: ReplayData) -> list[tuple[float, str]]:
    """Return single events: phases, modes, epochs, resets."""
    events = [
        (data.to_seconds(each.utime), f"{each.kind}: {each.reason}" if each.kind != "mode" else each.reason)
        for each in data.decisions
        if each.verdict is Verdict.RESET
    ]
    for before, after in pairwise(data.snapshots):
        if before.phase is not after.phase and after.phase is not None:
            events.append((after.t, f"phase {after.phase.name.lower()}"))
        if before.epoch != after.epoch:
            events.append((after.t, f"epoch {after.epoch}: pose jump"))
    return sorted(events)


# --- motion -------------------------------------------------------------------------------------------------


def _render_motion(data: ReplayData) -> str:
    states = [each for each in data.snapshots if each.position is not None]
    if not states:
        return "<p>No pose in the world.</p>"
    t = [each.t for each in states]
    heading = [(90.0 - math.degrees(each.yaw)) % 360.0 for each in states]
    # the line is interrupted where heading wraps at north
    broken = [math.nan if n and abs(value - heading[n - 1]) > 180.0 else value for n, value in enumerate(heading)]
    speed = [each.speed for each in states]
    turn = [math.degrees(each.yaw_rate) for each in states]
    sigma = [each.sigma for each in states]
    bound = [each.horizontal_protection_level for each in states]
    yaw = [math.degrees(each.yaw_sigma) for each in states]
    yaw_bound = [math.degrees(each.heading_protection_level) for each in states]
    drawn = [
        Panel("Heading", Axis("deg", 0.0, 360.0), [Curve("", t, broken)]),
        Panel(
            "Speed, forward",
            Axis("m/s", *panels.value_range(speed, min_width=0.5)),
            [HorizontalLine("", 0.0), Curve("", t, speed)],
        ),
        Panel(
            "Yaw rate",
            Axis("deg/s", *panels.value_range(turn, min_width=2.0)),
            [HorizontalLine("", 0.0), Curve("", t, turn)],
            90.0,
        ),
        _uncertainty_panel("Horizontal position", "m", t, sigma, bound),
        _uncertainty_panel("Heading", "deg", t, yaw, yaw_bound),
    ]
    chart = panels.render_panels("Heading, speed and uncertainty", 0.0, data.duration, drawn, _epochs(data))
    return (
        f"<figure>{chart}<figcaption>Heading is clockwise from grid north. Below: one sigma, and the protection level "
        "at the integrity risk localization.filter.risk_per_hour.</figcaption></figure>"
    )


def _epochs(data: ReplayData) -> list[tuple[float, str]]:
    return [(when, words) for when, words in _events(data) if words.startswith("epoch")]


def _uncertainty_panel(
    title: str, unit: str, t: Sequence[float], sigma: Sequence[float], bound: Sequence[float]
) -> Panel:
    known = [value for value in (*sigma, *bound) if math.isfinite(value) and value > 0.0]
    axis = decade_axis(unit, known) if known else Axis(unit, 0.1, 10.0, is_logarithmic=True)
    return Panel(
        f"{title}: uncertainty",
        axis,
        [Curve("sigma", t, sigma, panels.BLUE), Curve("protection level", t, bound, panels.ORANGE)],
        110.0,
    )


# --- consistency and innovations ----------------------------------------------------------------------------


def _render_consistency(data: ReplayData) -> str:
    found = consistency.compute_consistency(data.decisions)
    if not found:
        return f"<p>No innovations: {_explain_no_decisions(data)}.</p>"
    rows = [
        (
            each.kind,
            str(each.count),
            str(each.rejected),
            f"{each.mean:.2f}",
            f"{each.beyond:.1%}",
            "consistent" if 0.5 <= each.mean <= 1.5 else "too large" if each.mean > 1.5 else "too small",
        )
        for each in found
    ]
    head = ("kind", "compared", "rejected by the gate", "mean NIS", "beyond 95 %", "errors for its sigma")
    curves = []
    colors = iter(panels.PALETTE * 4)
    for each in found:
        if each.count >= 10:
            utimes, means = consistency.compute_running_nis(
                (d for d in data.decisions if d.kind == each.kind), NIS_WINDOW_S
            )
            curves.append(Curve(each.kind, [data.to_seconds(u) for u in utimes], means, next(colors)))
    axis = Axis("NIS / dof", 0.01, 100.0, is_logarithmic=True)
    chart = panels.render_panels(
        "NIS over time",
        0.0,
        data.duration,
        [Panel(f"NIS, mean of {NIS_WINDOW_S:.0f} s", axis, [HorizontalLine("expected", 1.0), *curves], 220.0)],
        _epochs(data),
    )
    return (
        f"{_render_table(head, rows, numbers=(1, 2, 3, 4))}\n<figure>{chart}<figcaption>NIS per degree of freedom: "
        "mean 1 and 5 % beyond the 95 % limit are consistent. Below 1 the sigma is larger than necessary; far above 1 "
        "it is too small, or something else is wrong. Time-correlated kinds have their noise inflated on purpose and "
        "lie well below 1.</figcaption></figure>"
    )


def _render_innovations(data: ReplayData) -> str:
    kinds: dict[str, list[Decision]] = {}
    for each in data.decisions:
        if each.dof:
            kinds.setdefault(each.kind, []).append(each)
    drawn = [
        panel
        for kind, found in sorted(kinds.items())
        for n in range(max(each.dof for each in found))
        if (panel := _innovation_panel(data, kind, n, [each for each in found if each.dof > n])) is not None
    ]
    if not drawn:
        return "<p>No innovations.</p>"
    chart = panels.render_panels("Innovations", 0.0, data.duration, drawn)
    return (
        f"<figure>{chart}<figcaption>Measured minus predicted, with 2 sigma: 95 % lie within, without a pattern. "
        "Points beyond a panel are drawn at its edge.</figcaption></figure>"
    )


def _innovation_panel(data: ReplayData, kind: str, n: int, found: Sequence[Decision]) -> Panel | None:
    names = COMPONENTS.get(kind, ())
    name = names[n] if n < len(names) and (len(names) > 1 or found[0].dof == 1) else f"component {n + 1}"
    sigma = [2.0 * math.sqrt(max(each.innovation_covariance[n * (each.dof + 1)], 0.0)) for each in found]
    # the first innovations of a kind may have any size: they would hide all others
    order = sorted(sigma)
    typical = order[int(0.95 * (len(order) - 1))]
    residuals = [each.residual[n] for each in found]
    low, high = panels.value_range(residuals, 0.99)
    reach = max(min(1.15 * typical, 12.0 * max(-low, high)), -low, high, 1e-9)
    t = [data.to_seconds(each.utime) for each in found]
    marks: list[panels.Mark] = [
        Band("2 sigma", t, [-value for value in sigma], sigma, panels.SKY),
        HorizontalLine("", 0.0),
    ]
    for verdict, color in (
        (Verdict.MONITORED, panels.AMBER),
        (Verdict.USED, panels.BLUE),
        (Verdict.REJECTED, panels.RED),
    ):
        chosen = [k for k, each in enumerate(found) if each.verdict is verdict]
        if chosen:
            name_of = verdict.name.lower()
            marks.append(Dots(name_of, [t[k] for k in chosen], [residuals[k] for k in chosen], color, 2.4))
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
    ("Wheel yaw: rolling direction to the left of the geometry's x", ("wheel_yaw",), "deg", math.degrees(1.0)),
    ("Latency of fixes", ("gps_latency",), "s", 1.0),
    (
        "Time-correlated GNSS error, in units of sigma",
        ("gps_wander_east", "gps_wander_north", "gps_wander_up"),
        "sigma",
        1.0,
    ),
)
"""Title, states, unit and conversion factor; other states are drawn as they are."""


def _render_states(data: ReplayData) -> str:
    states = [each for each in data.snapshots if each.values]
    if not states:
        return f"<p>The filter had no state: {_explain_no_decisions(data)}.</p>"
    names = list(dict.fromkeys(name for each in states for name in each.values))
    core = ("position_", "velocity_", "attitude_")
    listed = {name for _, group, _, _ in KNOWN_STATES for name in group}
    own = tuple((name, (name,), "", 1.0) for name in names if name not in listed and not name.startswith(core))
    drawn = []
    for title, group, unit, factor in (*KNOWN_STATES, *own):
        present = [name for name in group if name in names]
        if present:
            drawn.append(_state_panel(states, title, present, unit, factor))
    chart = panels.render_panels("States", 0.0, data.duration, drawn, _epochs(data))
    return (
        f"<figure>{chart}<figcaption>Estimates with one sigma. A bias settles and stays; one that follows the turns of "
        "the drive absorbs another error.</figcaption></figure>"
    )


def _state_panel(states: Sequence[StateSample], title: str, names: Sequence[str], unit: str, factor: float) -> Panel:
    marks: list[panels.Mark] = [HorizontalLine("", 0.0)]
    lines: list[panels.Mark] = []
    reach: list[float] = [0.0]
    for name, color in zip(names, panels.PALETTE, strict=False):
        held = [each for each in states if name in each.values]
        t = [each.t for each in held]
        value = [factor * each.values[name] for each in held]
        sigma = [factor * each.sigmas[name] for each in held]
        low = [v - s for v, s in zip(value, sigma, strict=True)]
        high = [v + s for v, s in zip(value, sigma, strict=True)]
        marks.append(Band("", t, low, high, color))
        lines.append(Curve(name.rsplit("_", 1)[1] if len(names) > 1 else "", t, value, color))
        settled = len(held) // 10
        reach += [*panels.value_range(low[settled:]), *panels.value_range(high[settled:]), *panels.value_range(value)]
    return Panel(title, Axis(unit, *panels.value_range(reach)), [*marks, *lines], 130.0)


# --- sensors and verdicts -----------------------------------------------------------------------------------


def _render_sensors(data: ReplayData) -> str:
    rows, table = [], []
    for sensor in data.sensors:
        gaps = sensor.find_gaps()
        rows.append(StripRow(sensor.name, _present_intervals(sensor.times, gaps), panels.GREEN))
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
    if data.frozen:
        rows.append(StripRow("IMU frozen", [(a, b, "repeats one sample") for a, b in data.frozen], panels.RED))
    if not rows:
        return "<p>No sample could be used.</p>"
    chart = panels.render_strip("Sensors over time", 0.0, data.duration, rows)
    head = ("source", "samples", "rate, Hz", "gaps", "longest, s", "total, s")
    return (
        f"{_render_table(head, table, numbers=(1, 2, 3, 4, 5))}\n<figure>{chart}<figcaption>Samples of each source. A "
        "gap exceeds three periods and 0.2 s.</figcaption></figure>"
    )


def _present_intervals(times: Sequence[float], gaps: Iterable[tuple[float, float]]) -> list[tuple[float, float, str]]:
    found, begin = [], times[0]
    for a, b in gaps:
        found.append((begin, a, ""))
        begin = b
    return [*found, (begin, times[-1], "")]


def _render_verdicts(data: ReplayData) -> str:
    counts = Counter((each.kind, each.verdict, each.reason) for each in data.decisions)
    rows = [
        (kind, verdict.name.lower().replace("_", " "), reason, str(count))
        for (kind, verdict, reason), count in sorted(counts.items())
    ]
    first = _render_table(("kind", "verdict", "reason", "count"), rows, numbers=(3,)) if rows else ""
    rejected = [(source, reason, str(count)) for (source, reason), count in sorted(data.rejected.items())]
    second = _render_table(("rejected, source", "reason", "count"), rejected, numbers=(2,)) if rejected else ""
    return f"{first}\n{second}" if rows or rejected else f"<p>No decisions: {_explain_no_decisions(data)}.</p>"


def _explain_no_decisions(data: ReplayData) -> str:
    """Return why the filter decided nothing."""
    if data.mode is Mode.RAW:
        return "raw mode"
    if data.missing_channels:
        return "no messages on channel " + ", ".join(channel for _, channel in data.missing_channels)
    return "leveling or heading alignment was never completed"


def _render_table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    right = frozenset(numbers)

    def cells(row: Sequence[str], tag: str) -> str:
        return "".join(
            f"<{tag}{' class=n' if n in right else ''}>{html.escape(escape(each))}</{tag}>"
            for n, each in enumerate(row)
        )

    body = "\n".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return f"<table><thead><tr>{cells(head, 'th')}</tr></thead>\n<tbody>{body}</tbody></table>"


def format_summary(found: Sequence[ReportFinding], path: str) -> list[str]:
    """Return the lines to print: the path of the page, and the headlines of its findings."""
    lines = [f"report: {escape(path)}, {format_count(len(found), 'finding')}"]
    return lines + [f"  {LEVEL_NAMES[each.level]}: {escape(each.title)}" for each in found]


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
.error { --tone: #c22f2f; } .warning { --tone: #b36b00; } .note { --tone: #0072b2; }
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
