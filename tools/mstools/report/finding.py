"""What a finding of the report on a replay is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class FindingLevel(IntEnum):
    """How much a finding matters, worst first."""

    WRONG = 0
    DOUBTFUL = 1
    NOTE = 2


@dataclass(frozen=True, slots=True)
class ReportFinding:
    """One finding: a headline, what was seen, and what to do about it."""

    grade: FindingLevel
    title: str
    seen: str
    advice: str
