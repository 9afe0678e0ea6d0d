"""Constants of a run of the filter: vehicle, settings, measurement models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from modelserver.estimation.filter.layout import Layout
from modelserver.estimation.filter.measurements import REGISTRY, Measurement
from modelserver.estimation.filter.measurements.gps import gps_states
from modelserver.estimation.filter.measurements.wheels import WheelSpeed, wheel_states
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.filter.strapdown import Noise
from modelserver.estimation.findings import find_unusable
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import Mode
from modelserver.transforms import so3

ROCKING = 1e-5
"""Angle random walk of a standing vehicle, rad/sqrt(s): its tyres give 0.02 deg in 10 minutes."""


class Setup:
    """A vehicle for the filter. Immutable.

    `measurements` has what is made of each type of sample, in the order in which those of one sample are fused. The
    layout holds the error states that these need. `findings` has, by mode, the configured sensors that cannot be used.
    """

    def __init__(self, rig: SensorRig, settings: FilterSettings | None = None, kinds: Iterable[type[Measurement]] = ()):
        """Take the vehicle; `kinds` are the measurements to use, by default all that are registered."""
        self.rig = rig
        self.settings = settings = settings or FilterSettings()
        self.kinds = tuple(kinds) or tuple(REGISTRY.values())
        made = [kind.of(rig, settings) for kind in self.kinds]
        present = [each for each in made if each is not None]
        self.wheels = next((each for each in present if isinstance(each, WheelSpeed)), None)
        extras = [*gps_states(settings)] if rig.gps_frame else [gps_states(settings)[0]]
        if self.wheels is not None:
            extras += wheel_states(settings)
        extras += [state for each in present for state in each.states]
        self.mount = rig.pose(rig.imu_frame).wxyz if rig.imu_frame else so3.IDENTITY
        self.layout = Layout(extras)
        by_sample: dict[type, list[Measurement]] = {}
        for each in present:
            by_sample.setdefault(each.sample, []).append(each)
        self.measurements: Mapping[type, tuple[Measurement, ...]] = {
            sample: tuple(found) for sample, found in by_sample.items()
        }
        s = settings
        biases = (s.gyro_bias_walk**2, s.accelerometer_bias_walk**2)
        self.driving = Noise(s.gyro_noise**2, s.accelerometer_noise**2, *biases)
        self.standing = Noise(ROCKING**2, s.accelerometer_noise**2, *biases, by_gyros=False)
        # what nobody measures lasts about a second each way
        self.coasting = Noise(s.gap_rate_sigma**2, s.gap_acceleration**2, *biases, by_gyros=False)
        # numbers that someone filled a gap with go from the one end to the other: a third of what could be
        self.guessing = Noise((s.gap_rate_sigma / 3.0) ** 2, s.gap_acceleration**2, *biases)
        self.findings = {mode: find_unusable(rig, mode) for mode in Mode}
        self.rolling = Noise(s.wheel_rate_sigma**2 * s.slip_time, s.gap_acceleration**2, *biases, by_gyros=False)

    @property
    def has_imu(self) -> bool:
        """Whether the vehicle has an inertial unit."""
        return bool(self.rig.imu_frame)
