"""Dynamics of a model: mass matrix, bias vector, forward dynamics, center of mass, stability (report eq. 7-10). Pure.

Pinocchio, of the extra `dynamics`, does the algebra; it is imported when a `Dynamics` is made.
"""

from modelserver.dynamics.multibody import STANDARD_GRAVITY, CenterOfMass, Dynamics
from modelserver.dynamics.stability import Stability, TipOver, assess_stability, compute_tip_over, find_contacts
from modelserver.dynamics.tree import MassUncertainty

__all__ = [
    "STANDARD_GRAVITY",
    "CenterOfMass",
    "Dynamics",
    "MassUncertainty",
    "Stability",
    "TipOver",
    "assess_stability",
    "compute_tip_over",
    "find_contacts",
]
