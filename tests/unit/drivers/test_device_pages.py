"""The pages on devices name every setting with its default, every fault of an emulator and every kind of device."""

from __future__ import annotations

import dataclasses
import re
from enum import Enum
from pathlib import Path
from typing import Any

import pytest

from msdrivers.devices.axis_settings import AxisSettings, NodMap
from msdrivers.devices.gps import GpsSettings
from msdrivers.devices.gx1 import Gx1Settings
from msdrivers.devices.vehicle_settings import LimitsMap, VehicleSettings
from msdrivers.devices.wheels import WheelsSettings
from msdrivers.line_settings import CanSettings, ModbusSettings, SerialSettings, TcpSettings
from msdrivers.protocol.can.mapping import CommandMap, CountMap, DirectionMap, SignalMap, SpeedMap, StatusMap, WheelMap
from msdrivers.protocol.modbus.axis_map import AxisRegisters
from msdrivers.protocol.modbus.numbers import RegisterMap
from msdrivers.registry import KINDS
from msdrivers.settings import COMMON, SOURCE

DOCS = Path(__file__).resolve().parents[3] / "docs"

TABLES: dict[str, tuple[type, ...]] = {
    "device-gps.md": (GpsSettings,),
    "device-gx1.md": (Gx1Settings,),
    "device-wheels.md": (WheelsSettings, WheelMap, VehicleSettings, LimitsMap),
    "device-axis.md": (AxisSettings, NodMap, AxisRegisters, RegisterMap),
    "drivers.md": (SerialSettings, TcpSettings, CanSettings, ModbusSettings),
}
"""Settings that stand in the tables of a page, in their order there."""

NAMED = (CountMap, SpeedMap, DirectionMap, SignalMap, StatusMap, CommandMap)
"""Settings that device-wheels.md names within other rows and sentences."""

OTHERWISE = {
    (GpsSettings, "protocol"): "named below the table: `device` sets it",
    (SerialSettings, "baud"): "0 stands for the maker's",
}


def _text(page: str) -> str:
    return (DOCS / page).read_text(encoding="utf-8")


def _said(default: Any) -> set[str]:
    """Return the ways in which a page may write a default."""
    if default is dataclasses.MISSING:
        return {"required", ""}
    if default in (None, "", ()):
        return {"none", "any", ""}
    if dataclasses.is_dataclass(default):
        return {"below"}
    if isinstance(default, Enum):
        return {str(default.value)}
    if isinstance(default, tuple):
        return {", ".join(map(str, default))}
    if isinstance(default, bool):
        return {str(default).lower()}
    return {f"{default:g}", str(default)} if isinstance(default, int | float) else {default}


@pytest.mark.parametrize(
    ("page", "kind"), [(page, kind) for page, kinds in TABLES.items() for kind in kinds], ids=lambda each: str(each)
)
def test_given_a_page_then_its_tables_have_every_setting_with_its_default(page: str, kind: type) -> None:
    rows = re.findall(r"^\| `(\w+)` \| ([^|]*) \|", _text(page), re.MULTILINE)
    for field in dataclasses.fields(kind):
        if field.name == SOURCE or (kind, field.name) in OTHERWISE:
            continue
        defaults = [default.strip().strip("`") for name, default in rows if name == field.name]
        assert defaults, f"{page} lacks {kind.__name__}.{field.name}"
        wanted = _said(field.default)
        # a setting whose meaning is as above refers to the row above, and so may its default
        assert wanted & set(defaults), f"{page}: {field.name} has {defaults}, and its default is {wanted}"


def test_given_settings_within_others_then_the_page_names_them() -> None:
    names = set(re.findall(r"`(\w+)`", _text("device-wheels.md")))
    for kind in NAMED:
        missing = {field.name for field in dataclasses.fields(kind)} - names
        assert not missing, f"device-wheels.md lacks {kind.__name__}: {missing}"


def test_given_a_kind_of_device_then_the_overview_names_it_and_its_faults() -> None:
    text = _text("drivers.md")
    for kind in KINDS.values():
        assert f"| `{kind.name}` |" in text
        for fault in kind.faults:
            assert f"| `{fault}` |" in text
    for key in COMMON:
        assert f"| `{key}` |" in text


@pytest.mark.parametrize("page", [*TABLES, "own-device.md"])
def test_given_a_page_then_its_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", _text(page)):
        assert (DOCS / target).exists(), f"{page} names {target}"
