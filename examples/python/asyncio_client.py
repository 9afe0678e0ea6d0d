"""Asking the service from asyncio: Platform in a thread, so that the loop goes on; or a mirror, which needs none.

python asyncio_client.py Digiclops:ImagePlane FrontNoddingSICK:Origin
"""

from __future__ import annotations

import asyncio
import sys

import modelserver as ms


def placed(there: ms.Transformation) -> str:
    """Return a position, and why it may not be used where that is so."""
    words = " ".join(f"{value:.6f}" for value in there.position)
    return words if there.valid else f"{words} (NOT VALID: {ms.Invalid(there.invalid_reasons).explain()})"


async def round_trips(interest: str, reference: str) -> None:
    """Ask several things at once, each in a thread: a question waits for its reply, and the loop does not."""
    with ms.Platform() as platform:  # threads may share it: it sends one question at a time
        bodies, there = await asyncio.gather(
            asyncio.to_thread(platform.get_body_list),
            asyncio.to_thread(platform.get_transformation, interest, reference),
        )
    print(f"{len(bodies)} bodies; {interest} stands at {placed(there)}")


async def mirrored(interest: str, reference: str) -> None:
    """Keep a copy: only waiting for it takes a thread. A question is answered at once, so it may stand in the loop."""
    with ms.PlatformMirror() as mirror:
        await asyncio.to_thread(mirror.wait, 10.0, pose=False)
        there = mirror.get_transformation(interest, reference)
        print(f"the mirror, {mirror.age.geometry:.1f} s old, says {placed(there)}")
        try:
            print("now in Odom:", placed(mirror.get_transformation(interest, "Odom:Origin", wait_ms=0)))
        except ms.QueryError as error:
            print("not in Odom:", error)


async def main(interest: str, reference: str) -> int:
    """Run both; return the exit code."""
    try:
        await asyncio.gather(round_trips(interest, reference), mirrored(interest, reference))
    except ms.ModelServerError as error:
        nearest = f". Nearest: {', '.join(error.nearest)}" if isinstance(error, ms.QueryError) and error.nearest else ""
        print(f"{error}{nearest}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: asyncio_client.py FRAME_OF_INTEREST FRAME_OF_REFERENCE")
    sys.exit(asyncio.run(main(*sys.argv[1:])))
