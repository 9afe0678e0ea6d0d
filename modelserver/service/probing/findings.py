"""What was found out about the machine and the bus that the service runs on: values that people and scripts read."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum


class DiagnosisLevel(IntEnum):
    """How much a finding matters.

    ok: as it should be. note: worth knowing, nothing to mend. warning: it works, and may fail or lose something.
    error: it does not work.
    """

    OK = 0
    NOTE = 1
    WARNING = 2
    ERROR = 3


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """One thing that was looked at: what was seen, why that matters, and the exact command that mends it.

    `subject` names what was looked at, in a word or two. `why` and `command` are empty where there is nothing to mend.
    """

    grade: DiagnosisLevel
    subject: str
    seen: str
    why: str = ""
    command: str = ""

    def __str__(self) -> str:
        text = f"{self.subject}: {self.seen}"
        if self.why:
            text += f"; {self.why}"
        return f"{text}. Mend it with: {self.command}" if self.command else text


def worst(findings: Iterable[Diagnosis]) -> DiagnosisLevel:
    """Return the gravest grade among findings; OK of none."""
    return max((each.grade for each in findings), default=DiagnosisLevel.OK)


def of_weight(findings: Iterable[Diagnosis], least: DiagnosisLevel = DiagnosisLevel.WARNING) -> tuple[Diagnosis, ...]:
    """Return the findings that are of a grade or graver."""
    return tuple(each for each in findings if each.grade >= least)
