"""The vehicle's geometry: bodies, frames, constraints, and the graph that they form. Pure."""

from modelserver.geometry.builder import BodyBuilder, ModelBuilder
from modelserver.geometry.joint import Joint, JointType, Mimic
from modelserver.geometry.model import Model, Search
from modelserver.geometry.parts import Body, BodyFrame, Constraint, Material, Shape, ShapeKind, Sigma
from modelserver.geometry.topology import Neighbor

__all__ = [
    "Body",
    "BodyBuilder",
    "BodyFrame",
    "Constraint",
    "Joint",
    "JointType",
    "Material",
    "Mimic",
    "Model",
    "ModelBuilder",
    "Neighbor",
    "Search",
    "Shape",
    "ShapeKind",
    "Sigma",
]
