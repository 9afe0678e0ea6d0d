"""Queries from asyncio: Platform in a thread, so that the event loop continues; or PlatformMirror without a thread.

python asyncio_client.py Digiclops:ImagePlane FrontNoddingSICK:Origin
"""

from __future__ import annotations

import asyncio
import sys

import modelserver as ms


def format_position(pose: ms.Transformation) -> str:
    """Format a position, with the reason if it is not valid."""
    words = " ".join(f"{value:.6f}" for value in pose.position)
    return words if pose.is_valid else f"{words} (NOT VALID: {ms.Invalid(pose.invalid_reasons).explain()})"


async def query_service(interest: str, reference: str) -> None:
    """Send several queries at once, each in a thread: a query waits for its reply, the event loop does not."""
    with ms.Platform() as platform:  # threads may share it: it sends one request at a time
        bodies, there = await asyncio.gather(
            asyncio.to_thread(platform.get_body_list),
            asyncio.to_thread(platform.get_transformation, interest, reference),
        )
    print(f"{len(bodies)} bodies; {interest} at {format_position(there)}")


async def query_mirror(interest: str, reference: str) -> None:
    """Follow the server with a mirror: only the wait needs a thread, as a query does not block the event loop."""
    with ms.PlatformMirror() as mirror:
        await asyncio.to_thread(mirror.wait, 10.0, pose=False)
        there = mirror.get_transformation(interest, reference)
        print(f"the mirror, {mirror.age.geometry:.1f} s old: {format_position(there)}")
        try:
            print("now in Odom:", format_position(mirror.get_transformation(interest, "Odom:Origin", wait_ms=0)))
        except ms.QueryError as error:
            print("not in Odom:", error)


async def main(interest: str, reference: str) -> int:
    """Run both; return the exit code."""
    try:
        await asyncio.gather(query_service(interest, reference), query_mirror(interest, reference))
    except ms.ModelServerError as error:
        nearest = f". Nearest: {', '.join(error.nearest)}" if isinstance(error, ms.QueryError) and error.nearest else ""
        print(f"{error}{nearest}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: asyncio_client.py FRAME_OF_INTEREST FRAME_OF_REFERENCE")
    sys.exit(asyncio.run(main(*sys.argv[1:])))
