import pytest
import torch

from sb3_crpn.sosp.robust import robust_lambda_min
from tests.sosp.problems import noisy_sample


@pytest.mark.parametrize("d", [3, 6])
@pytest.mark.parametrize("noise", [0.1, 1.0])
def test_the_robust_lambda_min_is_a_tight_bound(d, noise):
    generator = torch.Generator().manual_seed(d)
    H = torch.diag(torch.linspace(-1.0, 2.0, d, dtype=torch.float64))
    sample = noisy_sample(torch.zeros(d, dtype=torch.float64), H, noise, 10, d)
    hessians = torch.stack([sample.products(e) for e in torch.eye(d, dtype=torch.float64)], dim=2)
    mean = hessians.mean(0)
    variance = ((hessians - mean) @ (hessians - mean)).sum(0) / 9
    leftmost, start = (
        torch.linalg.eigh(mean).eigenvectors[:, 0],
        torch.randn(d, generator=generator),
    )
    bound = robust_lambda_min(sample, leftmost, start.double(), 0.7)

    v = torch.randn(200_000, d, generator=generator, dtype=torch.float64)
    v /= v.norm(dim=1, keepdim=True)
    quadratic = torch.einsum("ni,ij,nj->n", v, mean, v)
    spread = torch.einsum("ni,ij,nj->n", v, variance, v).sqrt()
    least = (quadratic - 0.7 * spread).min().item()
    width = torch.linalg.eigvalsh(mean)[0].item() - bound
    assert least - 0.1 * width < bound <= least + 1e-9
