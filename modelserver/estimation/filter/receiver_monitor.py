"""Receiver monitor: which fields of its fixes a receiver fills, and of which class it is.

A field that a publisher never fills is 0 in a message of lcm-gen, and 0 is also a value. Two such fields matter:

- Velocity. That of a moving antenna is never exactly 0 along all three axes. A receiver that reported no other velocity
  so far measures none: its zeros are not used, and counted while the vehicle moves by the state.
- Fix type. 0 is "no fix". A receiver that stated no other type so far leaves it out: then a fix with a covariance is
  used by that. After the first type the receiver is taken at its word.

The class of a receiver is the best type that CLASS_FIXES of its fixes had in a row. It determines how large the
protection level of a valid pose may be, unless that is configured: a limit that suits centimeters would stop a vehicle
whose receiver has no corrections, and a limit that suits meters is meaningless to one that has them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from modelserver.messages import FixType, GpsSample

CLASS_FIXES: Final = 100
"""Fixes in a row of a type that make the receiver one of its class: 10 s at 10 Hz, 100 s at 1 Hz."""

PLAIN_LIMIT: Final = 36.0
"""Horizontal protection level, m, of the least valid pose with a receiver without corrections: twice that of one of its
fixes at the default range error, HDOP 1.5 and the default risk."""

CORRECTED_LIMIT: Final = 20.0
"""The same with code corrections: their fixes are better, but how far dead reckoning leads without them is not."""

CARRIER_LIMIT: Final = 10.0
"""The same with carrier corrections (RTK), floating or fixed."""

MIN_UNFILLED: Final = 5
"""Velocities of 0 while the vehicle moves before that is reported: a second of a receiver at 5 Hz."""


class ReceiverMonitor(NamedTuple):
    """What the fixes so far have stated.

    Attributes
    ----------
    states_type: whether one stated a fix type.
    states_velocity: whether one stated a velocity other than 0.
    num_unfilled: velocities of 0 while the vehicle moved, before that; at most MIN_UNFILLED.
    num_corrected, num_carrier: fixes in a row with code corrections or better, and with carrier corrections;
        CLASS_FIXES, once there were as many.
    """

    states_type: bool = False
    states_velocity: bool = False
    num_unfilled: int = 0
    num_corrected: int = 0
    num_carrier: int = 0

    def update(self, sample: GpsSample) -> ReceiverMonitor:
        """Return the monitor after a fix: itself, if the fix states nothing new."""
        states_type = self.states_type or sample.fix_type is not FixType.NONE
        states_velocity = self.states_velocity or (sample.velocity is not None and any(sample.velocity))
        corrected = _count(self.num_corrected, FixType.DIFFERENTIAL <= sample.fix_type <= FixType.RTK_FIXED)
        carrier = _count(self.num_carrier, FixType.RTK_FLOAT <= sample.fix_type <= FixType.RTK_FIXED)
        updated = ReceiverMonitor(
            states_type, states_velocity, 0 if states_velocity else self.num_unfilled, corrected, carrier
        )
        return self if updated == self else updated

    def may_use(self, sample: GpsSample) -> bool:
        """Return whether the type of a fix permits its use: one without a type only while none was stated."""
        return sample.fix_type is not FixType.NONE or not self.states_type

    def is_unfilled(self, sample: GpsSample) -> bool:
        """Return whether the velocity of a fix is one that nobody filled."""
        return sample.velocity is not None and not any(sample.velocity) and not self.states_velocity

    def count_unfilled(self) -> ReceiverMonitor:
        """Return the monitor after an unfilled velocity of a moving vehicle."""
        return self._replace(num_unfilled=min(self.num_unfilled + 1, MIN_UNFILLED))

    @property
    def horizontal_limit(self) -> float:
        """The horizontal protection level of the least valid pose with a receiver of this class, m."""
        if self.num_carrier == CLASS_FIXES:
            return CARRIER_LIMIT
        return CORRECTED_LIMIT if self.num_corrected == CLASS_FIXES else PLAIN_LIMIT

    @property
    def lacks_velocity(self) -> bool:
        """Whether the velocity is unfilled beyond chance."""
        return self.num_unfilled >= MIN_UNFILLED


def _count(number: int, is_one: bool) -> int:
    """Return the number of fixes in a row after the next, which is one or is not."""
    if number == CLASS_FIXES:
        return number
    return number + 1 if is_one else 0
