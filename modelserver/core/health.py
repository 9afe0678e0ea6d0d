"""Health report: its content and its schedule. Pure.

A full report is due once a period (`health_period_ns`). Between two of them, the conditions that matter to an operator
(`HealthConditions`) are evaluated every `CHANGE_PERIOD_NS`, and a report is sent at once when they have changed. Rates,
delays and the distribution of tick delays always cover a whole period: a report for a change repeats the last ones.

Sensor timeout: a source is silent after `get_silence_limit` of its usual interval, a moving average (`state`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from modelserver import messages
from modelserver.core.state import (
    CHANGE_PERIOD_NS,
    CoreState,
    HealthConditions,
    Instant,
    Outputs,
    SourceTraffic,
    format_offset,
    get_silence_limit,
    is_clock_off,
)
from modelserver.earth.geodesy import compute_geodetic
from modelserver.estimation.filter.protection_levels import compute_longest_axis
from modelserver.geometry.names import WORLD_UTM
from modelserver.query.dynamics import find_stability
from modelserver.version import __version__

MIN_MESSAGES = 3
"""Messages of a source before it can count as silent: its usual interval is not known earlier."""

MIN_DROPPED = 20
"""Measurements of a source that are dropped in a row before a warning: 8 s of wheels, 2 s of a GPS receiver."""


STABILITY = "stability"
"""Subject of the warning about the tip-over margin."""


def report_if_due(state: CoreState, gauges: messages.Gauges | None, now: Instant) -> tuple[CoreState, Outputs]:
    """Return the state after a tick, and the report that is due, if any."""
    is_full = now.monotonic_ns >= state.health_due_ns
    inputs = state.health_inputs
    if not is_full and now.monotonic_ns < inputs.due_ns:
        return state, ()
    stability, warning = find_stability(state.view, now.utime)
    conditions = evaluate_conditions(state, now, is_unstable=bool(warning))
    if gauges is not None:
        cpu_share = messages.NAN
        if inputs.gauges_ns and now.monotonic_ns > inputs.gauges_ns:
            cpu_share = (gauges.cpu_s - inputs.gauges.cpu_s) / ((now.monotonic_ns - inputs.gauges_ns) * 1e-9)
        inputs = inputs._replace(gauges=gauges, gauges_ns=now.monotonic_ns, cpu_share=cpu_share)
    has_changed = conditions != inputs.reported
    inputs = inputs._replace(due_ns=now.monotonic_ns + CHANGE_PERIOD_NS, reported=conditions)
    state = state._replace(health_inputs=inputs)
    if not (is_full or has_changed):
        return state, ()
    if is_full:
        state = _update_rates(state, now)
    report = messages.PublishHealth(_make_report(state, now, stability, warning))
    if is_full:
        # from now, not from the due time: after a pause one report is enough
        due = now.monotonic_ns + state.settings.health_period_ns
        state = state._replace(tick_latencies=(), health_sent_ns=now.monotonic_ns, health_due_ns=due)
    return state, (report,)


def evaluate_conditions(state: CoreState, now: Instant, is_unstable: bool = False) -> HealthConditions:
    """Return the conditions whose change is reported at once."""
    silent = tuple([name for name, traffic in state.traffic.items() if _is_silent(name, traffic, now)])
    return HealthConditions(
        state.run_state,
        state.pose_invalid,
        state.model.revision,
        silent,
        tuple(_list_missing(state)),
        state.warnings,
        tuple([(name, reason) for name, reason, _ in _find_unusable(state, now)]),
        is_unstable,
    )


def _list_missing(state: CoreState) -> list[str]:
    """Return the channels of the configured sensors without any message; joints count only if the geometry has some."""
    return [
        each.channel for each in state.missing_sensors if each.kind is not messages.JointsSample or state.model.joints
    ]


def _find_unusable(state: CoreState, now: Instant) -> Iterator[tuple[str, str, str]]:
    """Yield subject, reason and text of a warning for each sensor that localization cannot use."""
    if state.localizer is not None:
        for finding in state.localizer.summary(now.utime).findings:
            if not finding.is_choice:
                fix = f"; {finding.fix}" if finding.fix else ""
                yield f"sensors.{finding.sensor} ({finding.reason})", finding.reason, f"{finding.text}{fix}"
    for name, traffic in state.traffic.items():
        if traffic.num_off and is_clock_off(state.traffic, name, now) and not _is_silent(name, traffic, now):
            offset = format_offset(traffic.offset, now.utime * 1e-6)
            yield name, "clock", f"its clock is off: its stamps are {offset} their receipt; its samples are not used"
        elif traffic.dropped >= MIN_DROPPED and not _is_silent(name, traffic, now):
            counts = f"{traffic.count} received, {traffic.used} of {traffic.measured} measurements used"
            yield name, traffic.reason, f"{counts}; the last {traffic.dropped} were dropped: {traffic.reason}"


def _is_silent(name: str, traffic: SourceTraffic, now: Instant) -> bool:
    return (
        traffic.count >= MIN_MESSAGES
        and (now.monotonic_ns - traffic.last_received_ns) * 1e-9 > get_silence_limit(traffic.interval)
        # commands have no rate
        and name.startswith("sensor:")
    )


def _update_rates(state: CoreState, now: Instant) -> CoreState:
    elapsed = (now.monotonic_ns - state.health_sent_ns) * 1e-9 if state.health_sent_ns else 0.0

    def start_period(each: SourceTraffic) -> SourceTraffic:
        rate = (each.count - each.reported) / elapsed if elapsed > 0 else 0.0
        return each._replace(reported=each.count, rate=rate, delay=messages.NAN, reported_delay=each.delay)

    return state._replace(traffic={name: start_period(traffic) for name, traffic in state.traffic.items()})


def _make_report(state: CoreState, now: Instant, stability: messages.StabilityHealth, warning: str) -> messages.Health:
    latencies = sorted(state.tick_latencies)
    estimate = None if state.localizer is None else state.localizer.estimate(now.utime)
    gauges = state.health_inputs.gauges
    channels = [_make_channel_health(name, traffic, now) for name, traffic in state.traffic.items()]
    channels += [
        messages.ChannelHealth(channel, 0, 0.0, messages.NAN, messages.NAN, True) for channel in _list_missing(state)
    ]
    invalid = state.view.invalid | (messages.VALID if estimate is None else estimate.invalid)
    warnings = {**state.warnings, **{name: text for name, _, text in _find_unusable(state, now)}}
    if warning:
        warnings[STABILITY] = warning
    return messages.Health(
        utime=now.utime,
        uptime=(now.monotonic_ns - state.started_ns) * 1e-9,
        version=__version__,
        vehicle=state.settings.vehicle,
        model_revision=state.model.revision,
        state=state.run_state,
        invalid_reasons=invalid,
        invalid_text=_explain(state, invalid, now),
        pose_epoch=0 if estimate is None else estimate.pose_epoch,
        origin_id=0 if estimate is None or estimate.origin is None else estimate.origin.origin_id,
        poses_published=state.poses_published,
        requests_answered=state.requests_answered,
        requests_waiting=len(state.waiting),
        ticks_missed=state.ticks_missed,
        handler_errors=state.handler_errors,
        tick_latency_p50=percentile(latencies, 0.5),
        tick_latency_p90=percentile(latencies, 0.9),
        tick_latency_p99=percentile(latencies, 0.99),
        tick_latency_max=percentile(latencies, 1.0),
        channels=tuple(sorted(channels, key=lambda each: each.channel)),
        rejected=tuple(messages.RejectedCount(*key, count) for key, count in sorted(state.rejected.items())),
        warnings=tuple(sorted(warnings.items())),
        host=gauges.host,
        pid=gauges.pid,
        requests_queued=gauges.queued,
        memory=gauges.memory,
        cpu_share=state.health_inputs.cpu_share,
        localization=_make_localization_health(state, estimate, now),
        stability=stability,
    )


def _explain(state: CoreState, invalid: messages.Invalid, now: Instant) -> str:
    """Return why the pose is invalid, in words: with the distance that is left where the vehicle must drive."""
    text = invalid.explain()
    if messages.Invalid.NOT_MOVED_YET not in invalid or state.localizer is None:
        return text
    distance = state.localizer.summary(now.utime).distance_to_heading
    if math.isnan(distance):
        return text
    if distance < 1.0:
        return f"{text}; the vehicle has moved, but its fixes do not show the heading yet"
    return f"{text}; drive about {distance:.0f} m more"


def percentile(ordered: Sequence[float], share: float) -> float:
    """Return the percentile `share` (0 to 1) of values in rising order, one of the values; 0 without any."""
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


def _make_localization_health(
    state: CoreState, estimate: messages.Estimate | None, now: Instant
) -> messages.LocalizationHealth:
    if state.localizer is None or estimate is None:
        return messages.LocalizationHealth()
    summary = state.localizer.summary(now.utime)
    geodetic = None
    if estimate.utm is not None and estimate.origin is not None:
        geodetic = compute_geodetic(estimate.utm, WORLD_UTM, estimate.origin)
    P = estimate.covariance
    return messages.LocalizationHealth(
        summary.mode,
        summary.phase,
        summary.stationary,
        estimate.horizontal_protection_level,
        estimate.heading_protection_level,
        estimate.seconds_to_limit,
        (now.utime - summary.fix_utime) * 1e-6 if summary.fix_utime else messages.NAN,
        *((messages.NAN,) * 4 if geodetic is None else geodetic),
        messages.NAN if P is None else math.sqrt(compute_longest_axis(P[0], P[7], P[1])),
        messages.NAN if P is None else math.sqrt(P[14]),
        estimate.horizontal_level,
        estimate.heading_level,
        estimate.limit_risk,
        summary.horizontal_limit,
        summary.heading_limit,
    )


def _make_channel_health(name: str, traffic: SourceTraffic, now: Instant) -> messages.ChannelHealth:
    age = (now.monotonic_ns - traffic.last_received_ns) * 1e-9
    return messages.ChannelHealth(
        name,
        traffic.count,
        traffic.rate,
        age,
        traffic.reported_delay,
        _is_silent(name, traffic, now),
        traffic.measured,
        traffic.used,
    )
