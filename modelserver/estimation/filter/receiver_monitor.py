"""Receiver monitor: which fields of its fixes a receiver fills.

A field that a publisher never fills is 0 in a message of lcm-gen, and 0 is also a value. Two such fields matter:

- Velocity. That of a moving antenna is never exactly 0 along all three axes. A receiver that reported no other velocity
  so far measures none: its zeros are not used, and counted while the vehicle moves by the state.
- Fix type. 0 is "no fix". A receiver that stated no other type so far leaves it out: then a fix with a covariance is
  used by that. After the first type the receiver is taken at its word.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from modelserver.messages import FixType, GpsSample

MIN_UNFILLED: Final = 5
"""Velocities of 0 while the vehicle moves before that is reported: a second of a receiver at 5 Hz."""


class ReceiverMonitor(NamedTuple):
    """What the fixes so far have stated.

    Attributes
    ----------
    states_type: whether one stated a fix type.
    states_velocity: whether one stated a velocity other than 0.
    num_unfilled: velocities of 0 while the vehicle moved, before that; at most MIN_UNFILLED.
    """

    states_type: bool = False
    states_velocity: bool = False
    num_unfilled: int = 0

    def update(self, sample: GpsSample) -> ReceiverMonitor:
        """Return the monitor after a fix: itself, if the fix states nothing new."""
        states_type = self.states_type or sample.fix_type is not FixType.NONE
        states_velocity = self.states_velocity or (sample.velocity is not None and any(sample.velocity))
        if states_type == self.states_type and states_velocity == self.states_velocity:
            return self
        return ReceiverMonitor(states_type, states_velocity, 0 if states_velocity else self.num_unfilled)

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
    def lacks_velocity(self) -> bool:
        """Whether the velocity is unfilled beyond chance."""
        return self.num_unfilled >= MIN_UNFILLED
