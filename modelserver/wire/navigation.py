"""The state of the localization filter between Python and wire (navigation_state_t)."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from modelserver.errors import WireError
from modelserver.messages import Invalid, Mode, NavigationState, Phase
from modelserver.transforms.pose import Pose
from modelserver.wire.fields import (
    LENGTH,
    MAX_STATES,
    NAN36,
    check_count,
    check_name,
    check_position,
    check_unit_quaternion,
    check_utime,
    pack_text,
    read_enum,
    read_numbers,
    read_texts,
)

_HEAD = struct.Struct(">qbbbiiddd3d4d3d3d36di")


def pack_navigation_state(state: NavigationState) -> bytes:
    """Return the bytes of a navigation_state_t without the fingerprint.

    Raises ValueError for more than `MAX_STATES` error states, or arrays of another size.
    """
    n = len(state.names)
    if n > MAX_STATES or len(state.values) != n or len(state.covariance) != n * n:
        raise ValueError(
            f"{n} names, {len(state.values)} values and {len(state.covariance)} numbers of covariance are no state "
            f"of at most {MAX_STATES}"
        )
    triangle = [value for row in range(n) for value in state.covariance[row * n : row * n + row + 1]]
    head = _HEAD.pack(
        state.utime,
        state.mode,
        state.phase,
        state.stationary,
        state.invalid,
        state.pose_epoch,
        state.latitude_deg,
        state.longitude_deg,
        state.height,
        *state.pose.xyz,
        *state.pose.wxyz,
        *state.linear_velocity,
        *state.angular_velocity,
        *(state.twist_covariance or NAN36),
        n,
    )
    return b"".join(
        (
            head,
            *map(pack_text, state.names),
            struct.pack(f">{n}di{len(triangle)}d", *state.values, len(triangle), *triangle),
        )
    )


def unpack_navigation_state(data: bytes, at: int) -> tuple[NavigationState, int]:
    """Return the navigation_state_t that begins at `at`, and its end. Raises WireError, struct.error."""
    utime, mode, phase, stationary, invalid, epoch, latitude, longitude, height, *numbers, n = _HEAD.unpack_from(
        data, at
    )
    check_count(n, "n", MAX_STATES)
    names, at = read_texts(data, at + _HEAD.size, n)
    values, at = read_numbers("d", data, at, n)
    (count,) = LENGTH.unpack_from(data, at)
    if count != n * (n + 1) // 2:
        raise WireError("malformed", f"the covariance of {n} states has not {count} numbers")
    triangle, at = read_numbers("d", data, at + LENGTH.size, count)
    twist = tuple(numbers[13:])
    state = NavigationState(
        check_utime(utime),
        read_enum(Mode, mode, "mode"),
        read_enum(Phase, phase, "phase"),
        bool(stationary),
        Invalid(invalid),
        epoch,
        latitude,
        longitude,
        height,
        Pose(check_position(numbers[0:3], "position"), check_unit_quaternion(numbers[3:7], "orientation")),
        tuple(numbers[7:10]),
        tuple(numbers[10:13]),
        () if twist[0] != twist[0] else twist,
        tuple(check_name(each, "name") for each in names),
        values,
        _unpack_triangle(triangle, n),
    )
    return state, at


def _unpack_triangle(packed: Sequence[float], n: int) -> tuple[float, ...]:
    """Return the n by n matrix, row-major, of a packed lower triangle."""
    return tuple(
        packed[max(row, column) * (max(row, column) + 1) // 2 + min(row, column)]
        for row in range(n)
        for column in range(n)
    )
