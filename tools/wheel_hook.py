"""Build hook of hatch: an installation or a wheel has the Python of the .lcm files, and these in the package mslcm."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class WheelHook(BuildHookInterface):
    """Writes the generated modules, and adds every lcmtypes/NAME.lcm as mslcm/lcm/NAME.lcm."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the modules, and add the files to hatch's build data."""
        tools = str(Path(self.root, "tools"))
        if tools not in sys.path:
            sys.path.insert(0, tools)
        import generate_types

        generate_types.write(Path(self.root))
        for file in sorted(Path(self.root, "lcmtypes").glob("*.lcm")):
            build_data["force_include"][str(file)] = f"mslcm/lcm/{file.name}"
