"""ModelServer: where is A relative to B, now or at time t, and how sure are we?

Conventions, everywhere in this package and on the wire:

Frames
    are named `Body:Frame`. Vehicle axes: x forward, y left, z up. `X_AB` is the pose of frame B in frame A, and
    adjacent letters match: `X_AC = X_AB @ X_BC`, `p_A = X_AB @ p_B`.
    `get_transformation(frame_of_interest=I, frame_of_reference=R)` is `X_RI`; it equals tf2's
    `lookup_transform(target=R, source=I)` and bot_frames' `from=I, to=R`.
World frames
    `World:UTM`: grid east, grid north, ellipsoidal up; origin at initial_utm, zone pinned. `World:ENU`: true east,
    true north, up at the same point. `Odom:Origin`: continuous, drifts, never jumps. The vehicle's pose in each is
    worked out at the vehicle's position, never by chaining one through the other. `origin_id` names the origin;
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

Importing this package loads nothing heavy: the names below come when they are used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from modelserver.version import __version__ as __version__

if TYPE_CHECKING:
    from modelserver.client.mirror import PlatformMirror as PlatformMirror
    from modelserver.client.remote import Platform as Platform
    from modelserver.errors import BusError as BusError
    from modelserver.errors import ConfigError as ConfigError
    from modelserver.errors import ForbiddenError as ForbiddenError
    from modelserver.errors import FrameMismatchError as FrameMismatchError
    from modelserver.errors import GeometryError as GeometryError
    from modelserver.errors import KeyFileError as KeyFileError
    from modelserver.errors import LimitError as LimitError
    from modelserver.errors import MalformedRequestError as MalformedRequestError
    from modelserver.errors import ModelServerError as ModelServerError
    from modelserver.errors import NoPoseError as NoPoseError
    from modelserver.errors import NoServerError as NoServerError
    from modelserver.errors import NotConnectedError as NotConnectedError
    from modelserver.errors import OutOfDateError as OutOfDateError
    from modelserver.errors import Problem as Problem
    from modelserver.errors import QueryError as QueryError
    from modelserver.errors import RefusedError as RefusedError
    from modelserver.errors import RejectedError as RejectedError
    from modelserver.errors import Severity as Severity
    from modelserver.errors import Status as Status
    from modelserver.errors import TooNewError as TooNewError
    from modelserver.errors import TooOldError as TooOldError
    from modelserver.errors import UnknownBodyError as UnknownBodyError
    from modelserver.errors import UnknownFrameError as UnknownFrameError
    from modelserver.formats import load_model as load_model
    from modelserver.geometry.builder import ModelBuilder as ModelBuilder
    from modelserver.geometry.joint import Joint as Joint
    from modelserver.geometry.joint import JointType as JointType
    from modelserver.geometry.joint import Mimic as Mimic
    from modelserver.geometry.model import Model as Model
    from modelserver.geometry.model import Search as Search
    from modelserver.geometry.parts import Body as Body
    from modelserver.geometry.parts import BodyFrame as BodyFrame
    from modelserver.geometry.parts import Constraint as Constraint
    from modelserver.geometry.parts import Sigma as Sigma
    from modelserver.messages import Invalid as Invalid
    from modelserver.messages import Policy as Policy
    from modelserver.messages import Quality as Quality
    from modelserver.spatial.pose import Pose as Pose
    from modelserver.spatial.transformation import Transformation as Transformation

_HOMES = {
    "modelserver.client.mirror": ("PlatformMirror",),
    "modelserver.client.remote": ("Platform",),
    "modelserver.errors": (
        "BusError",
        "ConfigError",
        "ForbiddenError",
        "FrameMismatchError",
        "GeometryError",
        "KeyFileError",
        "LimitError",
        "MalformedRequestError",
        "ModelServerError",
        "NoPoseError",
        "NoServerError",
        "NotConnectedError",
        "OutOfDateError",
        "Problem",
        "QueryError",
        "RefusedError",
        "RejectedError",
        "Severity",
        "Status",
        "TooNewError",
        "TooOldError",
        "UnknownBodyError",
        "UnknownFrameError",
    ),
    "modelserver.formats": ("load_model",),
    "modelserver.geometry.builder": ("ModelBuilder",),
    "modelserver.geometry.model": ("Model", "Search"),
    "modelserver.geometry.joint": ("Joint", "JointType", "Mimic"),
    "modelserver.geometry.parts": ("Body", "BodyFrame", "Constraint", "Sigma"),
    "modelserver.messages": ("Invalid", "Policy", "Quality"),
    "modelserver.spatial.pose": ("Pose",),
    "modelserver.spatial.transformation": ("Transformation",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME)]


def __getattr__(name: str) -> object:
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module 'modelserver' has no attribute {name!r}")
    value = getattr(importlib.import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
