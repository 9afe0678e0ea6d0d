"""Emulators of devices: each an `Endpoint` at the device's end of a line."""

from __future__ import annotations

from typing import NamedTuple


class InjectedFault(NamedTuple):
    """A fault `at` seconds after the start; the meaning of `amount` depends on the kind."""

    at: float
    kind: str
    amount: float = 1.0
