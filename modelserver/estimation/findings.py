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
        *_check_wheels(rig),
        *_check_steering(rig),
        *_check_antennas(rig),
        *_check_heading(rig),
    )


def _check_mode(rig: SensorRig, mode: Mode) -> Iterator[SensorFinding]:
    configured = {"gps": bool(rig.gps_frame), "imu": bool(rig.imu_frame), "wheels": bool(rig.wheel_frames)}
    for sensor, modes in _EXCLUDING_MODES.items():
        if configured[sensor] and mode in modes:
            yield SensorFinding(
                sensor,
                "mode",
                "localization.mode",
                f"mode {mode.name.lower()} does not use it",
                "switch to mode full where it should be used",
                is_choice=True,
            )


def _check_wheels(rig: SensorRig) -> Iterator[SensorFinding]:
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
    elif rig.kinematics == "ackermann" and len(rig.wheel_frames) == 1:
        text = "ackermann with a single wheel: the wheels measure no turn rate"
        yield SensorFinding("wheels", "single", frames, text, "name the wheels of the other side and axle too")


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
    if rig.gps_frame and not (rig.imu_frame or rig.wheel_frames or rig.second_antenna_frame):
        text = "no IMU, no wheels and no second antenna: heading is known above localization.filter.reverse_speed alone"
        yield SensorFinding("gps", "alone", "sensors.gps", text, "name an IMU or wheels")
