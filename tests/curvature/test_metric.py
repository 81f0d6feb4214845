import math

import pytest
import torch

from sb3_crpn.curvature import Euclidean, Fisher


def test_whitening_makes_the_metric_the_identity():
    X = torch.randn(4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    form, identity = X @ X.T, torch.eye(4, dtype=torch.float64)  # of rank 3
    W = Fisher(0.2).whitening(form)
    torch.testing.assert_close(W @ (form + 0.2 * identity) @ W.T, identity)
    assert torch.equal(Euclidean().whitening(form), identity)


def test_an_eigenvalue_that_rounding_made_negative_counts_as_zero():
    form = torch.diag(torch.tensor([1.0, -1e-3], dtype=torch.float64))
    W = Fisher(1e-6).whitening(form)
    assert float(torch.linalg.matrix_norm(W, 2)) == pytest.approx(1e3)


@pytest.mark.parametrize("damping", [0.0, -1.0, math.nan, math.inf])
def test_damping_is_positive(damping):
    with pytest.raises(ValueError, match=r"Fisher: damping=.* must be a finite number in"):
        Fisher(damping)
