"""Constants of a run of the filter: vehicle, settings, measurement models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final

from modelserver.estimation.filter.error_layout import ErrorLayout, ErrorState
from modelserver.estimation.filter.eskf import ProcessNoise
from modelserver.estimation.filter.measurements import REGISTRY, Measurement
from modelserver.estimation.filter.measurements.gnss import gnss_states
from modelserver.estimation.filter.measurements.own import get_type
from modelserver.estimation.filter.measurements.wheels import WheelSpeed, wheel_states
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.findings import find_unusable
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import Mode
from modelserver.transforms import so3

STATIONARY_ANGLE_WALK: Final = 1e-5
"""Angle random walk of a stationary vehicle, rad/sqrt(s): its tires give 0.02 deg in 10 minutes."""

TILT_WALK: Final = 0.05
"""Random walk of roll and pitch without gyros, rad/sqrt(s): 5 deg in 3 s on rough ground."""

NO_TYPES: Final[Mapping[str, str]] = MappingProxyType({})


class Setup:
    """A vehicle for the filter. Immutable.

    `measurements` has the measurements of each type of sample, in the order in which those of one sample are fused. The
    layout holds the error states that they need. `has_imu` is whether the vehicle has an IMU. `findings` has, by mode,
    the configured sensors that cannot be used. `own` has the sources of measurements of installed packages with their
    types. `horizon_us` is the horizon in microseconds. The process noises: `driving` on the IMU, `stationary`,
    `coasting` without any measurement of the motion, `interpolated` on made-up IMU samples, `rolling` on wheels alone,
    `turning` on a gyro of the turn rate alone.
    """

    def __init__(
        self,
        rig: SensorRig,
        settings: FilterSettings | None = None,
        kinds: Iterable[type[Measurement]] = (),
        own: Mapping[str, str] = NO_TYPES,
    ):
        """Set up a vehicle.

        Parameters
        ----------
        kinds: the measurements to use, by default all that are registered.
        own: for each source of measurements of installed packages its type, see `measurements.own`.
        """
        self.rig = rig
        self.settings = settings = settings or FilterSettings()
        self.kinds = tuple(kinds) or tuple(REGISTRY.values())
        created = [kind.create(rig, settings) for kind in self.kinds]
        present = [each for each in created if each is not None]
        self.horizon_us = round(settings.horizon * 1e6)
        self.wheels = next((each for each in present if isinstance(each, WheelSpeed)), None)
        extras = [*gnss_states(settings)] if rig.gps_frame else [gnss_states(settings)[0]]
        if self.wheels is not None:
            extras += wheel_states(settings)
        extras += [state for each in present for state in each.states]
        self.own: Mapping[str, str] = dict(own)
        extras += [state for each in dict.fromkeys(own.values()) for state in get_type(each).states]
        self.has_imu = bool(rig.imu_frame)
        self.mount = rig.pose(rig.imu_frame).wxyz if rig.imu_frame else so3.IDENTITY
        self.layout = ErrorLayout(extras)
        by_sample: dict[type, list[Measurement]] = {}
        for each in present:
            by_sample.setdefault(each.sample, []).append(each)
        self.measurements: Mapping[type, tuple[Measurement, ...]] = {
            sample: tuple(found) for sample, found in by_sample.items()
        }
        s = settings
        biases = (s.gyro_bias_walk**2, s.accelerometer_bias_walk**2)
        self.yaw_gyro = rig.yaw_gyro
        if self.yaw_gyro is not None:
            biases = (0.0, 0.0)  # imu_step propagates that of its one axis
        gap_acceleration, gap_rate = s.gap_acceleration**2, s.gap_rate_sigma
        gyro, tilt, parked = s.gyro_noise**2, TILT_WALK**2, STATIONARY_ANGLE_WALK**2
        self.driving = ProcessNoise(gyro, gyro, s.accelerometer_noise**2, *biases)
        self.stationary = ProcessNoise(
            parked, parked, s.accelerometer_noise**2, *biases, gyros_drive_attitude=False, is_stationary=True
        )
        # an unmeasured rate or acceleration lasts about a second
        self.coasting = ProcessNoise(tilt, gap_rate**2, gap_acceleration, *biases, gyros_drive_attitude=False)
        # interpolated numbers run from one real sample to the next: a third of the error of a gap
        third = (gap_rate / 3.0) ** 2
        self.interpolated = ProcessNoise(third, third, gap_acceleration, *biases)
        self.turning = ProcessNoise(tilt, gyro, gap_acceleration, *biases)
        self.findings = {mode: find_unusable(rig, mode) for mode in Mode}

    def uses_imu(self, mode: Mode) -> bool:
        """Return whether the IMU propagates the state in a mode."""
        return mode is not Mode.NO_IMU and self.has_imu

    def uses_gnss(self, mode: Mode) -> bool:
        """Return whether fixes are used in a mode: the vehicle has an antenna."""
        return bool(self.rig.gps_frame) and mode not in (Mode.NO_GPS, Mode.DEAD_RECKONING)


def find_repeated_state(types: Iterable[str], settings: FilterSettings) -> tuple[str, str] | None:
    """Return the first type with another state of a name that the filter or a type before it has, and that name.

    Types may share a state that both declare alike.
    """
    own = [*gnss_states(settings), *wheel_states(settings)]
    own += [state for kind in REGISTRY.values() for state in kind.states]
    names = {*ErrorLayout().names, *(name for state in own for name in state.names)}
    shared: set[ErrorState] = set()
    for each in types:
        for state in get_type(each).states:
            if state not in shared and (repeated := names.intersection(state.names)):
                return each, min(repeated)
            names.update(state.names)
            shared.add(state)
    return None
