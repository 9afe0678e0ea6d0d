from __future__ import annotations

import numpy as np
import pytest

from modelserver.simulation.noise import GaussMarkov, NoiseSource


def test_numbers_drawn_ahead_are_the_same_ones():
    one, ahead = NoiseSource(3, "x"), NoiseSource(3, "x").draw_ahead()
    for _ in range(700):
        assert one.normal(2.0) == ahead.normal(2.0)
        assert one.vector() == ahead.vector()


@pytest.mark.parametrize(
    "draw",
    [
        lambda noise: noise.uniform(0.0, 1.0),
        lambda noise: noise.chance(0.5),
        lambda noise: noise.wait(1.0),
        lambda noise: noise.hits(10, 0.5),
        lambda noise: noise.index(3),
    ],
)
def test_other_draws_are_of_the_seed_and_refused_where_they_would_come_out_of_order(draw):
    assert [draw(NoiseSource(3, "x"))] * 2 == [draw(NoiseSource(3, "x")) for _ in range(2)]
    with pytest.raises(ValueError, match="ahead"):
        draw(NoiseSource(3, "x").draw_ahead())


def test_a_gauss_markov_process_keeps_its_size_whatever_its_step():
    process = GaussMarkov(0.5, 3.0, NoiseSource(1, "x"))
    values = [process.step(dt) for _ in range(4000) for dt in (0.5, 2.0)]
    assert np.std(values) == pytest.approx(0.5, rel=0.05)
