from __future__ import annotations

import numpy as np
import pytest

from modelserver.simulation.sensors import GaussMarkov, NoiseSource


def test_prefetched_numbers_are_the_same():
    one, prefetched = NoiseSource(3, "x"), NoiseSource(3, "x").prefetch()
    for _ in range(700):
        assert one.normal(2.0) == prefetched.normal(2.0)
        assert one.vector() == prefetched.vector()


@pytest.mark.parametrize(
    "draw",
    [
        lambda noise: noise.generator.uniform(0.0, 1.0),
        lambda noise: noise.generator.random() < 0.5,
        lambda noise: noise.generator.exponential(1.0),
        lambda noise: noise.generator.binomial(10, 0.5),
        lambda noise: noise.generator.integers(3),
    ],
)
def test_other_distributions_follow_the_seed_and_are_rejected_while_prefetching(draw):
    assert [draw(NoiseSource(3, "x"))] * 2 == [draw(NoiseSource(3, "x")) for _ in range(2)]
    with pytest.raises(ValueError, match="prefetches"):
        draw(NoiseSource(3, "x").prefetch())


def test_a_gauss_markov_process_keeps_its_variance_for_any_step():
    process = GaussMarkov(0.5, 3.0, NoiseSource(1, "x"))
    values = [process.step(dt) for _ in range(4000) for dt in (0.5, 2.0)]
    assert np.std(values) == pytest.approx(0.5, rel=0.05)
