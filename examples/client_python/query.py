"""Query the pose of one frame in another: a client written from the .lcm files alone, with lcm and generated types."""

from __future__ import annotations

import math
import re
import secrets
import sys
import time

import lcm

from mslcm import get_transformation_reply_t, get_transformation_request_t, pose_transform_t

REQUEST_CHANNEL = "PLATFORM_GET_TRANSFORMATION"
# Starts with the server's reply prefix, and is the same at every start: programs on the bus store each channel name.
REPLY_CHANNEL = "REPLY_EXAMPLE_PYTHON"
TRIES = 3
TRY_TIMEOUT_S = 0.5


def ask(bus: lcm.LCM, request: get_transformation_request_t) -> get_transformation_reply_t | None:
    """Send the request until its reply arrives; None after the last try."""
    replies: list[get_transformation_reply_t] = []

    def on_reply(channel: str, data: bytes) -> None:
        try:
            reply = get_transformation_reply_t.decode(data)
        except ValueError:
            return  # another type: another program publishes on our channel
        if reply.header.request_id == request.header.request_id:
            replies.append(reply)

    # LCM treats the name as a regular expression
    subscription = bus.subscribe(re.escape(REPLY_CHANNEL), on_reply)
    try:
        for _ in range(TRIES):
            bus.publish(REQUEST_CHANNEL, request.encode())
            deadline = time.monotonic() + TRY_TIMEOUT_S
            while not replies and (left := deadline - time.monotonic()) > 0:
                bus.handle_timeout(int(left * 1000) + 1)
            if replies:
                return replies[0]
    finally:
        bus.unsubscribe(subscription)
    return None


def to_rpy(h: list[list[float]]) -> tuple[float, float, float]:
    """Fixed-axis roll, pitch, yaw of a homogeneous transform, radians."""
    level = math.hypot(h[0][0], h[1][0])
    pitch = math.atan2(-h[2][0], level)
    if level < 1e-9:  # gimbal lock: only the difference of roll and yaw is known
        return 0.0, pitch, math.atan2(-h[0][1], h[1][1])
    return math.atan2(h[2][1], h[2][2]), pitch, math.atan2(h[1][0], h[0][0])


def show(pose: pose_transform_t) -> None:
    """Print a pose."""
    h = pose.h_transform
    print(f"{pose.frame_of_interest} in {pose.frame_of_reference}")
    print("position_m {:.6f} {:.6f} {:.6f}".format(*(h[row][3] for row in range(3))))
    print("rpy_deg {:.6f} {:.6f} {:.6f}".format(*map(math.degrees, to_rpy(h))))
    print("utime", pose.utime)
    print("valid", "yes" if pose.pose_valid else f"no, reasons 0x{pose.invalid_reasons:x}")


def main(arguments: list[str]) -> int:
    if len(arguments) != 2:
        print("usage: query FRAME_OF_INTEREST FRAME_OF_REFERENCE", file=sys.stderr)
        return 2
    request = get_transformation_request_t()
    request.header.request_id = secrets.randbits(63)
    request.header.reply_channel = REPLY_CHANNEL
    request.frame_of_interest, request.frame_of_reference = arguments
    try:
        bus = lcm.LCM()  # the bus of $LCM_DEFAULT_URL, else LCM's own default, which stays on this machine
    except (OSError, RuntimeError) as error:
        print(f"query: cannot join the bus: {error}", file=sys.stderr)
        return 1
    reply = ask(bus, request)
    if reply is None:
        print(f"query: no reply after {TRIES} tries of {TRY_TIMEOUT_S} s: is the server running?", file=sys.stderr)
        return 1
    if reply.header.status != reply.header.OK:
        near = f". Nearest: {', '.join(reply.header.nearest)}" if reply.header.nearest else ""
        print(f"query: status {reply.header.status}: {reply.header.message}{near}", file=sys.stderr)
        return 1
    show(reply.transform)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
