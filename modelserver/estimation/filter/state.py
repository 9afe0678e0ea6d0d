"""What every function of the filter gets: `Setup`, the constants of a run, and the state at an instant.

The setup is the vehicle, its settings and its measurement models. The state has its phases as types; it is restored
when an out-of-sequence measurement arrives.

    Leveling  -- vertical and gyro biases found -->  Unaligned  -- heading found -->  Aligned

A vehicle without an IMU is taken to be level. A warm start goes from Unaligned to Aligned by the persisted pose. From
Aligned a vehicle whose heading is lost goes back to Unaligned. After divergence, or a gap in the IMU that loses the
vertical, the filter restarts with `Leveling(common.restart())`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias, TypeVar

from modelserver.earth.geodesy import Geodesy, LocalFrame
from modelserver.estimation.filter.eskf import ZERO, Earth, ErrorLayout, ErrorState, NavState, ProcessNoise
from modelserver.estimation.filter.gnss_monitor import GnssMonitor, ReceiverMonitor, TurnMonitor
from modelserver.estimation.filter.heading_alignment import HeadingAlignment
from modelserver.estimation.filter.hypothesis_bank import DeadReckoning, HypothesisBank
from modelserver.estimation.filter.measurements import REGISTRY, Measurement
from modelserver.estimation.filter.measurements.gnss import gnss_states
from modelserver.estimation.filter.measurements.measurement import get_type
from modelserver.estimation.filter.measurements.wheels import WheelSpeed, wheel_states
from modelserver.estimation.filter.protection_levels import Bounds
from modelserver.estimation.filter.sensor_monitors import ImuMonitor, MountMonitor, StationaryDetector, WheelMonitor
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.inputs import OriginCapture
from modelserver.estimation.sensor_rig import SensorRig, find_unusable
from modelserver.messages import Mode, Origin, Phase, RestoredState, Sample, SwitchMode
from modelserver.named_tuples import new_tuple
from modelserver.transforms import so3
from modelserver.transforms.so3 import Vector3

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
        own: for each source of measurements of installed packages its type, see `MEASUREMENT_TYPES`.
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
            biases = (0.0, 0.0)  # motion_step propagates that of its one axis
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


# --- state --------------------------------------------------------------------------------------------------


class PreviousSample(NamedTuple):
    """The previous sample of a source and kind that was compared, and its instant."""

    utime: int
    sample: Sample | SwitchMode


class PendingDecision(NamedTuple):
    """A decision that takes effect at `utime`, when no delayed sample can change it any more.

    `origin` is to be set; `resets_position`: the position is to be reset to the rejected fixes.
    """

    utime: int
    origin: Origin | None = None
    resets_position: bool = False


class GyroBiases(NamedTuple):
    """Gyro biases found while stationary, rad/s, and their sigma: a restarted filter continues with them."""

    biases: Vector3
    sigma: float


class WarmStart(NamedTuple):
    """The state that an earlier run persisted, while it waits for evidence.

    Attributes
    ----------
    restored: the persisted state.
    since: when it began to wait, 0 before leveling.
    checked_utime: the last look at the evidence.
    num_fixes: fixes in a row that agree with the persisted pose; below 0 those that do not.
    fix_utime: of the last of them.
    """

    restored: RestoredState
    since: int = 0
    checked_utime: int = 0
    num_fixes: int = 0
    fix_utime: int = 0


class HeadingCheck(NamedTuple):
    """A segment of fixes that a restored heading is compared with, from `begin` to `utime` (0: none yet).

    `position` is the rolling frame at the first fix, `travel` the distance travelled since along the heading, m, and
    `velocity` the present velocity, m/s; all complex, east + i north.
    """

    utime: int = 0
    begin: int = 0
    position: complex = 0j
    travel: complex = 0j
    velocity: complex = 0j


class Common(NamedTuple):
    """What every phase has, and what changes less often than with each IMU sample.

    Attributes
    ----------
    mode: which sources are used.
    geodesy, capture: of the origin; None until it is set, and the fixes collected for it.
    epoch: of the pose: it increases with each discontinuity.
    gyro_biases: for a restart of the filter.
    is_clock_stepped: whether the clock was set back and the heading has not been found since.
    pending: decisions that wait, in order.
    wheels: the wheels used last.
    previous: the previous sample by source and kind.
    moving_until: until when fixes show that the vehicle moves.
    warm_start: the persisted state of an earlier run, until it is used or rejected.
    receiver: which fields of its fixes the receiver fills.
    mount: of the IMU, by the force that it measures.
    """

    mode: Mode = Mode.FULL
    geodesy: Geodesy | None = None
    capture: OriginCapture = OriginCapture()
    epoch: int = 0
    gyro_biases: GyroBiases | None = None
    is_clock_stepped: bool = False
    pending: tuple[PendingDecision, ...] = ()
    wheels: WheelMonitor = WheelMonitor()
    previous: Mapping[tuple[str, str], PreviousSample] = MappingProxyType({})
    moving_until: int = 0
    warm_start: WarmStart | None = None
    receiver: ReceiverMonitor = ReceiverMonitor()
    mount: MountMonitor = MountMonitor()

    def restart(self) -> Common:
        """Return what a restarted filter continues with: origin, mode and good gyro biases, in a new epoch."""
        common = Common(self.mode, self.geodesy, self.capture, self.epoch + 1, self.gyro_biases)
        return common._replace(receiver=self.receiver, mount=self.mount)

    def measures_wheel_speed(self, utime: int) -> bool:
        """Return whether the wheels measure the speed of the vehicle at an instant."""
        return self.mode is not Mode.NO_WHEELS and self.wheels.measures_speed(utime)


class MotionConstraints(NamedTuple):
    """Whether the vehicle is stationary, and when the constraints were last used (utime).

    `contradiction` is the running mean of the NIS of ZUPT, relative to its gate; `rest_turn` the integral of the rate
    over the `rest_time` that the vehicle has been stationary for, rad and s.
    """

    is_stationary: bool = False
    zupt_utime: int = 0
    non_holonomic_utime: int = 0
    contradiction: float = 0.0
    rest_turn: Vector3 = ZERO
    rest_time: float = 0.0


class Leveling(NamedTuple):
    """Coarse alignment: the mean of the IMU gives the vertical, and while stationary the gyro biases.

    Attributes
    ----------
    first_utime: the first IMU sample of leveling; 0: none yet.
    mean_since: the first sample of the present mean.
    is_stationary: whether the mean is of a stationary vehicle.
    force_sum, rate_sum, num_samples: of the mean.
    tilt: angle between gravity and the geometry's up, rad, if it is beyond its limit; infinite if the force is not
        gravity; else 0.
    """

    common: Common = Common()
    imu: ImuMonitor = ImuMonitor()
    stationary: StationaryDetector = StationaryDetector()
    first_utime: int = 0
    mean_since: int = 0
    is_stationary: bool = False
    force_sum: Vector3 = ZERO
    rate_sum: Vector3 = ZERO
    num_samples: int = 0
    tilt: float = 0.0

    @property
    def phase(self) -> Phase:
        return Phase.LEVELING


class Unaligned(NamedTuple):
    """Level, at an unknown heading: N is where the filter started, rotated about up by an unknown angle.

    The five that change with each IMU sample are first. `site` is the tangent plane at the first fix, `leveled_since`
    the first sample of leveling.
    """

    nav: NavState
    imu: ImuMonitor
    stationary: StationaryDetector
    reckoning: DeadReckoning
    alignment: HeadingAlignment
    constraints: MotionConstraints
    common: Common
    earth: Earth = Earth()
    site: LocalFrame | None = None
    leveled_since: int = 0

    @property
    def phase(self) -> Phase:
        return Phase.UNALIGNED

    @property
    def is_stationary(self) -> bool:
        return self.constraints.is_stationary

    def with_imu(
        self, nav: NavState, imu: ImuMonitor, stationary: StationaryDetector, reckoning: DeadReckoning
    ) -> Unaligned:
        """Return the state after an IMU sample: what `_replace` does, at a fraction of its cost."""
        alignment = self.alignment.update(self.nav, nav) if nav.utime > self.nav.utime else self.alignment
        return new_tuple(Unaligned, (nav, imu, stationary, reckoning, alignment, *self[5:]))

    def with_nav(self, nav: NavState) -> Unaligned:
        """Return the state propagated to a later instant."""
        alignment = self.alignment.update(self.nav, nav) if nav.utime > self.nav.utime else self.alignment
        return self._replace(nav=nav, alignment=alignment)


class Aligned(NamedTuple):
    """The vehicle in the world: N is east, north, up of the tangent plane `site`.

    `heading_check` is what a restored heading is compared with, until it is confirmed or wrong. `bank` judges fixes
    where wheels and a gyro measure the path, and `bounds` are those of the pose by it; `turns` compares
    the heading with the gyro where wheels do not.
    """

    nav: NavState
    imu: ImuMonitor
    stationary: StationaryDetector
    reckoning: DeadReckoning
    constraints: MotionConstraints
    common: Common
    earth: Earth
    site: LocalFrame
    gnss: GnssMonitor = GnssMonitor()
    turns: TurnMonitor = TurnMonitor()
    heading_check: HeadingCheck | None = None
    bank: HypothesisBank | None = None
    bounds: Bounds | None = None

    @property
    def phase(self) -> Phase:
        return Phase.ALIGNED

    @property
    def is_stationary(self) -> bool:
        return self.constraints.is_stationary

    def with_imu(
        self, nav: NavState, imu: ImuMonitor, stationary: StationaryDetector, reckoning: DeadReckoning
    ) -> Aligned:
        """Return the state after an IMU sample: what `_replace` does, at a fraction of its cost."""
        return new_tuple(Aligned, (nav, imu, stationary, reckoning, *self[4:]))

    def end_bank(self) -> Aligned:
        """Return the state without its bank, whose path was wrong or is not measured any more."""
        gnss = self.gnss._replace(rejected=(), num_rejected=0)  # beside the path of the bank
        return self._replace(bank=None, bounds=None, gnss=gnss)

    def with_nav(self, nav: NavState) -> Aligned:
        """Return the state propagated to a later instant."""
        return new_tuple(Aligned, (nav, *self[1:]))


Navigating: TypeAlias = Unaligned | Aligned
FilterState: TypeAlias = Leveling | Unaligned | Aligned

N = TypeVar("N", Unaligned, Aligned, Unaligned | Aligned)
"""A navigating state, for functions that return the phase that they get; the last is for a phase that is not known."""
S = TypeVar("S", Leveling, Unaligned, Aligned, Unaligned | Aligned, Leveling | Unaligned | Aligned)
"""Any state, in the same way."""


def is_speed_known(state: Navigating) -> bool:
    """Return whether the state knows the speed, and its sign along the vehicle's own axis."""
    nav = state.nav
    if state.common.measures_wheel_speed(nav.utime):
        return True
    P = nav.covariance
    sigma = math.sqrt(max(P[3, 3], P[4, 4]))
    return sigma < max(0.3 * math.hypot(nav.velocity[0], nav.velocity[1]), 0.15)
