"""What the demo reports of its sensors: how many measurements were used of how many."""

from __future__ import annotations

from dataclasses import replace

import pytest

from modelserver.messages import ChannelHealth
from mstools.commands.demo import format_usage
from mstools.launch.processes import LaunchError
from mstools.terminal.health_text import as_data, format_report
from tests.unit.tools.test_status import WELL

WHEELS = ChannelHealth("sensor:wheels", 1230, 100.0, 0.01, measured=217, used=215)
JOINTS = ChannelHealth("sensor:front_axis", 900, 100.0, 0.01)


def test_given_a_report_then_the_demo_and_the_status_report_how_many_measurements_were_used() -> None:
    health = replace(
        WELL, channels=(JOINTS, WHEELS), warnings=(("sensors.gps (direction)", "not yet"), ("bus", "slow"))
    )
    assert format_usage(health) == ["wheels: 215 of 217 measurements used", "sensors.gps (direction): not yet"]
    (row,) = (line for line in format_report(health).splitlines() if "sensor:wheels" in line)
    assert "215/217" in row
    (data,) = (each for each in as_data(health)["channels"] if each["channel"] == "sensor:wheels")
    assert (data["measured"], data["used"]) == (217, 215)


def test_given_wheels_that_were_never_used_then_the_demo_fails_and_reports_why() -> None:
    warning = ("sensor:wheels", "1230 received, 0 of 217 measurements used; the last 217 were dropped: nan")
    health = replace(WELL, channels=(replace(WHEELS, used=0),), warnings=(warning,))
    with pytest.raises(LaunchError, match="no measurement of the wheels was used: sensor:wheels: 1230 received"):
        format_usage(health)
    with pytest.raises(LaunchError, match="no health report"):
        format_usage(None)
