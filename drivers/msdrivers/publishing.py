"""A driver's way to the bus: which sample goes out on which channel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from modelserver.messages import DriverHealth, Sample
from modelserver.wire.codec import encode
from msdrivers.registry import CHANNELS

HEALTH = "DRIVER_HEALTH"


@dataclass(frozen=True, slots=True)
class Publisher:
    """Encodes and sends. channels: of kinds of samples, without prefix; others go out on their customary ones."""

    send: Callable[[str, bytes], object]
    channels: Mapping[type, str]
    prefix: str = ""

    def sample(self, sample: Sample) -> None:
        """Send a sample."""
        kind = type(sample)
        self.send(f"{self.prefix}{self.channels.get(kind) or CHANNELS[kind]}", encode(sample))

    def health(self, health: DriverHealth) -> None:
        """Send a report."""
        self.send(f"{self.prefix}{HEALTH}", encode(health))
