"""The mode of localization, its decisions and its state between Python and wire, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from modelserver.errors import WireError
from modelserver.messages import Decision, Invalid, Mode, NavigationState, Phase, PublishDecisions, SwitchMode, Verdict
from modelserver.spatial.pose import Pose
from modelserver.wire import fields
from mslcm.decision_t import decision_t
from mslcm.decisions_t import decisions_t
from mslcm.localization_mode_t import localization_mode_t
from mslcm.navigation_state_t import navigation_state_t

MAX_DECISIONS: Final = 1024
"""Decisions in one message; more go out in several."""

MAX_STATES: Final = 64
"""Error states of the filter, and numbers of one measurement."""


# --- the mode -----------------------------------------------------------------------------------------------


def read_mode(message: localization_mode_t) -> SwitchMode:
    """Return the wish of a message. Raises WireError."""
    return SwitchMode(fields.sensor_header(message.header), fields.member(Mode, message.mode, "mode"))


def write_mode(wish: SwitchMode) -> localization_mode_t:
    """Return the message of a wish."""
    message = localization_mode_t()
    message.header = fields.wire_sensor_header(wish.header)
    message.mode = int(wish.mode)
    return message


# --- decisions ----------------------------------------------------------------------------------------------


def read_decisions(message: decisions_t) -> PublishDecisions:
    """Return the decisions of a message. Raises WireError."""
    fields.checked_count(message.count, message.decisions, "count")
    _check_limit(message.count, MAX_DECISIONS, "decisions")
    return PublishDecisions(
        fields.checked_utime(message.utime), tuple(_read_decision(each) for each in message.decisions)
    )


def write_decisions(said: PublishDecisions) -> decisions_t:
    """Return the message of decisions. Raises ValueError for more than `MAX_DECISIONS`."""
    message = decisions_t()
    message.utime = said.utime
    message.count = len(said.decisions)
    if message.count > MAX_DECISIONS:
        raise ValueError(f"{message.count} decisions in one message; at most {MAX_DECISIONS} go out")
    message.decisions = [_write_decision(each) for each in said.decisions]
    return message


def _read_decision(message: decision_t) -> Decision:
    _check_limit(message.num, MAX_STATES, "numbers")
    return Decision(
        fields.checked_utime(message.utime),
        fields.name(message.source, "source"),
        message.seq,
        fields.name(message.kind, "kind"),
        fields.member(Verdict, message.verdict, "verdict"),
        fields.name(message.reason, "reason"),
        tuple(message.residual),
        _flat(message.innovation_covariance),
        _flat(message.noise),
        message.statistic,
        message.limit,
    )


def _write_decision(decision: Decision) -> decision_t:
    message = decision_t()
    message.utime = decision.utime
    message.source = decision.source
    message.seq = decision.seq
    message.kind = decision.kind
    message.verdict = int(decision.verdict)
    message.reason = decision.reason
    message.num = decision.dof
    message.residual = decision.residual
    message.innovation_covariance = _rows(decision.innovation_covariance, decision.dof)
    message.noise = _rows(decision.noise, decision.dof)
    message.statistic = decision.statistic
    message.limit = decision.limit
    return message


def _flat(rows: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return a matrix row by row, nothing where its first number is nan."""
    if not rows or rows[0][0] != rows[0][0]:
        return ()
    return tuple(value for row in rows for value in row)


def _rows(values: tuple[float, ...], n: int) -> list[tuple[float, ...]]:
    """Return the rows of an n by n matrix, all nan where there is none. Raises ValueError for another size."""
    if not values:
        return [(fields.NAN3[0],) * n] * n
    if len(values) != n * n:
        raise ValueError(f"{len(values)} numbers are no {n} by {n} matrix")
    return [values[row * n : (row + 1) * n] for row in range(n)]


# --- the state ----------------------------------------------------------------------------------------------


def read_state(message: navigation_state_t) -> NavigationState:
    """Return the state of a message. Raises WireError."""
    n = message.n
    _check_limit(n, MAX_STATES, "states")
    if message.num_covariance != n * (n + 1) // 2:
        raise WireError("malformed", f"the covariance of {n} states has not {message.num_covariance} numbers")
    x, y, z = fields.finite_vector3(message.position, "position")
    vx, vy, vz = message.linear_velocity
    wx, wy, wz = message.angular_velocity
    twist = message.twist_covariance
    return NavigationState(
        fields.checked_utime(message.utime),
        fields.member(Mode, message.mode, "mode"),
        fields.member(Phase, message.phase, "phase"),
        bool(message.standing),
        Invalid(message.invalid_reasons),
        message.pose_epoch,
        message.latitude_deg,
        message.longitude_deg,
        message.height,
        Pose((x, y, z), fields.unit_quaternion(message.orientation, "orientation")),
        (vx, vy, vz),
        (wx, wy, wz),
        () if twist[0] != twist[0] else tuple(twist),
        tuple(fields.name(each, "name") for each in message.names),
        tuple(message.values),
        _unpacked(message.covariance, n),
    )


def write_state(state: NavigationState) -> navigation_state_t:
    """Return the message of a state. Raises ValueError for more than `MAX_STATES` error states, or a wrong size."""
    n = len(state.names)
    if n > MAX_STATES or len(state.values) != n or len(state.covariance) != n * n:
        raise ValueError(
            f"{n} names, {len(state.values)} values and {len(state.covariance)} numbers of covariance are no state "
            f"of at most {MAX_STATES}"
        )
    message = navigation_state_t()
    message.utime = state.utime
    message.mode = int(state.mode)
    message.phase = int(state.phase)
    message.standing = state.standing
    message.invalid_reasons = int(state.invalid)
    message.pose_epoch = state.pose_epoch
    message.latitude_deg, message.longitude_deg, message.height = state.latitude_deg, state.longitude_deg, state.height
    message.position, message.orientation = state.pose.xyz, state.pose.wxyz
    message.linear_velocity, message.angular_velocity = state.linear_velocity, state.angular_velocity
    message.twist_covariance = state.twist_covariance or fields.NAN36
    message.n = n
    message.names, message.values = state.names, state.values
    message.covariance = [value for row in range(n) for value in state.covariance[row * n : row * n + row + 1]]
    message.num_covariance = len(message.covariance)
    return message


def _unpacked(packed: Sequence[float], n: int) -> tuple[float, ...]:
    """Return the n by n matrix, row-major, of a packed lower triangle."""
    return tuple(
        packed[max(row, column) * (max(row, column) + 1) // 2 + min(row, column)]
        for row in range(n)
        for column in range(n)
    )


def _check_limit(count: int, limit: int, what: str) -> None:
    if not 0 <= count <= limit:
        raise WireError("malformed", f"{count} {what} in one message; 0 to {limit} are taken")
