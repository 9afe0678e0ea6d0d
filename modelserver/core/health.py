"""What the health report says, and when it goes out: once a period, and at once when something of weight changes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from modelserver.core.host_clock import Instant
from modelserver.core.state import CHANGE_PERIOD_NS, CoreState, Outputs, Signs, SourceTraffic, silent_after
from modelserver.messages import (
    NAN,
    VALID,
    ChannelHealth,
    Estimate,
    Gauges,
    Health,
    JointsSample,
    LocalizationHealth,
    PublishHealth,
)
from modelserver.version import __version__

JUDGED_FROM = 3
"""Messages of a source from which on it can fall silent: of fewer nobody knows how often they come."""


DROPPED_FROM = 20
"""Measurements of a source dropped in a row from which on that is a notice: 8 s of wheels, 2 s of a receiver."""


def told(state: CoreState, gauges: Gauges | None, now: Instant) -> tuple[CoreState, Outputs]:
    """Return the state after a tick, and the report that is due at it, where one is.

    A report that is due by the period is a whole one: rates, delays and lateness are counted anew after it. One that
    goes out for a change repeats the rates and delays of the last whole one, for too little time has passed for others.
    """
    whole = now.monotonic_ns >= state.health_due_ns
    watch = state.watch
    if not whole and now.monotonic_ns < watch.due_ns:
        return state, ()
    seen = signs(state, now)
    if gauges is not None:
        cpu_share = NAN
        if watch.gauged_ns and now.monotonic_ns > watch.gauged_ns:
            cpu_share = (gauges.cpu_s - watch.gauges.cpu_s) / ((now.monotonic_ns - watch.gauged_ns) * 1e-9)
        watch = watch._replace(gauges=gauges, gauged_ns=now.monotonic_ns, cpu_share=cpu_share)
    changed = seen != watch.said
    watch = watch._replace(due_ns=now.monotonic_ns + CHANGE_PERIOD_NS, said=seen)
    state = state._replace(watch=watch)
    if not (whole or changed):
        return state, ()
    if whole:
        state = _counted_up(state, now)
    report = PublishHealth(_report(state, now))
    if whole:
        # from now, not from the due time: after a pause one report is enough
        due = now.monotonic_ns + state.settings.health_period_ns
        state = state._replace(lateness=(), health_sent_ns=now.monotonic_ns, health_due_ns=due)
    return state, (report,)


def signs(state: CoreState, now: Instant) -> Signs:
    """Return what a report goes out for at once when it changes."""
    silent = tuple([name for name, traffic in state.traffic.items() if _is_silent(name, traffic, now)])
    return Signs(
        state.run_state,
        state.pose_invalid,
        state.model.revision,
        silent,
        tuple(_unheard(state)),
        state.notices,
        tuple([(name, reason) for name, reason, _ in _unused(state, now)]),
    )


def _unheard(state: CoreState) -> list[str]:
    """Return the channels of the sensors that were never heard; joints are no sensor of a geometry without any."""
    return [each.channel for each in state.unheard if each.kind is not JointsSample or state.model.joints]


def _unused(state: CoreState, now: Instant) -> Iterator[tuple[str, str, str]]:
    """Yield the sensors that cannot be used: subject of a notice, a word why, and the text."""
    if state.localizer is not None:
        for finding in state.localizer.summary(now.utime).findings:
            if not finding.is_choice:
                fix = f"; {finding.fix}" if finding.fix else ""
                yield f"sensors.{finding.sensor} ({finding.reason})", finding.reason, f"{finding.text}{fix}"
    for name, traffic in state.traffic.items():
        if traffic.dropped >= DROPPED_FROM and not _is_silent(name, traffic, now):
            counts = f"{traffic.count} received, {traffic.used} of {traffic.measured} measurements used"
            yield name, traffic.reason, f"{counts}; the last {traffic.dropped} were dropped: {traffic.reason}"


def _is_silent(name: str, traffic: SourceTraffic, now: Instant) -> bool:
    return (
        traffic.count >= JUDGED_FROM
        and (now.monotonic_ns - traffic.last_ns) * 1e-9 > silent_after(traffic.interval)
        # who commands speaks when there is something to say
        and name.startswith("sensor:")
    )


def _counted_up(state: CoreState, now: Instant) -> CoreState:
    """Return the state with rates and delays of the period that ends now, and the next one begun."""
    elapsed = (now.monotonic_ns - state.health_sent_ns) * 1e-9 if state.health_sent_ns else 0.0

    def next_one(each: SourceTraffic) -> SourceTraffic:
        rate = (each.count - each.reported) / elapsed if elapsed > 0 else 0.0
        return replace(each, reported=each.count, rate=rate, delay=NAN, told_delay=each.delay)

    return state._replace(traffic={name: next_one(traffic) for name, traffic in state.traffic.items()})


def _report(state: CoreState, now: Instant) -> Health:
    late = sorted(state.lateness)
    estimate = None if state.localizer is None else state.localizer.estimate(now.utime)
    gauges = state.watch.gauges
    channels = [_channel_health(name, traffic, now) for name, traffic in state.traffic.items()]
    channels += [ChannelHealth(channel, 0, 0.0, NAN, NAN, True) for channel in _unheard(state)]
    return Health(
        utime=now.utime,
        uptime=(now.monotonic_ns - state.started_ns) * 1e-9,
        version=__version__,
        vehicle=state.settings.vehicle,
        model_revision=state.model.revision,
        state=state.run_state,
        invalid_reasons=state.view.doubt | (VALID if estimate is None else estimate.invalid),
        pose_epoch=0 if estimate is None else estimate.pose_epoch,
        origin_id=0 if estimate is None or estimate.origin is None else estimate.origin.origin_id,
        poses_published=state.poses_published,
        requests_answered=state.requests_answered,
        requests_parked=len(state.parked),
        ticks_missed=state.ticks_missed,
        handler_errors=state.handler_errors,
        tick_lateness_p50=percentile(late, 0.5),
        tick_lateness_p90=percentile(late, 0.9),
        tick_lateness_p99=percentile(late, 0.99),
        tick_lateness_max=percentile(late, 1.0),
        channels=tuple(sorted(channels, key=lambda each: each.channel)),
        rejected=tuple((channel, reason, count) for (channel, reason), count in sorted(state.rejected.items())),
        notices=tuple(sorted({**state.notices, **{name: text for name, _, text in _unused(state, now)}}.items())),
        host=gauges.host,
        pid=gauges.pid,
        requests_queued=gauges.queued,
        memory=gauges.memory,
        cpu_share=state.watch.cpu_share,
        localization=_localization(state, estimate, now),
    )


def percentile(ordered: Sequence[float], share: float) -> float:
    """Return a value that at least `share` of those given, in rising order, do not pass; 0 of none."""
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else 0.0


def _localization(state: CoreState, estimate: Estimate | None, now: Instant) -> LocalizationHealth:
    if state.localizer is None or estimate is None:
        return LocalizationHealth()
    summary = state.localizer.summary(now.utime)
    return LocalizationHealth(
        summary.mode,
        summary.phase,
        summary.standing,
        estimate.horizontal_bound,
        estimate.heading_bound,
        estimate.seconds_to_limit,
        (now.utime - summary.fix_utime) * 1e-6 if summary.fix_utime else NAN,
    )


def _channel_health(name: str, traffic: SourceTraffic, now: Instant) -> ChannelHealth:
    age = (now.monotonic_ns - traffic.last_ns) * 1e-9
    return ChannelHealth(
        name,
        traffic.count,
        traffic.rate,
        age,
        traffic.told_delay,
        _is_silent(name, traffic, now),
        traffic.measured,
        traffic.used,
    )
