"""Queries: where a frame is in another at a time, from geometry, joints and the vehicle's estimates. Pure."""

from modelserver.query.view import HISTORY_LIMIT, PREDICTION_LIMIT_S, WORLD_FRAMES, PlatformView

__all__ = ["HISTORY_LIMIT", "PREDICTION_LIMIT_S", "WORLD_FRAMES", "PlatformView"]
