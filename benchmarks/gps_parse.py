"""NovAtel messages (BESTPOSB and BESTVELB) parsed per second by one process, in chunks of a serial port.

python -m benchmarks gps_parse
"""

from __future__ import annotations

import sys
import time

from modelserver.messages import FixType, GpsSample, SensorHeader
from msdrivers.devices.gps.driver import GpsStream
from msdrivers.devices.gps.novatel import NovatelLog
from msdrivers.emulate import gps as gps_logs

REQUIRED = 5_000
INSTANTS = 10_000
ROUNDS = 5
CHUNK = 64
"""Bytes that a read of a serial line brings at once, at most."""
_START = 1_700_000_000_000_000


def stream_of(names: tuple[str, ...], instants: int) -> bytes:
    return b"".join(
        gps_logs.encode_sample(name, _sample(n), _START + n * 50_000) for n in range(instants) for name in names
    )


def _sample(n: int) -> GpsSample:
    return GpsSample(
        SensorHeader(_START + n * 50_000),
        FixType.DIFFERENTIAL,
        50.0 + n * 1e-6,
        -111.0,
        height_msl=700.0,
        undulation=-20.0,
        satellites=9,
        position_covariance=(0.04, 0.0, 0.0, 0.0, 0.09, 0.0, 0.0, 0.0, 0.16),
        velocity=(1.0, 2.0, 0.1),
        speed=2.2,
        course=1.1,
    )


def measure_rate(data: bytes, expected: int) -> float:
    """Return messages per second, the best of some rounds; checks that each message was parsed."""
    best = 0.0
    for _ in range(ROUNDS):
        stream = GpsStream()
        start = time.perf_counter()
        read = sum(len(stream.feed(data[at : at + CHUNK])) for at in range(0, len(data), CHUNK))
        best = max(best, expected / (time.perf_counter() - start))
        read += len(stream.flush())
        if read != expected:
            raise RuntimeError(f"{read} messages read of {expected}")
    return best


def main() -> int:
    binary = stream_of(("bestposb", "bestvelb"), INSTANTS)
    text = stream_of(("bestposa", "bestvela"), INSTANTS // 10)
    nmea = stream_of(("gpgga", "gprmc"), INSTANTS // 10)
    sentences = 2 * (INSTANTS // 10)
    assert isinstance(GpsStream().feed(binary)[0], NovatelLog)
    measured = measure_rate(binary, 2 * INSTANTS)
    print(f"BESTPOSB and BESTVELB  {measured:9,.0f} messages/s, required {REQUIRED:,}")
    print(f"BESTPOSA and BESTVELA  {measure_rate(text, sentences):9,.0f} messages/s")
    print(f"GPGGA and GPRMC        {2 * measure_rate(nmea, sentences // 2):9,.0f} sentences/s")
    return 0 if measured >= REQUIRED else 1


if __name__ == "__main__":
    sys.exit(main())
