"""Vehicle files with changed values, for experiments and to select the mode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from modelserver.config.vehicle_file import load_config
from modelserver.server.vehicle import Vehicle, load_vehicle


def load_with_overrides(path: Path, settings: Mapping[str, str], mode: str, directory: Path) -> Vehicle:
    """Load a vehicle file with changed values; `directory` gets the changed file, if there is one.

    A key with a dot is a path in the vehicle file (`sensors.wheels.channel`); one without is a filter setting
    (`localization.filter.KEY`). A value is YAML; an empty one removes the key. `mode` is `localization.mode`, unless
    empty. Raises ConfigError with the nearest known key for an unknown one.
    """
    if not settings and not mode:
        return load_vehicle(load_config(path), str(path))
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["geometry"] = str((path.parent / content["geometry"]).resolve())
    for key, value in settings.items():
        _set_value(content, (key if "." in key else f"localization.filter.{key}").split("."), value)
    if mode:
        _set_value(content, ["localization", "mode"], mode)
    changed = directory / path.name
    changed.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return load_vehicle(load_config(changed), str(changed))


def _set_value(content: dict[str, Any], keys: list[str], value: str) -> None:
    for key in keys[:-1]:
        content = content.setdefault(key, {})
    if value:
        content[keys[-1]] = yaml.safe_load(value)
    else:
        content.pop(keys[-1], None)
