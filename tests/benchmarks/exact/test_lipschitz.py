import pytest
import torch

from benchmarks.exact import coordination_mdp, lipschitz_constants


def test_the_constants_of_the_coordination_mdp():
    """∇²J is largest at the saddle; ∇³J by a search over the plane of the two logits."""
    first, second = lipschitz_constants(coordination_mdp(), n_starts=3)
    assert first == pytest.approx(1.5, abs=1e-6)
    z = torch.linspace(-4, 4, 161, dtype=torch.float64)
    f = torch.tanh(z / 2)
    slope = (1 - f**2) / 2  # f′, then f″ = -f f′ and f‴
    derivatives = torch.stack([f, slope, -f * slope, slope * (3 * f**2 - 1) / 2])
    largest = 0.0
    for angle in torch.linspace(0, torch.pi, 121).tolist():
        # unit steps in θ move (z_0, z_1) along (√3 cos + sin, √3 cos - sin): ‖∇z‖² = 4, cos 60°
        direction = torch.tensor(angle, dtype=torch.float64)
        p = 3**0.5 * direction.cos() + direction.sin()
        q = 3**0.5 * direction.cos() - direction.sin()
        third = sum(
            c * p ** (3 - k) * q**k * torch.outer(derivatives[3 - k], derivatives[k])
            for k, c in enumerate((1, 3, 3, 1))
        )
        largest = max(largest, third.abs().max().item())
    assert second == pytest.approx(largest, rel=2e-3)
