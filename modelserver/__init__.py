"""ModelServer: where is A relative to B, now or at time t, and with which covariance?

Conventions, everywhere in this package and on the wire:

Frames
    are named `Body:Frame`. Vehicle axes: x forward, y left, z up. `X_AB` is the pose of frame B in frame A, and
    adjacent letters match: `X_AC = X_AB @ X_BC`, `p_A = X_AB @ p_B`.
    `get_transformation(frame_of_interest=I, frame_of_reference=R)` is `X_RI`; it equals tf2's
    `lookup_transform(target=R, source=I)` and bot_frames' `from=I, to=R`.
World frames
    `World:UTM`: grid east, grid north, ellipsoidal up; origin at initial_utm, zone pinned. `World:ENU`: true east,
    true north, up at the same point. `Odom:Origin`: continuous, drifts, never jumps. The vehicle's pose in each is
    computed at the vehicle's position, never by chaining one through the other. `origin_id` names the origin;
    `pose_epoch` counts the discontinuities of the world pose.
Orientation
    Quaternions: Hamilton, scalar first, unit, w >= 0. Roll, pitch, yaw: about fixed axes, Rz(yaw) Ry(pitch) Rx(roll).
    Yaw is counter-clockwise from east; heading (clockwise from true north) exists only at devices and user interfaces.
Units
    SI, radians; a suffix names anything else (`_deg`, `_ms`). Up is ellipsoidal; height above mean sea level is a
    field of its own.
Time
    `utime`: microseconds since the Unix epoch, the instant of measurement. Durations are seconds.
Covariance
    6x6, ordered x, y, z, about x, about y, about z; perturbation `X = (p + dp, exp(dtheta) R)`, both along fixed axes
    of the frame of reference.

The names below are what a client needs; everything else is imported from its module, e.g. `modelserver.geometry`.
Importing this package loads nothing heavy: clients, models and values are imported when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from modelserver.errors import BusError as BusError
from modelserver.errors import ConfigError as ConfigError
from modelserver.errors import ForbiddenError as ForbiddenError
from modelserver.errors import GeometryError as GeometryError
from modelserver.errors import KeyFileError as KeyFileError
from modelserver.errors import LimitError as LimitError
from modelserver.errors import MalformedRequestError as MalformedRequestError
from modelserver.errors import ModelServerError as ModelServerError
from modelserver.errors import NoPoseError as NoPoseError
from modelserver.errors import NoServerError as NoServerError
from modelserver.errors import NotConnectedError as NotConnectedError
from modelserver.errors import OutOfDateError as OutOfDateError
from modelserver.errors import OverloadedError as OverloadedError
from modelserver.errors import QueryError as QueryError
from modelserver.errors import RejectedError as RejectedError
from modelserver.errors import Status as Status
from modelserver.errors import TooNewError as TooNewError
from modelserver.errors import TooOldError as TooOldError
from modelserver.errors import UnknownBodyError as UnknownBodyError
from modelserver.errors import UnknownFrameError as UnknownFrameError
from modelserver.version import __version__ as __version__

if TYPE_CHECKING:
    from modelserver.client.mirror import PlatformMirror as PlatformMirror
    from modelserver.client.publisher import SensorPublisher as SensorPublisher
    from modelserver.client.publisher import VehicleCommander as VehicleCommander
    from modelserver.client.remote import Platform as Platform
    from modelserver.formats import load_model as load_model
    from modelserver.geometry.builder import ModelBuilder as ModelBuilder
    from modelserver.geometry.model import Model as Model
    from modelserver.messages import Direction as Direction
    from modelserver.messages import FixType as FixType
    from modelserver.messages import Invalid as Invalid
    from modelserver.messages import OrientationReference as OrientationReference
    from modelserver.messages import Policy as Policy
    from modelserver.messages import PoseAnswer as PoseAnswer
    from modelserver.messages import Quality as Quality
    from modelserver.messages import Unmet as Unmet
    from modelserver.messages import YawSource as YawSource
    from modelserver.transforms.pose import Pose as Pose
    from modelserver.transforms.transformation import Transformation as Transformation

_LAZY = {
    "VehicleCommander": "modelserver.client.publisher",
    "PlatformMirror": "modelserver.client.mirror",
    "Platform": "modelserver.client.remote",
    "SensorPublisher": "modelserver.client.publisher",
    "load_model": "modelserver.formats",
    "ModelBuilder": "modelserver.geometry.builder",
    "Model": "modelserver.geometry.model",
    "Direction": "modelserver.messages",
    "FixType": "modelserver.messages",
    "OrientationReference": "modelserver.messages",
    "YawSource": "modelserver.messages",
    "PoseAnswer": "modelserver.messages",
    "Invalid": "modelserver.messages",
    "Policy": "modelserver.messages",
    "Quality": "modelserver.messages",
    "Unmet": "modelserver.messages",
    "Pose": "modelserver.transforms.pose",
    "Transformation": "modelserver.transforms.transformation",
}


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module 'modelserver' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_LAZY[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
