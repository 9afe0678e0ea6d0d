"""What came of reading the geometry anew: told to the core as an event. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.geometry.model import Model
from modelserver.localization.interface import Localizer
from modelserver.messages import ReloadModel


@dataclass(frozen=True, slots=True)
class ModelLoaded:
    """The geometry was read: a model that suits the vehicle, and the localizer that goes on with it; or `why` not.

    `request` is who asked for it, None where the machine's owner did.
    """

    request: ReloadModel | None
    model: Model | None = None
    localizer: Localizer | None = None
    why: str = ""
