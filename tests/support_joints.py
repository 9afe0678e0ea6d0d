"""Random joints of every type."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hypothesis import strategies as st
from support_spatial import axes

from modelserver.geometry import Joint, JointType, Mimic

MOVING = tuple(each for each in JointType if each is not JointType.FIXED)

_below = st.one_of(st.floats(-3, -0.01), st.just(-math.inf), st.integers(-170, -1).map(math.radians))
_above = st.one_of(st.floats(0.01, 3), st.just(math.inf), st.integers(1, 170).map(math.radians))
_rates = st.one_of(st.floats(0, 10), st.just(math.inf), st.just(math.radians(90)))
_deviations = st.one_of(st.just(0.0), st.floats(0, 1), st.just(math.radians(0.05)))


@st.composite
def joints(draw, leaders: Sequence[str] = (), types: Sequence[JointType] = tuple(JointType)):
    """Return a joint; where it has one coordinate it may follow one of `leaders`."""
    kind = draw(st.sampled_from(types))
    count = Joint(kind).count

    def some(values):
        return draw(st.one_of(st.just(()), st.tuples(*[values] * count)))

    lower, upper = some(_below), some(_above)
    mimic = None
    if count == 1 and leaders:
        factors = st.one_of(st.just(1.0), st.floats(-2, 2))
        offsets = st.one_of(st.just(0.0), st.just(math.radians(7)), st.floats(-2, 2))
        mimic = draw(st.none() | st.builds(Mimic, st.sampled_from(leaders), factors, offsets))
    default = (
        ()
        if mimic is not None or not draw(st.booleans())
        else tuple(
            draw(st.floats(max(-3.0, low), min(3.0, high)))
            for low, high in zip(lower or (-3.0,) * count, upper or (3.0,) * count, strict=True)
        )
    )
    return Joint(kind, draw(axes), lower, upper, some(_rates), default, some(_deviations), mimic)


def positions_of(joint: Joint, reach: float = 2.5):
    """Return a strategy of positions, whatever the limits."""
    return st.tuples(*[st.floats(-reach, reach)] * joint.count)
