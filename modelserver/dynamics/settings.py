"""Settings of the service's dynamics: the section `dynamics` of the vehicle file."""

from __future__ import annotations

import math
from dataclasses import dataclass

MAX_CONTACTS = 16
"""Contacts with the ground: as many as a health report holds."""


@dataclass(frozen=True, slots=True)
class DynamicsSettings:
    """Dynamics of the vehicle. With this section the service loads Pinocchio and answers PLATFORM_GET_DYNAMICS."""

    allow_massless: bool = False
    """Whether bodies without inertia count as massless; else they are an error."""
    cut_loops: bool = False
    """Whether constraints that close loops are left out; else they are an error."""
    mass_sigma: float = 0.05
    """Standard deviation of each body's mass, as a fraction of it."""
    center_sigma: float = 0.02
    """Standard deviation of each body's center of mass along each axis, meters."""
    contacts: tuple[str, ...] = ()
    """Frames at the contacts with the ground, three or more: then health reports have the tip-over margin."""
    margin_limit: float = 0.1
    """Tip-over margin below which the service warns, radians."""

    def __post_init__(self) -> None:
        problems = [
            f"{key} is between 0 and 1, got {value:g}"
            for key, value in (("mass_sigma", self.mass_sigma), ("center_sigma", self.center_sigma))
            if not 0.0 <= value <= 1.0
        ]
        if not 0.0 <= self.margin_limit <= math.pi / 2:
            problems.append(f"margin_limit is between 0 and 1.57 radians, got {self.margin_limit:g}")
        if self.contacts and not 3 <= len(set(self.contacts)) == len(self.contacts) <= MAX_CONTACTS:
            problems.append(f"contacts names 3 to {MAX_CONTACTS} different frames, got {len(self.contacts)}")
        if problems:
            raise ValueError("\n".join(problems))
