"""The vehicle's geometry: bodies, frames, constraints, and the graph they make. Pure."""

from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.geometry.model import Model, Search
from modelserver.geometry.parts import Body, BodyFrame, Constraint, JointType, Sigma

__all__ = [
    "Body",
    "BodyBuilder",
    "BodyFrame",
    "Constraint",
    "JointType",
    "Model",
    "ModelBuilder",
    "Search",
    "Sigma",
]
