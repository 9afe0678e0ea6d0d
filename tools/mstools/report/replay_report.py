"""Report on a replay: one self-contained HTML page with findings, tables and charts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from itertools import cycle, pairwise

from modelserver.errors import Severity
from modelserver.messages import Decision, Invalid, Mode, Verdict
from mstools.report import charts
from mstools.report.charts import (
    Answer,
    Axis,
    Panel,
    Series,
    StripRow,
    decade_axis,
    escape_text,
    level,
    render_figure,
    render_key_figures,
    render_table,
    value_range,
)
from mstools.report.findings import (
    ReportFinding,
    check_validity,
    collect_findings,
    compute_consistency,
    compute_running_nis,
)
from mstools.report.replay_data import HOLD_S, ReplayData, StateSample, integrate_distance
from mstools.report.validity import ValiditySummary, summarize_validity
from mstools.terminal.health import format_duration
from mstools.terminal.output import escape, format_count

NIS_WINDOW_S = 20.0

BREAK = (math.nan, math.nan, math.nan)
"""Point that interrupts a line."""

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


def render_page(data: ReplayData) -> str:
    answer, found = make_answer(data)
    sections = [
        ("findings", "Findings", _render_findings(found)),
        ("track", "Track", _render_track(data)),
        ("validity", "Validity and events", _render_validity(data)),
        ("motion", "Heading, speed and uncertainty", _render_motion(data)),
        ("consistency", "Consistency", _render_consistency(data)),
        ("innovations", "Innovations", _render_innovations(data)),
        ("states", "Biases, wheels and other states", _render_states(data)),
        ("verdicts", "Verdicts", _render_verdicts(data)),
    ]
    began = datetime.fromtimestamp(data.first_utime * 1e-6, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    heads = ("Replay report", data.vehicle, f"{data.log}, start {began}, {data.duration:.0f} s")
    title = f"{data.vehicle}: replay of {data.log}"
    summary = charts.render_answer(answer) + _render_key_figures(data)
    return charts.render_report(title, heads, summary, sections, "docs/tuning.md explains each chart")


def format_summary(data: ReplayData, path: str) -> list[str]:
    """Return the lines to print: the answer, the path of the page, and the headlines of its findings."""
    answer, found = make_answer(data)
    lines = [answer.headline, *(f"  {escape(each)}" for each in answer.lines)]
    lines.append(f"report: {escape(path)}, {format_count(len(found), 'finding')}")
    return lines + [f"  {each.level}: {escape(each.title)}" for each in found]


# --- the answer ---------------------------------------------------------------------------------------------


def make_answer(data: ReplayData) -> tuple[Answer, list[ReportFinding]]:
    """Return the share of the time with a valid pose, the main reason of the rest and its remedy; and the findings.

    The first error among the findings is the probable cause of poses that are invalid for long, and its remedy theirs.
    The findings are without those on validity, which the answer has.
    """
    on_validity = list(check_validity(data))
    found = [each for each in collect_findings(data) if each not in on_validity]
    cause = next((each for each in found if each.level is Severity.ERROR), None)
    summary = summarize_validity(data)
    if math.isnan(summary.first_valid):
        headline, tone = f"Never valid in {format_duration(summary.duration)}", Severity.ERROR
    else:
        headline = f"Valid {summary.share:.1%} of {format_duration(summary.duration)}"
        headline += f", from {format_duration(summary.first_valid)} on" if summary.first_valid > HOLD_S else ""
        is_whole = not summary.reasons_after
        headline += " without interruption" if is_whole else ""
        tone = min((each.level for each in (*on_validity, *found)), key=list(Severity).index, default=Severity.NOTE)
        if not found and is_whole:
            return Answer("good", f"{headline}; no findings"), found
    reason = _describe_main_reason(summary)
    lines = [] if reason is None else [reason[0]]
    if cause is not None:
        kind = "Probable cause" if on_validity else "Main finding"
        lines.append(f"{kind}: {cause.title}. {cause.advice}")
    elif reason is not None:
        lines.append(f"Remedy: {reason[1]}.")
    return Answer("good" if tone is Severity.NOTE else str(tone), headline, lines), found


def _describe_main_reason(summary: ValiditySummary) -> tuple[str, str] | None:
    """Return the main reason of the time without a valid pose in a sentence, and its remedy; None without one."""
    reasons, total, when = summary.reasons, summary.invalid, "without a valid pose"
    if summary.is_interrupted:
        reasons, total, when = summary.reasons_after, summary.invalid_after, "not valid after the first valid pose"
    if not reasons or total <= 0.0:
        return None
    share = f"{reasons[0].seconds / total:.0%} of the {format_duration(total)} {when}"
    return f"Main reason: {reasons[0].reason}, {share}.", reasons[0].remedy


# --- parts of the page --------------------------------------------------------------------------------------


def _time_axis(data: ReplayData) -> Axis:
    return Axis("seconds into the log", 0.0, max(data.duration, 1e-3))


# --- key figures and findings -------------------------------------------------------------------------------


def _render_key_figures(data: ReplayData) -> str:
    states = data.snapshots
    distance = integrate_distance(states)
    sigmas = sorted(each.sigma for each in states if math.isfinite(each.sigma))
    verdicts = Counter(each.verdict for each in data.fixes)
    figures = [
        (f"{distance:.0f} m", "driven"),
        (f"{verdicts['used']} of {len(data.fixes)}", "fixes used as positions"),
        (f"{verdicts['rejected']}", "positions rejected"),
        (f"{sigmas[len(sigmas) // 2]:.2f} m" if sigmas else "none", "median position sigma"),
    ]
    return render_key_figures(figures)


def _render_findings(found: Sequence[ReportFinding]) -> str:
    if not found:
        return "<p>No findings. Compare the charts below with docs/tuning.md.</p>"
    return "\n".join(
        f'<div class="finding {each.level}"><h3><span>{each.level}</span> '
        f"{escape_text(each.title)}</h3><p>{escape_text(each.observation)}</p><p>{escape_text(each.advice)}</p></div>"
        for each in found
    )


# --- track --------------------------------------------------------------------------------------------------

FIX_COLORS = (
    ("monitored", "monitored", charts.SKY),
    ("", "before heading alignment", charts.GRAY),
    ("used", "used", charts.GREEN),
    ("reset", "position reset", charts.AMBER),
    ("rejected", "rejected", charts.RED),
)


def _render_track(data: ReplayData) -> str:
    placed = [each for each in data.snapshots if each.position is not None]
    if not placed:
        return "<p>No pose in the world.</p>"
    drawn = []
    for verdict, words, color in FIX_COLORS:
        there = [each.position for each in data.fixes if each.verdict == verdict and each.position is not None]
        if there:
            drawn.append(charts.dots(f"fixes {words}", there, color, 4.4))
    for name, bad, color, width in (("pose", False, charts.BLUE, 1.2), ("pose, not valid", True, charts.ORANGE, 2.2)):
        points = _track_points(placed, bad)
        if any(math.isfinite(each[0]) for each in points):
            x, y, t = zip(*points, strict=True)
            drawn.append(Series(name, x, y, color, width, times=t))
    words = "Path of the antenna, and the fixes."
    if data.origin is not None:
        words += (
            f" The origin is at {data.origin.easting:.1f} E, {data.origin.northing:.1f} N in UTM zone "
            f"{data.origin.zone}{'' if data.origin.north else ' (south)'}."
        )
    chart = charts.render_map("Track", "east of the origin, m", "north of the origin, m", drawn)
    return render_figure(chart, words)


def _track_points(placed: Sequence[StateSample], bad: bool) -> list[tuple[float, float, float]]:
    """Return x, y and time of the valid, or invalid (`bad`), states; nan interrupts them at gaps and new epochs."""
    points: list[tuple[float, float, float]] = [BREAK]
    for a, b in pairwise(placed):
        assert a.position is not None
        assert b.position is not None
        if bool(b.invalid) != bad:
            continue
        if b.t - a.t > HOLD_S or a.epoch != b.epoch:
            points.append(BREAK)
            continue
        if points[-1][2] != a.t:
            points += [BREAK, (*a.position[:2], a.t)]
        points.append((*b.position[:2], b.t))
    return points


# --- validity and events ------------------------------------------------------------------------------------


def _render_validity(data: ReplayData) -> str:
    states = data.snapshots
    if not states:
        return "<p>No sample could be used.</p>"

    def row(name: str, chosen: Iterable[bool], color: str, words: str = "") -> StripRow:
        return StripRow(name, _intervals(states, list(chosen), words), color)

    rows = [
        row("valid", (not each.invalid for each in states), charts.GREEN),
        *(
            row(str(flag.name).lower(), (flag in each.invalid for each in states), charts.RED, flag.explain())
            for flag in Invalid
        ),
        row("stationary", (each.is_stationary for each in states), charts.SKY),
    ]
    rows = [each for each in rows if each.intervals or each.name in ("valid", "stationary")]
    events = _events(data)
    chart = charts.render_strip("Validity over time", _time_axis(data), rows, events)
    listed = [(f"{when:.1f}", words) for when, words in events[:40]]
    table = render_table(("at, s", "what happened"), listed, numbers=(0,)) if events else "<p>No events.</p>"
    more = f"<p>and {len(events) - 40} more</p>" if len(events) > 40 else ""
    words = "Reasons for which the pose is invalid, each on its row; vertical lines are the events below."
    return f"{_render_reasons(data)}{render_figure(chart, words)}\n{table}{more}"


def _render_reasons(data: ReplayData) -> str:
    summary = summarize_validity(data)
    rows = [
        (each.reason, f"{each.seconds:.1f}", f"{each.seconds / summary.duration:.1%}", each.remedy)
        for each in summary.reasons
        if summary.duration
    ]
    head = ("reason", "s", "of the log", "remedy")
    return render_table(head, rows, numbers=(1, 2)) if rows else "<p>The pose was always valid.</p>"


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
    x = _time_axis(data)
    drawn = [Panel("Heading", Axis("deg", 0.0, 360.0), [Series("", t, broken)])]
    for title, unit, values, width, height in (
        ("Speed, forward", "m/s", [each.speed for each in states], 0.5, 120.0),
        ("Yaw rate", "deg/s", [math.degrees(each.yaw_rate) for each in states], 2.0, 90.0),
    ):
        axis = Axis(unit, *value_range(values, min_width=width))
        drawn.append(Panel(title, axis, [level("", x, 0.0), Series("", t, values)], height))
    for title, unit, convert, sigma, what in (
        ("Horizontal position", "m", float, "sigma", "horizontal"),
        ("Heading", "deg", math.degrees, "yaw_sigma", "heading"),
    ):
        lines = [
            Series(words, t, [convert(getattr(each, field)) for each in states], color)
            for words, field, color in (
                ("sigma", sigma, charts.BLUE),
                ("level (1e-4)", f"{what}_level", charts.GREEN),
                ("protection level", f"{what}_protection_level", charts.ORANGE),
            )
        ]
        axis = decade_axis(unit, [value for line in lines for value in line.y])
        drawn.append(Panel(f"{title}: uncertainty", axis, lines, 110.0))
    chart = charts.render_panels("Heading, speed and uncertainty", x, drawn, _epochs(data))
    return render_figure(
        chart,
        "Heading is clockwise from grid north. Below: one sigma, the level exceeded with a probability of 1e-4 at an "
        "instant, and the protection level at the integrity risk localization.filter.risk_per_hour.",
    )


def _epochs(data: ReplayData) -> list[tuple[float, str]]:
    return [(when, words) for when, words in _events(data) if words.startswith("epoch")]


# --- consistency and innovations ----------------------------------------------------------------------------


def _render_consistency(data: ReplayData) -> str:
    found = compute_consistency(data.decisions)
    if not found:
        return f"<p>No innovations: {_explain_no_decisions(data)}.</p>"
    rows = []
    for each in found:
        words = "consistent" if 0.5 <= each.mean <= 1.5 else "too large" if each.mean > 1.5 else "too small"
        rows.append((each.kind, f"{each.count}", f"{each.rejected}", f"{each.mean:.2f}", f"{each.beyond:.1%}", words))
    head = ("kind", "compared", "rejected by the gate", "mean NIS", "beyond 95 %", "errors for its sigma")
    x = _time_axis(data)
    drawn = [level("expected", x, 1.0)]
    for each, color in zip([each for each in found if each.count >= 10], cycle(charts.PALETTE), strict=False):
        of_kind = (decision for decision in data.decisions if decision.kind == each.kind)
        utimes, means = compute_running_nis(of_kind, NIS_WINDOW_S)
        drawn.append(Series(each.kind, list(map(data.to_seconds, utimes)), means, color))
    axis = Axis("NIS / dof", 0.01, 100.0, is_logarithmic=True)
    panel = Panel(f"NIS, mean of {NIS_WINDOW_S:.0f} s", axis, drawn, 220.0)
    figure = render_figure(
        charts.render_panels("NIS over time", x, [panel], _epochs(data)),
        "NIS per degree of freedom: mean 1 and 5 % beyond the 95 % limit are consistent. Below 1 the sigma is larger "
        "than necessary; far above 1 it is too small, or something else is wrong. Time-correlated kinds have their "
        "noise inflated on purpose and lie well below 1.",
    )
    return f"{render_table(head, rows, numbers=(1, 2, 3, 4))}\n{figure}"


def _render_innovations(data: ReplayData) -> str:
    kinds: dict[str, list[Decision]] = {}
    for each in data.decisions:
        if each.dof:
            kinds.setdefault(each.kind, []).append(each)
    drawn = [
        _innovation_panel(data, kind, n, [each for each in found if each.dof > n])
        for kind, found in sorted(kinds.items())
        for n in range(max(each.dof for each in found))
    ]
    if not drawn:
        return "<p>No innovations.</p>"
    return render_figure(
        charts.render_panels("Innovations", _time_axis(data), drawn),
        "Measured minus predicted, with 2 sigma: 95 % lie within, without a pattern. Points beyond a panel are drawn "
        "at its edge.",
    )


def _innovation_panel(data: ReplayData, kind: str, n: int, found: Sequence[Decision]) -> Panel:
    names = COMPONENTS.get(kind, ())
    name = names[n] if n < len(names) and (len(names) > 1 or found[0].dof == 1) else f"component {n + 1}"
    sigma = [2.0 * math.sqrt(max(each.innovation_covariance[n * (each.dof + 1)], 0.0)) for each in found]
    # the first innovations of a kind may have any size: they would hide all others
    typical = sorted(sigma)[int(0.95 * (len(sigma) - 1))]
    residuals = [each.residual[n] for each in found]
    low, high = value_range(residuals, 0.99)
    reach = max(min(1.15 * typical, 12.0 * max(-low, high)), -low, high, 1e-9)
    t = [data.to_seconds(each.utime) for each in found]
    drawn = [
        Series("2 sigma", t, [-value for value in sigma], charts.SKY, shape="band", high=sigma),
        level("", _time_axis(data), 0.0),
    ]
    colors = {Verdict.MONITORED: charts.AMBER, Verdict.USED: charts.BLUE, Verdict.REJECTED: charts.RED}
    for verdict, color in colors.items():
        chosen = [(a, b) for a, b, each in zip(t, residuals, found, strict=True) if each.verdict is verdict]
        if chosen:
            drawn.append(charts.dots(verdict.name.lower(), chosen, color, 2.4))
    return Panel(f"{kind}, {name}", Axis("", -reach, reach), drawn, 56.0 if kind.startswith("zero_") else 90.0)


# --- states -------------------------------------------------------------------------------------------------

KNOWN_STATES = (
    ("Gyro bias", "gyro_bias", "deg/s", math.degrees(1.0)),
    ("Accelerometer bias", "accelerometer_bias", "m/s²", 1.0),
    ("Wheel scale", "wheel_scale", "%", 100.0),
    ("Wheel yaw: rolling direction to the left of the geometry's x", "wheel_yaw", "deg", math.degrees(1.0)),
    ("Latency of fixes", "gps_latency", "s", 1.0),
    ("Time-correlated GNSS error, in units of sigma", "gps_wander", "sigma", 1.0),
)
"""Title, begin of the names of the states, unit and conversion factor; other states are drawn as they are."""


def _render_states(data: ReplayData) -> str:
    states = [each for each in data.snapshots if each.values]
    if not states:
        return f"<p>The filter had no state: {_explain_no_decisions(data)}.</p>"
    names = list(dict.fromkeys(name for each in states for name in each.values))
    listed = ("position_", "velocity_", "attitude_", *(begin for _, begin, _, _ in KNOWN_STATES))
    own = [(name, name, "", 1.0) for name in names if not name.startswith(listed)]
    x = _time_axis(data)
    drawn = [
        _state_panel(x, states, title, present, unit, factor)
        for title, begin, unit, factor in (*KNOWN_STATES, *own)
        if (present := [name for name in names if name.startswith(begin)])
    ]
    return render_figure(
        charts.render_panels("States", x, drawn, _epochs(data)),
        "Estimates with one sigma. A bias settles and stays; one that follows the turns of the drive absorbs another "
        "error.",
    )


def _state_panel(
    x: Axis, states: Sequence[StateSample], title: str, names: Sequence[str], unit: str, factor: float
) -> Panel:
    bands: list[Series] = []
    lines: list[Series] = []
    reach: list[float] = [0.0]
    for name, color in zip(names, charts.PALETTE, strict=False):
        held = [each for each in states if name in each.values]
        t = [each.t for each in held]
        value = [factor * each.values[name] for each in held]
        low, high = (
            [v + sign * factor * each.sigmas[name] for v, each in zip(value, held, strict=True)] for sign in (-1, 1)
        )
        bands.append(Series("", t, low, color, shape="band", high=high))
        lines.append(Series(name.rsplit("_", 1)[1] if len(names) > 1 else "", t, value, color))
        settled = len(held) // 10
        reach += [*value_range(low[settled:]), *value_range(high[settled:]), *value_range(value)]
    return Panel(title, Axis(unit, *value_range(reach)), [level("", x, 0.0), *bands, *lines], 130.0)


# --- verdicts -----------------------------------------------------------------------------------------------


def _render_verdicts(data: ReplayData) -> str:
    counts = Counter((each.kind, each.verdict, each.reason) for each in data.decisions)
    rows = [
        (kind, verdict.name.lower().replace("_", " "), reason, str(count))
        for (kind, verdict, reason), count in sorted(counts.items())
    ]
    first = render_table(("kind", "verdict", "reason", "count"), rows, numbers=(3,)) if rows else ""
    rejected = [(source, reason, str(count)) for (source, reason), count in sorted(data.rejected.items())]
    second = render_table(("rejected, source", "reason", "count"), rejected, numbers=(2,)) if rejected else ""
    return f"{first}\n{second}" if rows or rejected else f"<p>No decisions: {_explain_no_decisions(data)}.</p>"


def _explain_no_decisions(data: ReplayData) -> str:
    if data.mode is Mode.RAW:
        return "raw mode"
    if data.missing_channels:
        return "no messages on channel " + ", ".join(channel for _, channel in data.missing_channels)
    return "leveling or heading alignment was never completed"
