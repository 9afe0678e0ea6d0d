"""The service's own events as bytes: ticks, refusals, notices, a geometry that was read anew."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from typing import Any

from modelserver import messages
from modelserver.errors import RecordingError
from modelserver.service.journal import state as journal_state
from modelserver.wire.journal import Kind


def written(event: Any, pause: Callable[[], object] = lambda: None) -> tuple[Kind, bytes]:
    """Return an event's kind and bytes: JSON where it holds nothing but words and numbers, else pickled.

    Python writes a float as the shortest text that reads back as the same bits.
    """
    name = type(event).__name__
    if dataclasses.is_dataclass(event) and getattr(messages, name, None) is type(event):
        values = [getattr(event, each.name) for each in dataclasses.fields(event)]
        if all(
            each is None or type(each) in (str, int, bool) or (type(each) is float and math.isfinite(each))
            for each in values
        ):
            return Kind.EVENT, json.dumps([name, *values]).encode()
    return Kind.PICKLED, journal_state.written(event, pause)


def read(kind: Kind, data: bytes) -> Any:
    """Return the event in what `written` returned. Raises RecordingError."""
    if kind is Kind.PICKLED:
        return journal_state.read(data)
    try:
        name, *values = json.loads(data)
        found = getattr(messages, name, None) if isinstance(name, str) else None
        if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
            raise RecordingError(f"an event of the journal is of no kind that this build knows: {name!r:.40}")
        return found(*values)
    except (ValueError, TypeError) as error:
        raise RecordingError(f"an event of the journal cannot be read: {error}") from error
