"""State of localization for other programs: the filter's whole state, and a summary for the health report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from modelserver.messages.flags import Invalid
from modelserver.messages.generated import Mode, Phase
from modelserver.transforms.pose import Pose
from modelserver.transforms.so3 import Vector3


class SensorFinding(NamedTuple):
    """Why a configured sensor cannot be used, in whole or in part.

    `sensor` is its key under `sensors`, `element` the responsible key of the vehicle file, `reason` a word for
    programs, `text` what is wrong and its effect, `fix` the remedy. `is_choice`: the vehicle file asks for it, e.g. by
    its mode.
    """

    sensor: str
    reason: str
    element: str
    text: str
    fix: str = ""
    is_choice: bool = False


class LocalizerSummary(NamedTuple):
    """Summary of a localizer: `phase` is None in raw mode, `fix_utime` 0 before the first used fix.

    `findings` lists the configured sensors that cannot be used now.
    """

    mode: Mode
    phase: Phase | None = None
    stationary: bool = False
    fix_utime: int = 0
    findings: tuple[SensorFinding, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class NavigationState:
    """State of the filter at `utime`, the instant of its newest measurement; see navigation_state_t.

    `pose` is that of the rolling frame in a tangent plane (east, north, up) with origin at `latitude_deg`,
    `longitude_deg`, `height` (nan = not known yet). `linear_velocity` and `angular_velocity` (m/s, rad/s) are those of
    the rolling frame relative to the ground, along its own axes; `twist_covariance` is 6 x 6, row-major. `names` (n)
    are the error states, e.g. position_east, gyro_bias_x, wheel_scale; `values` (n) the estimates (rotations:
    fixed-axis roll, pitch, yaw, rad), `covariance` (n x n, row-major) that of their errors. SI units.
    """

    utime: int
    mode: Mode
    phase: Phase
    stationary: bool
    invalid: Invalid
    pose_epoch: int
    latitude_deg: float
    longitude_deg: float
    height: float
    pose: Pose
    linear_velocity: Vector3
    angular_velocity: Vector3
    twist_covariance: tuple[float, ...] = field(repr=False)
    names: tuple[str, ...]
    values: tuple[float, ...]
    covariance: tuple[float, ...] = field(repr=False)
