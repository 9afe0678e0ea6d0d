"""The measurements: small classes, each comparing one kind of sample with the state. Pure.

`REGISTRY` has them by name; `register` adds one, also from outside the library.
"""

from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements import aiding, gnss, imu_orientation, wheels
from modelserver.estimation.filter.measurements.measurement import (
    REGISTRY,
    Measurement,
    MeasurementContext,
    register,
)

__all__ = [
    "REGISTRY",
    "Innovation",
    "Measurement",
    "MeasurementContext",
    "aiding",
    "gnss",
    "imu_orientation",
    "register",
    "wheels",
]
