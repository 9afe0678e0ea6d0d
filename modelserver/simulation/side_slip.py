"""Side slip: the angle by which a vehicle moves beside where it points, which its wheels do not see."""

from __future__ import annotations

import math
from dataclasses import dataclass

from modelserver.simulation.noise import NoiseSource
from modelserver.simulation.trajectory import TrajectoryMotion
from modelserver.spatial.so3 import Vector3


@dataclass(frozen=True, slots=True)
class SideSlip:
    """How a vehicle slides.

    cornering: radians of slip angle for each m/s2 of lateral acceleration; the vehicle slides out of the turn.
    wander_sigma: root mean square, m/s, of a random lateral velocity that is a sum of `count` sines with random
    phases and with periods spread evenly in their logarithm over `periods`, seconds.
    full_speed: m/s; the random part fades with v^2 / (v^2 + full_speed^2), so that what stands does not slide.
    """

    cornering: float = 0.0
    wander_sigma: float = 0.0
    periods: tuple[float, float] = (3.0, 30.0)
    count: int = 5
    full_speed: float = 0.5

    def __post_init__(self) -> None:
        if not (0 < self.periods[0] <= self.periods[1] and self.count >= 1 and self.full_speed > 0):
            raise ValueError(f"periods and full_speed are above 0, a wander has a sine or more; got {self}")


class SlipAngle:
    """The slip angle of one run: course minus yaw (of the direction of forward speed), and its rates."""

    __slots__ = ("_cornering", "_fade", "_sines")

    def __init__(self, model: SideSlip, seed: int):
        """Take the model and the seed of its sines."""
        noise = NoiseSource(seed, "side slip")
        amplitude = model.wander_sigma * math.sqrt(2.0 / model.count)
        shortest, longest = map(math.log, model.periods)
        self._cornering = model.cornering
        self._fade = model.full_speed**2
        self._sines = [
            (amplitude, math.tau / math.exp(noise.uniform(shortest, longest)), noise.uniform(-math.pi, math.pi))
            for _ in range(model.count if amplitude else 0)
        ]

    def at(self, t: float, motion: TrajectoryMotion, higher: Vector3) -> Vector3:
        """Return the angle in radians and its first and second rate at `t` seconds.

        `motion` is that of the trajectory then, and `higher` what `Trajectory.higher_rates` says.
        """
        v, v1, v2 = motion.speed, motion.forward_acceleration, higher[2]
        size, sign = abs(v), math.copysign(1.0, v)
        k, k1, k2 = motion.curvature, higher[0], higher[1]
        # tyres give way against the lateral acceleration k v^2, going forward as backing up
        c = -self._cornering
        angle = c * k * v * size
        rate = c * (k1 * v * size + 2.0 * k * size * v1)
        acceleration = c * (k2 * v * size + 4.0 * k1 * size * v1 + 2.0 * k * (sign * v1 * v1 + size * v2))
        if self._sines:
            w = w1 = w2 = 0.0
            for amplitude, omega, phase in self._sines:
                sine, cosine = amplitude * math.sin(omega * t + phase), amplitude * math.cos(omega * t + phase)
                w += sine
                w1 += omega * cosine
                w2 -= omega * omega * sine
            below = v * v + self._fade
            g, gv = v / below, (self._fade - v * v) / (below * below)
            gvv = 2.0 * v * (v * v - 3.0 * self._fade) / (below * below * below)
            g1, g2 = gv * v1, gvv * v1 * v1 + gv * v2
            angle += w * g
            rate += w1 * g + w * g1
            acceleration += w2 * g + 2.0 * w1 * g1 + w * g2
        return (angle, rate, acceleration)
