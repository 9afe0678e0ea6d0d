"""The geometry as it goes over the bus: all that a mirror needs to answer by itself. Bytes to values and back."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass

from modelserver.errors import GeometryError, WireError
from modelserver.formats import parse_model, yaml_text
from modelserver.geometry.model import Model

MAX_BYTES = 64 << 20
"""Of the text that a snapshot may unpack to: more is an attack, not a vehicle."""


@dataclass(frozen=True, slots=True)
class ModelSnapshot:
    """A vehicle's geometry, and what else a mirror of the service has to know. See model_snapshot_t.

    `joints_latency_us`: microseconds by which the stamps on that channel are later than the measurement.
    """

    vehicle: str
    model: Model
    base_frame: str
    rolling_frame: str
    history_s: float
    joints_channel: str
    joints_latency_us: int = 0


def written(snapshot: ModelSnapshot) -> bytes:
    """Return the bytes of a snapshot: a zlib stream of JSON."""
    content = {
        "vehicle": snapshot.vehicle,
        "base_frame": snapshot.base_frame,
        "rolling_frame": snapshot.rolling_frame,
        "history_s": snapshot.history_s,
        "joints_channel": snapshot.joints_channel,
        "joints_latency_us": snapshot.joints_latency_us,
        "revision": snapshot.model.revision,
        "geometry": yaml_text.save(snapshot.model, exact=True).text,
    }
    return zlib.compress(json.dumps(content, ensure_ascii=False).encode(), 9)


def read(data: bytes) -> ModelSnapshot:
    """Return the snapshot in its bytes. Raises WireError where they are none, or the geometry is not what it says."""
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(data, MAX_BYTES)
        if unpacker.unconsumed_tail:
            raise WireError("malformed", f"a snapshot unpacks to more than {MAX_BYTES} bytes")
        content = json.loads(text)
        model = parse_model(content["geometry"].encode(), "the service's snapshot")
        snapshot = ModelSnapshot(
            str(content["vehicle"]),
            model,
            str(content["base_frame"]),
            str(content["rolling_frame"]),
            float(content["history_s"]),
            str(content["joints_channel"]),
            int(content["joints_latency_us"]),
        )
        revision = str(content["revision"])
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError, GeometryError) as error:
        raise WireError("malformed", f"no snapshot of a geometry: {error}") from None
    if model.revision != revision:
        raise WireError("malformed", f"the snapshot says revision {revision}, and what it holds is {model.revision}")
    return snapshot
