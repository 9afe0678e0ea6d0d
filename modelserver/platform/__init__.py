"""Where a frame is in another, at a time: geometry, joints and the vehicle's estimates put together. Pure."""

from modelserver.platform.view import HISTORY_LIMIT, PREDICTION_LIMIT_S, PlatformView
from modelserver.platform.worlds import WORLD_FRAMES

__all__ = ["HISTORY_LIMIT", "PREDICTION_LIMIT_S", "WORLD_FRAMES", "PlatformView"]
