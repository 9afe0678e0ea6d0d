"""The measurements: small classes, each comparing one kind of sample with the state. Pure.

`REGISTRY` has this package's by name, `MEASUREMENT_TYPES` those of installed packages.
"""

from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements import aiding, gnss, imu_orientation, own, wheels
from modelserver.estimation.filter.measurements.measurement import (
    REGISTRY,
    Measurement,
    MeasurementContext,
    register,
)
from modelserver.estimation.filter.measurements.own import MEASUREMENT_TYPES

__all__ = [
    "MEASUREMENT_TYPES",
    "REGISTRY",
    "Innovation",
    "Measurement",
    "MeasurementContext",
    "aiding",
    "gnss",
    "imu_orientation",
    "own",
    "register",
    "wheels",
]
