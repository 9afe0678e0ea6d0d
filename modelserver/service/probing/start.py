"""The quick part of the probe, which the daemon makes at its start: does the bus deliver, and can it lose something?"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import replace

from modelserver.errors import BusError
from modelserver.service.probing.findings import Diagnosis, DiagnosisLevel, of_weight
from modelserver.service.probing.listening import hears_itself
from modelserver.service.probing.machine import bus_facts
from modelserver.service.probing.probe import BusFacts, bus_findings

log = logging.getLogger(__name__)

SUBJECT = "bus"
"""What the notice in the health report is about."""


def probe(
    url: str, read: Callable[[str], BusFacts] = lambda url: bus_facts(url, hears_itself)
) -> tuple[Diagnosis, ...]:
    """Return what is found of the bus at `url`; a few milliseconds where it is well.

    Raises BusError where it does not deliver our own message: a daemon there would speak to nobody.
    """
    # what other programs lost before this one began is not this one's to tell
    findings = bus_findings(replace(read(url), dropped=None))
    errors = of_weight(findings, DiagnosisLevel.ERROR)
    if errors:
        raise BusError(f"the bus at {url} does not work: {'; '.join(map(str, errors))} (modelserver doctor says more)")
    return findings


def tell(findings: Iterable[Diagnosis], notice: Callable[[str, str], None]) -> None:
    """Log what was found, and have the health report tell what is to be mended."""
    findings = tuple(findings)
    for finding in findings:
        log.log(logging.WARNING if finding.grade >= DiagnosisLevel.WARNING else logging.DEBUG, "%s", finding)
    grave = of_weight(findings)
    if grave:
        notice(SUBJECT, "; ".join(map(str, grave)))
