"""Judging who answers on the bus: one daemon, none, or two at once."""

from __future__ import annotations

from dataclasses import dataclass

from modelserver.errors import shown
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel


@dataclass(frozen=True, slots=True)
class Server:
    """A daemon that was heard: by its health report. `prefix` is that of its channels."""

    host: str
    pid: int
    vehicle: str = ""
    version: str = ""
    prefix: str = ""

    def __str__(self) -> str:
        return f"process {self.pid} on {shown(self.host, 64)}"


@dataclass(frozen=True, slots=True)
class DiscoveredServers:
    """Who was heard: daemons by their reports, and how many replies came to one question; None: nothing was asked."""

    servers: tuple[Server, ...] = ()
    replies: int | None = None


def server_findings(answers: DiscoveredServers, prefix: str, version: str) -> tuple[Diagnosis, ...]:
    """Return what is to be said of the daemons on the bus; `prefix` is that of the vehicle that is looked at."""
    subject = "daemon"
    ours = [each for each in answers.servers if each.prefix == prefix]
    found = []
    replies = answers.replies or 0
    if len(ours) > 1 or replies > 1:
        who = f": {', '.join(map(str, ours))}" if len(ours) > 1 else ""
        seen = f"{max(len(ours), replies)} answer at once{who}"
        why = "clients get the answers of either, and POSE is of both; stop all but one, or give each its own prefix"
        command = f"kill {ours[-1].pid}" if ours else "systemctl stop modelserver, on each machine but one"
        found.append(Diagnosis(DiagnosisLevel.ERROR, subject, seen, why, command))
    elif ours or replies:
        who = f": {ours[0]}" if ours else ""
        found.append(Diagnosis(DiagnosisLevel.OK, subject, f"one answers{who}"))
    else:
        seen = f"none answers{f' with prefix {prefix}' if prefix else ''}"
        found.append(
            Diagnosis(DiagnosisLevel.NOTE, subject, seen, "where it is to run", "modelserver run -c vehicle.yaml")
        )
    for each in ours:
        if each.version != version:
            seen = f"{each} is version {shown(each.version, 40)}, this command {version}"
            why = "messages of the one may be nothing to the other"
            found.append(Diagnosis(DiagnosisLevel.WARNING, subject, seen, why, "sudo systemctl restart modelserver"))
    others = sorted({each.prefix for each in answers.servers} - {prefix})
    if others:
        names = ", ".join(shown(each, 40) if each else "none" for each in others)
        found.append(
            Diagnosis(DiagnosisLevel.NOTE, "other vehicles", f"daemons with these prefixes are on the bus: {names}")
        )
    return tuple(found)
