"""Measurements of installed packages: their types by name, and their place in the filter.

A source of the vehicle file (`sensors.aiding`) names the type of its measurements; `MEASUREMENT_TYPES` has the object
that compares them with the state, which a package adds by an entry point of the group `modelserver.measurements`. Its
samples are all `MeasurementSample`, so the wire, the journal and its schema are the same with and without it: a stored
state has only the name of the type.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from modelserver.estimation.filter.error_layout import ErrorState
from modelserver.estimation.filter.eskf import Innovation
from modelserver.estimation.filter.measurements.measurement import (
    MeasurementContext,
    choose_covariance,
    register,
)
from modelserver.estimation.filter.settings import FilterSettings
from modelserver.estimation.sensor_rig import SensorRig
from modelserver.messages import MeasurementSample
from modelserver.plugins import PluginRegistry
from modelserver.transforms.so3 import Array

PLUGIN_GROUP = "modelserver.measurements"
"""Group of the entry points of measurements."""


class MeasurementType(Protocol):
    """What compares the measurements of one type with the state. Pure: the same arguments give the same bits.

    Attributes
    ----------
    states: the additional error states that it needs, one set for all sources of the type.
    values: names of the numbers of a sample, with units, in order.
    is_absolute: whether it measures a place or course in the world; mode dead_reckoning does not use it then.
    """

    states: tuple[ErrorState, ...]
    values: tuple[str, ...]
    is_absolute: bool

    def evaluate(self, context: MeasurementContext, sample: MeasurementSample) -> Innovation | str:
        """Return the innovation, or in one word why there is none."""
        ...


def _find_fault(name: str, loaded: Any) -> str:
    """Return why an object is no type of measurement; empty if it is one."""
    states, values = getattr(loaded, "states", None), getattr(loaded, "values", None)
    if isinstance(loaded, type):
        return f"is a class; name an object of it: {loaded.__name__.upper()} = {loaded.__name__}()"
    if not callable(getattr(loaded, "evaluate", None)):
        return "has no method evaluate(context, sample)"
    if not isinstance(states, tuple) or not all(isinstance(each, ErrorState) for each in states):
        return "has no tuple of ErrorState as states"
    if not isinstance(values, tuple) or not values or not all(isinstance(each, str) for each in values):
        return "has no tuple of names as values"
    return "" if isinstance(getattr(loaded, "is_absolute", None), bool) else "does not state whether it is_absolute"


MEASUREMENT_TYPES: PluginRegistry[MeasurementType] = PluginRegistry(PLUGIN_GROUP, _find_fault)
"""The types of measurements of installed packages, by name."""


def get_type(name: str) -> MeasurementType:
    """Return a type of measurement. Raises LookupError if no installed package defines it, or it cannot be used."""
    found = MEASUREMENT_TYPES.get(name)
    if found is None:
        why = MEASUREMENT_TYPES.problems.get(name, "no installed package defines it")
        raise LookupError(f"measurements of type {name}: {why}")
    return found


@register
@dataclass(frozen=True, slots=True)
class OwnMeasurement:
    """Measurement of an installed package, of the type with this name; an empty name: of an unknown source."""

    kind: ClassVar[str] = "own"
    sample: ClassVar[type] = MeasurementSample
    states: ClassVar[tuple[ErrorState, ...]] = ()

    type: str

    @classmethod
    def create(cls, rig: SensorRig, settings: FilterSettings) -> Self | None:
        """Return None: `split_sample` makes one by the type of a sample's source."""
        return None

    @property
    def is_absolute(self) -> bool:
        """Whether it measures a place or course in the world."""
        return not self.type or get_type(self.type).is_absolute

    def get_utime(self, sample: MeasurementSample) -> int | None:
        return sample.header.utime

    def evaluate(self, context: MeasurementContext, sample: MeasurementSample) -> Innovation | str:
        """Return what its type makes of it; `fault` where that fails, or returns what the filter cannot use."""
        if not self.type:
            return "source"
        if sample.frame and (fault := context.rig.find_problem(sample.frame)):
            return fault
        found = get_type(self.type)
        if len(sample.values) != len(found.values):
            return "size"
        if not all(map(math.isfinite, sample.values)):
            return "nan"
        try:
            innovation = found.evaluate(context, sample)
            if isinstance(innovation, str):
                return innovation
            size = len(innovation.residual)
            shapes = ((size,), (size, context.layout.size), (size, size))
            arrays = (innovation.residual, innovation.jacobian, innovation.noise)
            is_usable = size > 0 and all(map(_has_shape, arrays, shapes)) and _is_covariance(innovation.noise)
        except Exception:
            return "fault"  # of the package: the others' measurements are used on
        return innovation if is_usable else "fault"


def _has_shape(given: Array, shape: tuple[int, ...]) -> bool:
    return bool(given.shape == shape and np.isfinite(given).all())


def _is_covariance(given: Array) -> bool:
    return bool(np.array_equal(given, given.T) and np.linalg.eigvalsh(given)[0] > 0.0)


def read_covariance(sample: MeasurementSample, sigma: float) -> Array:
    """Return the covariance (n, n) of a sample's values if it states one that is positive definite, else of `sigma`."""
    n = len(sample.values)
    stated = np.array(sample.covariance).reshape(n, n) if sample.covariance else None
    return choose_covariance(stated, n, sigma)
