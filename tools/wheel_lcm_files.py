"""Build hook of hatch: a wheel has the .lcm files in the package of the Python that is generated from them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class LcmFilesHook(BuildHookInterface):
    """Adds every lcmtypes/NAME.lcm as mslcm/lcm/NAME.lcm."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Tell hatch of the files before it builds a wheel."""
        for file in sorted(Path(self.root, "lcmtypes").glob("*.lcm")):
            build_data["force_include"][str(file)] = f"mslcm/lcm/{file.name}"
