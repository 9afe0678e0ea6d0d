"""Judging the host's clock: from what was read off it to findings."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel

MOST_SLEW = 500e-6
"""By how much a clock is slewed at most (ntp_adjtime(2), the kernel's limit); more between two looks was a step."""

FIRST_YEAR_S = 1_672_531_200
"""The beginning of 2023: a clock that says less was never set since the machine has power."""


@dataclass(frozen=True, slots=True)
class ClockFacts:
    """What was read off the host's clocks.

    `synchronised`: what the kernel says, None: it does not. `error` is its own bound on the clock's error, seconds.
    `slewed`: by how much the time of day ran faster than the monotonic clock, seconds, over `watched` seconds. `tool`
    is what keeps it: chrony, ntp, timesyncd; empty: none is installed.
    """

    utime: int
    synchronised: bool | None = None
    error: float | None = None
    slewed: float = 0.0
    watched: float = 0.0
    tool: str = ""


_KEEP_TIME = {
    "chrony": "sudo systemctl enable --now chrony && chronyc tracking",
    "ntp": "sudo systemctl enable --now ntp && ntpq -p",
    "timesyncd": "sudo timedatectl set-ntp true && timedatectl timesync-status",
    "": "sudo apt install chrony",
}


def clock_findings(facts: ClockFacts, shared: bool) -> tuple[Diagnosis, ...]:
    """Return what is to be said of the clock; `shared`: the bus leaves the machine, so that others' clocks matter."""
    subject = "clock"
    command = _KEEP_TIME[facts.tool]
    if facts.utime < FIRST_YEAR_S * 1_000_000:
        why = "stamps, the magnetic field's model and logs go by it; is the battery of the clock empty?"
        return (
            Diagnosis(DiagnosisLevel.ERROR, subject, "it was never set: it tells a year before 2023", why, command),
        )
    found = []
    if abs(facts.slewed) > MOST_SLEW * facts.watched + 1e-3:
        seen = f"it was stepped by {facts.slewed:+.3f} s while it was looked at"
        why = "poses are invalid until time is taken up anew; let it be stepped at boot alone"
        found.append(
            Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, _KEEP_TIME["chrony"] if facts.tool else command)
        )
    if facts.synchronised is None:
        found.append(Diagnosis(DiagnosisLevel.NOTE, subject, "whether it is synchronised cannot be read here"))
    elif facts.synchronised:
        error = "" if facts.error is None else f", to {facts.error * 1e3:.1f} ms or better"
        found.append(Diagnosis(DiagnosisLevel.OK, subject, f"synchronised{error}"))
    else:
        why = (
            "the stamps of several machines do not belong together"
            if shared
            else "stamps belong together on this machine, and tell no true time"
        )
        found.append(
            Diagnosis(
                DiagnosisLevel.WARNING if shared else DiagnosisLevel.NOTE, subject, "not synchronised", why, command
            )
        )
    return tuple(found)
