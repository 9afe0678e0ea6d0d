"""What a client may have done, beside asking: requests that change what the service knows, and their replies."""

from __future__ import annotations

from modelserver.messages import (
    Acknowledgement,
    PoseAnswer,
    ReloadModel,
    ReloadReply,
    RequestHeader,
    SetHTransform,
    SetStateVector,
)
from modelserver.spatial.transformation import Transformation

REPLY_TYPES = {ReloadReply: "reload_model_reply_t", Acknowledgement: "acknowledgement_t"}
"""The wire types of the replies."""

COMMANDS = (ReloadModel, SetStateVector, SetHTransform)
"""Requests that are sent once: what was done is not to be done again because its reply was lost."""


def pose_to_set(
    header: RequestHeader, transformation: Transformation, as_vector: bool
) -> SetStateVector | SetHTransform:
    """Return the request to take the vehicle for standing where a transformation says."""
    pose = PoseAnswer(transformation)
    return SetStateVector(header, pose) if as_vector else SetHTransform(header, pose)
