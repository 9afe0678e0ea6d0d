"""Findings: configured sensors that localization cannot use, and why. Pure: from the vehicle's frames and the mode.

`find_unusable` checks what does not change while the filter runs; `modelserver check` reports it before a start. What
only the running filter knows (an inertial unit that measures no gravity, a steering angle that timed out) is added in
`LocalizerSummary.findings`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from modelserver.estimation.sensor_rig import MIN_WHEELBASE, SensorRig
from modelserver.messages import Mode, SensorFinding

MIN_BASELINE = 0.01
"""Meters between two antennas, horizontally, below which they give no heading."""

MIN_UP_SHARE = 0.9
"""Component of up along the axis of a gyro that measures the turn rate alone: 26 deg."""

_EXCLUDING_MODES: dict[str, tuple[Mode, ...]] = {
    "gps": (Mode.NO_GPS, Mode.DEAD_RECKONING),
    "imu": (Mode.NO_IMU,),
    "wheels": (Mode.NO_WHEELS, Mode.RAW),
}
"""By sensor: the modes that do not use it."""


def find_unusable(rig: SensorRig, mode: Mode) -> tuple[SensorFinding, ...]:
    """Return the configured sensors, or parts of their configuration, that a mode of localization cannot use."""
    return (
        *_check_mode(rig, mode),
        *_check_wheels(rig, mode),
        *_check_yaw_gyro(rig, mode),
        *_check_steering(rig),
        *_check_antennas(rig),
        *_check_heading(rig),
    )


def _check_mode(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    configured = {
        "gps": bool(rig.gps_frame),
        "imu": _has_gyro(rig),
        "wheels": bool(rig.wheel_frames),
    }
    for sensor, modes in _EXCLUDING_MODES.items():
        if configured[sensor] and mode in modes:
            yield SensorFinding(
                "speedometer" if sensor == "wheels" and rig.speedometer is not None else sensor,
                "mode",
                "localization.mode",
                f"mode {mode.name.lower()} does not use it",
                "switch to mode full where it should be used",
                is_choice=True,
            )


def _check_wheels(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    frames = "sensors.wheels.frames"
    if rig.has_wheels and not rig.wheel_frames:
        text = "frames names no wheels, so they are not used"
        yield SensorFinding(
            "wheels",
            "frames",
            frames,
            text,
            "write frames: {NAME: BODY:FRAME} with the names that the driver publishes",
        )
    elif len(rig.wheel_frames) == 1 and mode not in _EXCLUDING_MODES["wheels"]:
        sensor, element = ("wheels", frames) if rig.speedometer is None else ("speedometer", "sensors.speedometer")
        has_gyro = _has_gyro(rig) and mode is not Mode.NO_IMU
        if has_gyro:
            text = "one speed: used for the speed and while stationary, not for the turn rate, which is the IMU's"
            fix = ""
        else:
            text = "one speed and no IMU: nothing measures the turn rate, so the heading follows the fixes in each turn"
            fix = "name the wheels of both sides, or an IMU (imu.yaw_rate_only: true for a gyro alone)"
        yield SensorFinding(sensor, "single", element, text, fix, is_choice=has_gyro)


def _has_gyro(rig: SensorRig) -> bool:
    return bool(rig.imu_frame or rig.yaw_gyro_frame)


def _check_yaw_gyro(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    if rig.yaw_gyro is None:
        return
    share = abs(rig.yaw_gyro.share)
    if share < MIN_UP_SHARE:
        text = (
            f"its axis nearest to up is {math.degrees(math.acos(share)):.0f} deg off: it does not measure the turn rate"
        )
        yield SensorFinding("imu", "axis", "sensors.imu.frame", text, "correct the frame in the geometry")
    elif mode is Mode.RAW:
        text = "raw mode needs all three rates: with yaw_rate_only the IMU is not used"
        yield SensorFinding("imu", "mode", "localization.mode", text, "write mode: full")
    else:
        text = (
            "yaw rate only: used for the heading; the vehicle is taken to be level, and wheels or a speedometer are "
            "needed to know whether it is stationary or reverses"
        )
        yield SensorFinding("imu", "yaw_rate", "sensors.imu.yaw_rate_only", text, is_choice=True)


def _check_steering(rig: SensorRig) -> Iterator[SensorFinding]:
    signal, element = rig.steering, "sensors.wheels.steering"
    if signal is None:
        return
    if rig.kinematics == "skid_steer":
        text = "a skid-steered vehicle has no wheels that steer: the steering angle is not used"
        yield SensorFinding("wheels", "kinematics", element, text, "write kinematics: ackermann, or remove steering")
        return
    unknown = [name for name in signal.wheels if name not in rig.wheel_frames]
    if unknown:
        known = ", ".join(rig.wheel_frames) or "none"
        text = f"frames has no wheel {', '.join(unknown)}: the steering angle is not used for it (known: {known})"
        yield SensorFinding("wheels", "names", f"{element}.wheels", text, "write the names that frames has")
    contacts = {name: rig.pose(frame).xyz for name, frame in rig.wheel_frames.items()}
    steered = [name for name in signal.wheels if name in contacts]
    if signal.geometry == "ackermann" and steered and abs(signal.wheelbase(contacts)) < MIN_WHEELBASE:
        text = (
            f"the steered wheels are {signal.wheelbase(contacts):.2f} m ahead of the rolling frame: an angle gives no "
            "curvature and is not used"
        )
        fix = "name the middle of the axle that does not steer as rolling_frame, or write geometry: parallel"
        yield SensorFinding("wheels", "wheelbase", element, text, fix)


def _check_antennas(rig: SensorRig) -> Iterator[SensorFinding]:
    if not (rig.gps_frame and rig.second_antenna_frame):
        return
    a, b = rig.pose(rig.gps_frame).xyz, rig.pose(rig.second_antenna_frame).xyz
    if math.hypot(b[0] - a[0], b[1] - a[1]) <= MIN_BASELINE:
        text = f"{rig.second_antenna_frame} is above {rig.gps_frame}: the two antennas give no heading"
        fix = "name the frame of the other antenna's phase center"
        yield SensorFinding("gps", "baseline", "sensors.gps.second_frame", text, fix)


def _check_heading(rig: SensorRig) -> Iterator[SensorFinding]:
    if rig.gps_frame and not (_has_gyro(rig) or rig.wheel_frames or rig.second_antenna_frame):
        text = "no IMU, no wheels and no second antenna: heading is known above localization.filter.reverse_speed alone"
        yield SensorFinding("gps", "alone", "sensors.gps", text, "name an IMU or wheels")
