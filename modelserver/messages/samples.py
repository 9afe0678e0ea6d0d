"""Samples of sensors. They are generated from the .lcm files."""

from __future__ import annotations

from typing import TypeAlias

from modelserver.messages.generated import (
    AbsolutePoseSample,
    GpsSample,
    ImuSample,
    JointsSample,
    RangeSample,
    RelativePoseSample,
    VehicleStatusSample,
    WheelsSample,
)

Sample: TypeAlias = (
    GpsSample
    | ImuSample
    | WheelsSample
    | VehicleStatusSample
    | JointsSample
    | AbsolutePoseSample
    | RelativePoseSample
    | RangeSample
)
