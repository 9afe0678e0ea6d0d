"""Gauges of this process for the health report: read at the edge, once a report."""

from __future__ import annotations

import os
import socket
import time
from pathlib import Path

from modelserver.messages import Gauges

STATM = Path("/proc/self/statm")


def read_gauges(queued: int, statm: Path = STATM) -> Gauges:
    """Return what this process takes; `queued`: requests that wait. Costs some 20 microseconds."""
    return Gauges(socket.gethostname(), os.getpid(), queued, resident_bytes(statm), time.process_time())


def resident_bytes(statm: Path = STATM) -> int:
    """Return the memory that this process holds, bytes; 0 where the system does not tell."""
    try:
        return int(statm.read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0
