"""Standard terms lead to the code: the module that does it is among the first that a grep lists.

The terms come from the indexes of Groves (2013), PX4's EKF2, tf2 and robot_localization.
"""

from __future__ import annotations

from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("modelserver", "drivers/msdrivers", "tools/mstools")

FILTER = "modelserver/estimation/filter"

TERMS = {
    # Groves
    "lever arm": "modelserver/transforms/transformation.py",
    "specific force": "modelserver/estimation/raw/localizer.py",
    "strapdown": f"{FILTER}/eskf.py",
    "error state": f"{FILTER}/eskf.py",
    "local level": f"{FILTER}/eskf.py",
    "Earth rotation": "modelserver/earth/__init__.py",
    "Somigliana": "modelserver/earth/__init__.py",
    "WGS 84": "modelserver/earth/geodesy.py",
    "transverse Mercator": "modelserver/earth/geodesy.py",
    "grid convergence": "modelserver/earth/geodesy.py",
    "tangent plane": "modelserver/earth/geodesy.py",
    "undulation": "modelserver/estimation/inputs.py",
    "declination": "modelserver/earth/magnetism.py",
    "World Magnetic Model": "modelserver/earth/magnetism.py",
    "hard iron": "tools/mstools/calibration/ellipsoid.py",
    "soft iron": "tools/mstools/calibration/ellipsoid.py",
    "Allan deviation": "tools/mstools/calibration/allan.py",
    "angle random walk": "tools/mstools/calibration/allan.py",
    "bias instability": "tools/mstools/calibration/allan.py",
    "Gauss-Markov": f"{FILTER}/eskf.py",
    "coarse alignment": f"{FILTER}/leveling.py",
    "leveling": f"{FILTER}/leveling.py",
    "heading alignment": f"{FILTER}/heading_alignment.py",
    "ZUPT": f"{FILTER}/measurements/wheels.py",
    "ZARU": f"{FILTER}/measurements/wheels.py",
    "non-holonomic": f"{FILTER}/measurements/wheels.py",
    "stationary detection": f"{FILTER}/sensor_monitors.py",
    "Joseph form": f"{FILTER}/eskf.py",
    "innovation": f"{FILTER}/eskf.py",
    "NIS": f"{FILTER}/eskf.py",
    "chi-square gate": f"{FILTER}/eskf.py",
    "measurement noise": f"{FILTER}/measurements/measurement.py",
    "process noise": f"{FILTER}/eskf.py",
    "dilution of precision": "modelserver/estimation/inputs.py",
    "protection level": f"{FILTER}/protection_levels.py",
    "integrity": f"{FILTER}/protection_levels.py",
    "dead reckoning": f"{FILTER}/bank_step.py",
    "quaternion": "modelserver/transforms/so3.py",
    "rotation vector": "modelserver/transforms/so3.py",
    "left Jacobian": "modelserver/transforms/so3.py",
    "adjoint": "modelserver/transforms/chain.py",
    "quantization": "tools/mstools/calibration/allan.py",
    "misalignment": "modelserver/simulation/sensors.py",
    # PX4 EKF2
    "out-of-sequence": f"{FILTER}/localizer.py",
    "delayed measurement": f"{FILTER}/localizer.py",
    "latency": f"{FILTER}/heading_alignment.py",
    "clock step": "modelserver/estimation/inputs.py",
    "dual antenna": f"{FILTER}/measurements/gnss.py",
    "position reset": f"{FILTER}/gnss_step.py",
    "covariance inflation": f"{FILTER}/warm_start.py",
    "warm start": f"{FILTER}/warm_start.py",
    "sensor timeout": "modelserver/core/__init__.py",
    "wheel slip": "modelserver/simulation/sensors.py",
    # tf2
    "time travel": "modelserver/query/view.py",
    "lookup": "modelserver/query/path.py",
    "state history": "modelserver/estimation/history.py",
    "interpolation": "modelserver/query/view.py",
    "extrapolation": "modelserver/client/mirror_state.py",
    "static transform": "modelserver/wire/codec.py",
    "frame tree": "modelserver/geometry/kinematic_path.py",
    "forward kinematics": "modelserver/geometry/kinematic_path.py",
    "slerp": "modelserver/transforms/so3.py",
    "spanning tree": "modelserver/geometry/topology.py",
    "loop closure": "modelserver/geometry/topology.py",
    "inertia tensor": "modelserver/geometry/parts.py",
    "parallel axis": "modelserver/geometry/parts.py",
    "twist": "modelserver/geometry/kinematic_path.py",
    # robot_localization
    "map frame": "modelserver/query/view.py",
    "REP-105": f"{FILTER}/output.py",
    "odometry": f"{FILTER}/output.py",
    "skid-steer": f"{FILTER}/measurements/wheels.py",
    "Ackermann": "modelserver/estimation/sensor_rig.py",
    "UTM": "modelserver/earth/geodesy.py",
    # service and drivers
    "rate limit": "modelserver/server/ingress.py",
    "round robin": "modelserver/server/requests.py",
    "duplicate publisher": "modelserver/server/ingress.py",
    "backoff": "drivers/msdrivers/runner.py",
    "dead-man": "drivers/msdrivers/devices/vehicle.py",
    "watchdog": "modelserver/server/supervision.py",
    "HMAC": "modelserver/signing.py",
    "replay attack": "modelserver/server/ingress.py",
    "clock drift": "drivers/msdrivers/device_clock.py",
    "checksum": "drivers/msdrivers/devices/stream.py",
    "multicast": "modelserver/server/diagnostics.py",
}


ROWS, FILES = 10, 5
"""How many rows of `grep -rniF TERM`, and files of `grep -rciF TERM` with the most rows first, one looks at."""


@cache
def read_product() -> dict[str, list[str]]:
    """Return the lines of the product's files, without the generated ones, in small letters; in the order of a grep."""
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8").lower().splitlines()
        for folder in FOLDERS
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path.name != "generated.py"
    }


@pytest.mark.parametrize(("term", "place"), TERMS.items())
def test_given_a_standard_term_then_its_place_is_among_the_first_that_a_grep_lists(term: str, place: str) -> None:
    rows = [path for path, lines in read_product().items() for line in lines if term.lower() in line]
    files = [path for path, _ in Counter(rows).most_common(FILES)]
    assert place in rows[:ROWS] or place in files, (len(rows), files)


def test_given_the_terms_then_there_are_enough() -> None:
    assert len(TERMS) >= 60
