"""The cost model of several ranks, on messages whose times are known."""

import pytest

from benchmarks.distributed import Ring, fit_ring


def test_the_costs_of_a_ring_are_found_again():
    ring = Ring(per_hop=1e-4, per_byte=2e-9)
    rows = [{"bytes": n, "seconds": ring.seconds(1, n, 4)} for n in (8, 8_000, 8_000_000)]
    found = fit_ring(rows, 4)
    # the smallest message's bytes count as hops
    assert found == pytest.approx(ring, rel=1e-3)


def test_a_ring_of_more_ranks_has_more_hops_with_fewer_bytes_each():
    ring = Ring(per_hop=1.0, per_byte=0.5, per_message=10.0)
    # 2 messages: 2 * 10; 2 ranks: 2 hops of half of 8 bytes; 4 ranks: 6 hops of a quarter
    assert ring.seconds(2, 8, 2) == 20 + 2 * 2 + 2 * 4 * 0.5
    assert ring.seconds(2, 8, 4) == 20 + 2 * 6 + 6 * 2 * 0.5
