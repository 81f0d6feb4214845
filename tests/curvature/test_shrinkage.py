import math

import pytest
import torch

from sb3_crpn.curvature import Constant, JamesStein, resolve_shrinkage
from sb3_crpn.curvature.shrinkage import relative_noise
from tests.mdp import differs


def test_shrinkage_tends_to_one_as_groups_agree_and_to_none_in_noise():
    H = torch.tensor([[2.0, 1.0], [1.0, -3.0]], dtype=torch.float64)
    noise = torch.tensor([[1.0, -1.0], [-1.0, 0.5]], dtype=torch.float64)
    weights = torch.tensor([0.5, 0.5], dtype=torch.float64)
    factors = [
        JamesStein().factor(torch.stack([H + size * noise, H - size * noise]), weights)
        for size in (0.0, 0.1, 1.0, 10.0)
    ]
    assert factors[0] == 1.0
    assert factors[1] == pytest.approx(1.0 - 0.01 * 3.25 / 15.0)
    assert factors[1] > factors[2] > factors[3] == 0.0


def test_relative_noise_estimates_the_variance_of_the_mean():
    generator = torch.Generator().manual_seed(0)
    weights = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)
    truth = torch.tensor([3.0, -1.0], dtype=torch.float64)
    ratios, errors = [], []
    for _ in range(4000):
        noise = torch.randn(3, 2, dtype=torch.float64, generator=generator)
        groups = truth + noise / weights.sqrt()[:, None] / 10.0
        mean = weights @ groups
        ratios.append(relative_noise(groups, weights) * (mean**2).sum())
        errors.append(((mean - truth) ** 2).sum())
    differences = torch.stack(ratios) - torch.stack(errors)
    assert not differs(differences, 0.0)
    assert differs(2.0 * torch.stack(ratios) - torch.stack(errors), 0.0)


def test_noise_of_two_groups_is_their_disagreement():
    x = torch.tensor([[1.0, 2.0], [0.0, 3.0]], dtype=torch.float64)
    weights = torch.tensor([0.75, 0.25], dtype=torch.float64)
    expected = 0.75 * 0.25 * 2.0 / (0.75**2 + 2.25**2)
    assert relative_noise(x, weights) == pytest.approx(expected)


def test_noise_is_unknown_from_one_group_and_where_all_vanish():
    one, half = torch.ones(1, 2, 2), torch.full((2,), 0.5)
    assert math.isnan(relative_noise(one, torch.ones(1)))
    assert math.isnan(relative_noise(torch.zeros(2, 3), half))
    assert JamesStein().factor(one, torch.ones(1)) == 0.0
    assert JamesStein().factor(torch.zeros(2, 3, 3), half) == 0.0


def test_a_constant_looks_at_no_group():
    assert Constant(0.3).factor(torch.randn(2, 2, 2), torch.full((2,), 0.5)) == 0.3


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan])
def test_a_constant_is_a_fraction(value):
    with pytest.raises(ValueError, match=r"Constant: value=.* must be a finite number in \[0, 1\]"):
        Constant(value)


def test_what_stands_for_a_shrinkage():
    own = Constant(0.4)
    expected = {None: Constant(1.0), 0: Constant(0.0), 0.5: Constant(0.5), "auto": JamesStein()}
    assert {value: resolve_shrinkage(value, None) for value in expected} == expected
    assert resolve_shrinkage(own, None) is own
