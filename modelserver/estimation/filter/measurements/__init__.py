"""The measurements: small classes, each comparing one kind of sample with the state. Pure.

`REGISTRY` has this package's by name, `MEASUREMENT_TYPES` those of installed packages.
"""

from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements import gnss, measurement, wheels
from modelserver.estimation.filter.measurements.measurement import (
    MEASUREMENT_TYPES,
    REGISTRY,
    Measurement,
    MeasurementContext,
    register,
)

__all__ = [
    "MEASUREMENT_TYPES",
    "REGISTRY",
    "Innovation",
    "Measurement",
    "MeasurementContext",
    "gnss",
    "measurement",
    "register",
    "wheels",
]
