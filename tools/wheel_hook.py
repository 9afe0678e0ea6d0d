"""Build hook of hatch: a wheel contains the .lcm files in the package of the generated Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WheelHook(BuildHookInterface):
    """Adds every lcmtypes/NAME.lcm as mslcm/lcm/NAME.lcm."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the files to hatch's build data."""
        for file in sorted(Path(self.root, "lcmtypes").glob("*.lcm")):
            build_data["force_include"][str(file)] = f"mslcm/lcm/{file.name}"
