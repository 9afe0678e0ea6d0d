"""Bars that benchmarks share: share of time valid, error beyond the limit while valid (HMI), and beyond the levels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Final

_FORMATS: Final = {
    "hmi": "HMI <= {:g} s/h",
    "valid": "valid >= {:.0%}",
    "beyond_level": "beyond level <= {:.1%}",
    "beyond_protection": "beyond protection <= {:.1%}",
    "rmse_ratio": "RMSE/raw <= {:g}",
    "epochs_per_minute": "epochs <= {:g}/min",
    "moved": "moved <= {:g} m",
    "turned_deg": "turned <= {:g} deg",
}


@dataclass(frozen=True)
class Required:
    """Bars of a row: `valid` at least, the others at most. None: 0 for `valid`, else infinite.

    `hmi`: seconds in an hour that the pose is valid with an error beyond its limit; `valid`, `beyond_level` and
    `beyond_protection`: shares of the time; `rmse_ratio`: RMSE of the position over that of the raw fixes;
    `epochs_per_minute`: new epochs of the pose; `moved` (m) and `turned_deg`: movement of the pose while parked.
    """

    hmi: float = 5.0
    valid: float = 0.6
    beyond_level: float = math.inf
    beyond_protection: float = 0.001
    rmse_ratio: float = math.inf
    epochs_per_minute: float = math.inf
    moved: float = math.inf
    turned_deg: float = math.inf

    @property
    def text(self) -> str:
        """All bars as text."""
        return ", ".join(_FORMATS[name].format(bar) for name, bar in self._bars().items())

    def find_missed(self, figures: Mapping[str, float]) -> list[str]:
        """Return the bars that figures, by the names of the bars, miss; one that is nan misses its bar."""
        return [
            _FORMATS[name].format(bar)
            for name, bar in self._bars().items()
            if not (figures[name] >= bar if name == "valid" else figures[name] <= bar)
        ]

    def _bars(self) -> dict[str, float]:
        return {name: bar for name, bar in asdict(self).items() if bar != (0.0 if name == "valid" else math.inf)}


HEALTHY: Final = Required(hmi=0.0, valid=0.97, beyond_level=0.001)
FAULT: Final = Required()
"""A fault that leaves a usable pose."""
MILD_FAULT: Final = Required(valid=0.9)
"""A fault that the other sensors bridge: multipath, gyro, latency, lever arm, encoders."""
GAPS: Final = Required(hmi=0.0, beyond_protection=0.01)
"""Outages of 30 s, also without wheels."""
