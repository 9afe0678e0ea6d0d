"""The measurements: small classes, each comparing one kind of sample with the state. Pure.

`REGISTRY` has them by name; `register` adds one, also from outside the library.
"""

from modelserver.estimation.filter.measurements import aiding, gps, orientation, wheels
from modelserver.estimation.filter.measurements.base import REGISTRY, Compared, Measurement, Scene, register

__all__ = ["REGISTRY", "Compared", "Measurement", "Scene", "aiding", "gps", "orientation", "register", "wheels"]
