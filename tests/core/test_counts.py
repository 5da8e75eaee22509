"""Capacities and places that are chosen on the host."""

import numpy as np

from ssplat_jax.core.numerics import evenly_spread, power_of_two


def test_a_power_of_two_is_the_least_that_holds_a_number():
    powers = [2**k for k in range(12)]
    assert [power_of_two(n) for n in range(2049)] == [min(p for p in powers if p >= n) for n in range(2049)]


def test_places_are_spread_evenly_with_both_ends():
    for count in range(1, 40):
        for most in range(2, 12):
            places = evenly_spread(count, most)
            assert len(places) == min(count, most) and places[0] == 0 and places[-1] == count - 1
            gaps = np.diff(places)
            assert not len(gaps) or (gaps.min() >= 1 and gaps.max() - gaps.min() <= 1)
    assert evenly_spread(0, 5) == []
