"""A vehicle file with some of its values changed, for experiments and to choose the mode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from modelserver.config import load_config
from modelserver.service.daemon import Vehicle, load_vehicle


def vehicle_with(path: Path, settings: Mapping[str, str], mode: str, directory: Path) -> Vehicle:
    """Load a vehicle file with values changed; `directory` takes the changed file, if there is one.

    A key with a dot is a place in the vehicle file (`sensors.wheels.channel`); one without is a setting of the filter
    (`localization.filter.KEY`). A value is YAML; an empty one takes the key away. `mode` goes to `localization.mode`;
    empty leaves it. A key that the vehicle file does not know is an error, by the vehicle file's own strictness:
    raises ConfigError with the nearest known one.
    """
    if not settings and not mode:
        return load_vehicle(load_config(path), str(path))
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    content["geometry"] = str((path.parent / content["geometry"]).resolve())
    for key, value in settings.items():
        _put(content, (key if "." in key else f"localization.filter.{key}").split("."), value)
    if mode:
        _put(content, ["localization", "mode"], mode)
    changed = directory / path.name
    changed.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return load_vehicle(load_config(changed), str(changed))


def _put(content: dict[str, Any], keys: list[str], value: str) -> None:
    for key in keys[:-1]:
        content = content.setdefault(key, {})
    if value:
        content[keys[-1]] = yaml.safe_load(value)
    else:
        content.pop(keys[-1], None)
