"""What is to go wrong with an emulated device, and when."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from modelserver.errors import nearest_names, shown

FAULTS: Mapping[str, str] = {
    "drop": "units that are lost",
    "corrupt": "units that arrive damaged",
    "stall": "seconds without a word",
    "restart": "seconds that it takes to start anew",
    "jump": "seconds by which its time jumps ahead",
}
"""Kinds of faults that every emulator knows, and what the amount of each is where the emulator does not differ."""


class InjectedFault(NamedTuple):
    """Something that goes wrong `at` seconds after the start; of what the `amount` is depends on the kind."""

    at: float
    kind: str
    amount: float = 1.0


def parse_fault(text: str, known: Mapping[str, str] = FAULTS) -> InjectedFault:
    """Return the fault of `KIND@SECONDS[:AMOUNT]`, one of the `known` kinds.

    Raises ValueError that says what is wrong with the text.
    """
    kind, at_sign, when = text.partition("@")
    if not at_sign:
        raise ValueError(f"{shown(text, 40)} is not of the form KIND@SECONDS[:AMOUNT], e.g. stall@10:2")
    if kind not in known:
        near = nearest_names(kind, known)
        kinds = "; ".join(f"{name}: {amount}" for name, amount in known.items())
        hint = f"did you mean {near[0]}?" if near else f"there are, with their amounts: {kinds}"
        raise ValueError(f"{shown(kind, 40)} is no fault; {hint}")
    at, _, amount = when.partition(":")
    try:
        fault = InjectedFault(float(at), kind, float(amount) if amount else 1.0)
    except ValueError:
        raise ValueError(f"{shown(when, 40)} is not of the form SECONDS[:AMOUNT], e.g. 10:2") from None
    if not (0.0 <= fault.at < 1e9 and 0.0 < fault.amount < 1e9):
        raise ValueError(f"{shown(when, 40)}: seconds are 0 or more, an amount is above 0")
    return fault
