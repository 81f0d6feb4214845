import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_crpn.curvature import Causal
from tests.policies import ESTIMATORS, estimator_of, pair_matrix


@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    case=st.sampled_from(ESTIMATORS),
    seed=st.integers(0, 1000),
)
@settings(deadline=None, max_examples=60)
def test_pair_weights_are_the_explicit_matrix(lengths, case, seed):
    rng = np.random.default_rng(seed)
    A, u = rng.normal(size=(2, sum(lengths)))
    pieces = np.cumsum(lengths)[:-1]
    expected = [
        pair_matrix(*case, part) @ x
        for part, x in zip(np.split(A, pieces), np.split(u, pieces), strict=True)
    ]
    np.testing.assert_allclose(
        estimator_of(*case).apply(A, np.array(lengths), u),
        np.concatenate(expected),
        atol=1e-12,
    )


@pytest.mark.parametrize("case", ESTIMATORS)
def test_pair_weights_take_several_vectors_at_once(case):
    lengths = np.array([3, 1, 4])
    A, *u = np.random.default_rng(0).normal(size=(4, 8))
    W = estimator_of(*case)
    expected = np.stack([W.apply(A, lengths, column) for column in u], axis=1)
    applied = W.apply(A, lengths, np.stack(u, axis=1))
    np.testing.assert_allclose(applied, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("decay", [-0.1, 1.1, float("nan")])
def test_decay_is_a_fraction(decay):
    with pytest.raises(ValueError, match=r"Causal: decay=.* must be a finite number in \[0, 1\]"):
        Causal(decay)
