"""Encode the geometry as a message, with all that a mirror needs to answer queries by itself (model_snapshot_t)."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from modelserver.errors import GeometryError, WireError
from modelserver.formats import parse_model
from modelserver.formats.yaml_geometry import save
from modelserver.geometry.model import Model

MAX_BYTES = 64 << 20
"""Greatest size of a decompressed snapshot."""


@dataclass(frozen=True, slots=True)
class ModelSnapshot:
    """The geometry of a vehicle, and the settings that a mirror of the service needs."""

    vehicle: str
    model: Model
    base_frame: str
    rolling_frame: str
    history_s: float
    joints_channel: str
    joints_latency_us: int = 0
    """Microseconds by which the stamps on `joints_channel` are later than the measurement."""


_SETTINGS: Final[dict[str, Callable[[Any], Any]]] = {
    "vehicle": str,
    "base_frame": str,
    "rolling_frame": str,
    "history_s": float,
    "joints_channel": str,
    "joints_latency_us": int,
}


def encode_snapshot(snapshot: ModelSnapshot) -> bytes:
    """Encode a snapshot as a zlib stream of JSON."""
    content = {key: getattr(snapshot, key) for key in _SETTINGS}
    content |= {"revision": snapshot.model.revision, "geometry": save(snapshot.model, exact=True).text}
    return zlib.compress(json.dumps(content, ensure_ascii=False).encode(), 9)


def decode_snapshot(data: bytes) -> ModelSnapshot:
    """Decode a snapshot. Raises WireError for other bytes, or a geometry of another revision."""
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(data, MAX_BYTES)
        if unpacker.unconsumed_tail:
            raise WireError("malformed", f"a snapshot decompresses to more than {MAX_BYTES} bytes")
        content = json.loads(text)
        model = parse_model(content["geometry"].encode(), "the service's snapshot")
        settings = {key: kind(content[key]) for key, kind in _SETTINGS.items()}
        revision = str(content["revision"])
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError, GeometryError) as error:
        raise WireError("malformed", f"not a snapshot of a geometry: {error}") from None
    if model.revision != revision:
        raise WireError("malformed", f"the snapshot states revision {revision}, but its geometry has {model.revision}")
    return ModelSnapshot(model=model, **settings)
