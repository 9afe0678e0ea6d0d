"""What can be set in the filter, with the unit of each number and where its default comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from modelserver.localization.settings import FixSettings


@dataclass(frozen=True, slots=True)
class FilterSettings(FixSettings):
    """Settings of the filter. SI units and radians; a sigma is one standard deviation.

    Defaults are a data sheet's or physics' numbers, named at each; none is tuned to a recording.
    Raises ValueError for a number that is not finite or outside its range.
    """

    __pydantic_config__: ClassVar[dict[str, object]] = {"extra": "forbid", "strict": True, "allow_inf_nan": False}
