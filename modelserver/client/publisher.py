"""Publish samples of a device without a driver (`SensorPublisher`), commands to the vehicle (`VehicleCommander`)."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Mapping
from types import TracebackType
from typing import Final, Self, TypeVar

import lcm

from modelserver.client.remote import Time, load_signer, to_utime
from modelserver.messages import (
    NAN,
    Direction,
    FixType,
    GpsSample,
    ImuSample,
    JointSample,
    JointsSample,
    MeasurementSample,
    OrientationReference,
    SensorHeader,
    VehicleCommand,
    VehicleStatusSample,
    WheelSample,
    WheelsSample,
    YawSource,
)
from modelserver.transforms.so3 import Matrix3, Vector3
from modelserver.wire.channels import DRIVE_SIGNED
from modelserver.wire.codec import encode
from modelserver.wire.fields import MAX_VALUES
from modelserver.wire.provider import open_lcm, resolve_url

MAX_RATE: Final = 100.0
"""rad/s: 16 turns a second; a larger number is in degrees per second."""

MAX_FORCE: Final = 2000.0
"""m/s2: 200 g."""

MAX_SPEED: Final = 200.0
"""m/s; a larger number is in another unit."""

S = TypeVar("S", GpsSample, ImuSample, JointsSample, MeasurementSample, VehicleStatusSample, WheelsSample)

CHANNELS: Final = {
    "gps": "GPS",
    "imu": "IMU",
    "wheels": "WHEELS",
    "joints": "JOINTS",
    "status": "VEHICLE_STATUS",
    "measurement": "MEASUREMENT",
}
"""Channel of each kind of sample, where the vehicle file names no other."""


def check_source(source: str, what: str) -> None:
    """Raise ValueError unless the name of a device or program can be sent."""
    if not source or len(source) > 64 or not source.isprintable():
        raise ValueError(f"source is the name of the {what}, 1 to 64 printable characters, got {source!r}")


class SensorPublisher:
    """Publish samples of a device of one's own.

        with modelserver.SensorPublisher("imu") as publisher:
            publisher.imu(angular_velocity=(0.0, 0.0, 0.1), specific_force=(0.0, 0.0, 9.81))

    Each method checks shapes and units, stamps the sample, encodes and publishes it, and returns it. `at` is when it
    was measured, by default now. What is not given is published as not measured. Raises ValueError for what cannot be.

    Parameters
    ----------
    source
        Name of the device, in the header of its samples: always the same.
    url
        LCM provider, default $LCM_DEFAULT_URL, else loopback.
    channel_prefix
        Prefix of the vehicle's channels.
    channels
        Channels by kind of sample (gps, imu, wheels, joints, status, measurement), where the vehicle file names others
        than GPS, IMU, WHEELS, JOINTS, VEHICLE_STATUS and MEASUREMENT.
    """

    def __init__(
        self, source: str, *, url: str = "", channel_prefix: str = "", channels: Mapping[str, str] | None = None
    ):
        check_source(source, "device")
        if unknown := set(channels or {}) - set(CHANNELS):
            raise ValueError(f"channels has the kinds {', '.join(CHANNELS)}, got {', '.join(sorted(unknown))}")
        self.source = source
        self._channels = {kind: f"{channel_prefix}{name}" for kind, name in {**CHANNELS, **(channels or {})}.items()}
        self._sequence = dict.fromkeys(CHANNELS, 0)
        self._bus: lcm.LCM | None = open_lcm(resolve_url(url))

    def close(self) -> None:
        """Leave the bus. Further samples raise ValueError."""
        self._bus = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def imu(
        self,
        angular_velocity: Iterable[float] | None = None,
        specific_force: Iterable[float] | None = None,
        *,
        magnetic_field: Iterable[float] | None = None,
        quaternion: Iterable[float] | None = None,
        reference: OrientationReference = OrientationReference.ENU,
        yaw_source: YawSource = YawSource.NONE,
        temperature_celsius: float = NAN,
        at: Time = 0,
    ) -> ImuSample:
        """Publish a sample of an inertial unit, along its own axes: rad/s; m/s2, at rest 9.81 up; tesla.

        `quaternion` (w, x, y, z) is its own orientation in `reference`, with a yaw from `yaw_source`.
        """
        rate = _read_vector("angular_velocity", angular_velocity, MAX_RATE, "rad/s", "is it in degrees per second?")
        force = _read_vector("specific_force", specific_force, MAX_FORCE, "m/s2", "is it in milli-g?")
        field = _read_vector("magnetic_field", magnetic_field, 0.01, "tesla", "is it in microtesla or gauss?")
        if rate is None and force is None:
            raise ValueError("imu needs angular_velocity, specific_force, or both")
        orientation = None
        if quaternion is not None:
            w, x, y, z = _read_numbers("quaternion", quaternion, 4)
            norm = math.sqrt(w * w + x * x + y * y + z * z)
            if abs(norm - 1.0) > 0.01:
                raise ValueError(f"quaternion is a unit quaternion w, x, y, z, got one of length {norm:g}")
            orientation = (w / norm, x / norm, y / norm, z / norm)
        sample = ImuSample(
            self._make_header("imu", at),
            rate,
            force,
            field,
            orientation,
            OrientationReference.NONE if orientation is None else reference,
            YawSource.NONE if orientation is None else yaw_source,
            temperature_celsius=float(temperature_celsius),
        )
        return self._publish("imu", sample)

    def gps(
        self,
        latitude_deg: float,
        longitude_deg: float,
        height_ellipsoidal: float = NAN,
        *,
        fix_type: FixType = FixType.FIX_3D,
        sigma: Iterable[float] | None = None,
        height_msl: float = NAN,
        undulation: float = NAN,
        velocity: Iterable[float] | None = None,
        satellites: int = -1,
        hdop: float = NAN,
        at: Time = 0,
    ) -> GpsSample:
        """Publish a fix of the antenna's phase center: degrees, meters above the ellipsoid.

        `sigma`: standard deviations east, north, up, m. `velocity`: east, north, up, m/s.
        """
        latitude, longitude = float(latitude_deg), float(longitude_deg)
        if fix_type is not FixType.NONE and not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 360.0):
            raise ValueError(f"a fix has latitude -90 to 90 and longitude -180 to 360 deg, got {latitude}, {longitude}")
        covariance: Matrix3 | None = None
        if sigma is not None:
            east, north, up = _read_numbers("sigma", sigma, 3)
            if not (east > 0.0 and north > 0.0 and up > 0.0):
                raise ValueError(f"sigma is east, north, up above 0 m, got {(east, north, up)}")
            covariance = (east * east, 0.0, 0.0, 0.0, north * north, 0.0, 0.0, 0.0, up * up)
        sample = GpsSample(
            self._make_header("gps", at),
            fix_type,
            latitude,
            longitude,
            float(height_ellipsoidal),
            float(height_msl),
            float(undulation),
            int(satellites),
            float(hdop),
            position_covariance=covariance,
            velocity=_read_vector("velocity", velocity, MAX_SPEED, "m/s", "is it in another unit?"),
            velocity_latency=NAN if velocity is None else 0.0,
        )
        return self._publish("gps", sample)

    def wheels(
        self,
        speeds: Mapping[str, float] | None = None,
        *,
        travel: Mapping[str, float] | None = None,
        steering: Mapping[str, float] | None = None,
        speed_sigma: float = NAN,
        is_signed: bool = True,
        at: Time = 0,
    ) -> WheelsSample:
        """Publish speeds (m/s) and travels (m, since the start) of wheels by name, forward positive.

        `steering`: angles of steered wheels, radians to the left. `is_signed` False: nothing measures the direction.
        """
        speeds, travel, steering = speeds or {}, travel or {}, steering or {}
        if not speeds and not travel:
            raise ValueError("wheels needs speeds or travel by the names of the wheels, e.g. {'left': 1.2}")
        for name, speed in speeds.items():
            if abs(speed) > MAX_SPEED:
                raise ValueError(f"speed of wheel {name} is in m/s, got {speed:g}; is it in another unit?")
        direction = Direction.UNKNOWN if is_signed else Direction.UNSIGNED
        wheels = tuple(
            WheelSample(
                name,
                travel=float(travel.get(name, NAN)),
                speed=float(speeds.get(name, NAN)),
                speed_sigma=float(speed_sigma),
                direction=direction,
                steering=float(steering.get(name, 0.0)),
            )
            for name in dict.fromkeys((*speeds, *travel))
        )
        return self._publish("wheels", WheelsSample(self._make_header("wheels", at), wheels))

    def joints(
        self,
        positions: Mapping[str, float],
        *,
        rates: Mapping[str, float] | None = None,
        sigmas: Mapping[str, float] | None = None,
        at: Time = 0,
    ) -> JointsSample:
        """Publish positions of joints by the names of their constraints: radians or meters, and their rates."""
        rates, sigmas = rates or {}, sigmas or {}
        if not positions:
            raise ValueError("joints needs positions by the names of the constraints, e.g. {'Pan': 0.3}")
        if unknown := {*rates, *sigmas} - set(positions):
            raise ValueError(f"a rate or sigma is of a joint with a position, got {', '.join(sorted(unknown))}")
        joints = tuple(
            JointSample(name, float(value), float(sigmas.get(name, NAN)), float(rates.get(name, NAN)))
            for name, value in positions.items()
        )
        return self._publish("joints", JointsSample(self._make_header("joints", at), joints))

    def status(self, *, forward_speed: float = NAN, steering_angle: float = NAN, at: Time = 0) -> VehicleStatusSample:
        """Publish the speed (m/s) and the steering angle (rad, to the left) that a vehicle controller reports."""
        if abs(forward_speed) > MAX_SPEED:
            raise ValueError(f"forward_speed is in m/s, got {forward_speed:g}; is it in another unit?")
        if abs(steering_angle) > math.pi / 2:
            raise ValueError(f"steering_angle is in radians, got {steering_angle:g}; is it in degrees?")
        header = self._make_header("status", at)
        sample = VehicleStatusSample(header, forward_speed=float(forward_speed), steering_angle=float(steering_angle))
        return self._publish("status", sample)

    def measurement(
        self, values: Iterable[float], *, sigma: Iterable[float] | None = None, frame: str = "", at: Time = 0
    ) -> MeasurementSample:
        """Publish a measurement of a type of an installed package: its numbers, in that type's order and units.

        `sigma`: their standard deviations. `frame`: the frame that measures, where the type needs one.
        """
        numbers = tuple(float(each) for each in values)
        numbers = _read_numbers("values", numbers, min(max(len(numbers), 1), MAX_VALUES))
        covariance: tuple[float, ...] = ()
        if sigma is not None:
            sigmas = _read_numbers("sigma", sigma, len(numbers))
            if min(sigmas) <= 0.0:
                raise ValueError(f"sigma is above 0, got {sigmas}")
            covariance = tuple(s * s if i == j else 0.0 for i, s in enumerate(sigmas) for j in range(len(sigmas)))
        return self._publish(
            "measurement", MeasurementSample(self._make_header("measurement", at), numbers, frame, covariance)
        )

    def _make_header(self, kind: str, at: Time) -> SensorHeader:
        now = time.time_ns() // 1000
        number, self._sequence[kind] = self._sequence[kind], self._sequence[kind] + 1
        return SensorHeader(to_utime(at) or now, self.source, number, now)

    def _publish(self, kind: str, sample: S) -> S:
        if self._bus is None:
            raise ValueError("this SensorPublisher is closed")
        self._bus.publish(self._channels[kind], encode(sample))
        return sample


def _read_numbers(name: str, values: Iterable[float], count: int) -> tuple[float, ...]:
    numbers = tuple(float(each) for each in values)
    if len(numbers) != count:
        raise ValueError(f"{name} has {count} numbers, got {len(numbers)}")
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} has finite numbers, got {numbers}; leave it out where it is not measured")
    return numbers


def _read_vector(name: str, values: Iterable[float] | None, most: float, unit: str, hint: str) -> Vector3 | None:
    if values is None:
        return None
    x, y, z = _read_numbers(name, values, 3)
    if max(abs(x), abs(y), abs(z)) > most:
        raise ValueError(f"{name} is in {unit}, got {(x, y, z)}; {hint}")
    return (x, y, z)


# --- commands ---------------------------------------------------------------------------------------------------------

CHANNEL = "VEHICLE_COMMAND"


class VehicleCommander:
    """Command the vehicle controller, through its driver.

        with modelserver.VehicleCommander("planner", key_file="commands.key") as commander:
            commander.drive(1.0, 0.1)   # again at least ten times a second

    The vehicle stops when the last command expires. Where the vehicle file has a key file, commands must be signed.

    Parameters
    ----------
    source
        Name of the commanding program: only one may command at a time.
    url, channel_prefix
        LCM provider, default $LCM_DEFAULT_URL, else loopback; prefix of the vehicle's channels.
    key_file
        The vehicle's key, default $MODELSERVER_KEY_FILE; without either, commands are not signed. Raises KeyFileError.
    """

    def __init__(self, source: str, *, url: str = "", channel_prefix: str = "", key_file: str | os.PathLike[str] = ""):
        check_source(source, "program")
        self._source, self._prefix, self._seq = source, channel_prefix, 0
        self._signer = load_signer(os.fspath(key_file), channel_prefix, source)
        self._bus: lcm.LCM | None = open_lcm(resolve_url(url))

    def drive(self, forward_speed: float, steering_angle: float = 0.0, *, valid_for: float = 0.3) -> VehicleCommand:
        """Command a speed (m/s, forward positive) and a steering angle (rad, to the left) for some seconds.

        Raises ValueError for what cannot be.
        """
        if not math.isfinite(forward_speed) or not abs(steering_angle) <= math.pi / 2 or not 0.0 < valid_for < 10.0:
            raise ValueError(
                "a command has a finite speed, a steering angle of at most pi/2 rad, and is valid for 0 to 10 s, got "
                f"{forward_speed}, {steering_angle}, {valid_for}"
            )
        utime = time.time_ns() // 1000
        command = VehicleCommand(utime, valid_for, self._seq, self._source, float(forward_speed), float(steering_angle))
        self._seq += 1
        if self._bus is None:
            raise ValueError("this VehicleCommander is closed")
        if self._signer is None:
            self._bus.publish(f"{self._prefix}{CHANNEL}", encode(command))
        else:
            self._bus.publish(f"{self._prefix}{DRIVE_SIGNED}", self._signer.seal(CHANNEL, encode(command)))
        return command

    def close(self) -> None:
        """Leave the bus. The vehicle stops when the last command expires."""
        self._bus = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
