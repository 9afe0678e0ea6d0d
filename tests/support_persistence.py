"""A persisted state of the vehicle of the filter's scenario tests."""

from __future__ import annotations

import numpy as np
from support_filter import RIG

from modelserver.estimation.filter.state import Setup
from modelserver.estimation.filter.warm_start import get_setup_hash
from modelserver.messages import PersistedPose, PersistedState

SETUP = Setup(RIG)
UTIME = 1_750_000_000_000_000

POSE = PersistedPose(
    50.27,
    -111.18,
    700.0,
    (1.5, -2.25, 0.5),
    (0.8, 0.0, 0.0, 0.6),
    (0.1, -0.1, 0.0),
    (0.01, 0.01, 0.02),
    0.25,
    1.5,
    UTIME - 300_000,
    1000,
    2,
    "wheels",
    1234,
    (("left", 56.25), ("right", 57.5)),
)

PERSISTED = PersistedState(
    "cart",
    UTIME,
    5_000_000_000,
    "",
    get_setup_hash(SETUP),
    UTIME - 10_000,
    SETUP.layout.names,
    (0.001, -0.002, 0.003),
    (0.01, 0.02, -0.03),
    tuple(0.01 * k for k in range(SETUP.layout.size - 15)),
    tuple((np.eye(SETUP.layout.size) * 1e-4).ravel().tolist()),
    POSE,
)
