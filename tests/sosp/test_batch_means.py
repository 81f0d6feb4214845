import numpy as np
import pytest
import torch

from sb3_crpn.sosp.batch_means import BatchMeans
from tests.policies import dense_hessian, flat_gradient, frozen_episodes, small_policy

LENGTHS = (3, 1, 4, 2, 2, 3, 1, 2)
GAMMA = 0.9


def sample_of(kind="discrete", n_blocks=4, net_arch=(3,)):
    policy, actor = small_policy(kind, net_arch=net_arch)
    batch = frozen_episodes(policy, LENGTHS)
    rng = np.random.default_rng(0)
    sample = BatchMeans.from_episodes(policy, actor, batch, n_blocks, GAMMA, rng)
    return policy, actor, batch, sample


def vectors(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("net_arch", [(), (3,)], ids=["written out", "by products"])
@pytest.mark.parametrize("kind", ["discrete", "gaussian"])
def test_blocks_are_the_undamped_causal_estimates_of_their_episodes(kind, net_arch):
    policy, actor, batch, sample = sample_of(kind, net_arch=net_arch)
    order = np.random.default_rng(0).permutation(len(LENGTHS))
    X = vectors(4, len(actor))
    products = sample.block_products(X)
    for k in range(4):
        block = batch.take(order[k::4])
        expected = dense_hessian(policy, actor, block, "causal", 1.0)
        torch.testing.assert_close(products[k], expected @ X[k])
        log_prob = policy.get_distribution(block.observations).log_prob(block.actions)
        gradient = flat_gradient(log_prob @ torch.from_numpy(block.cost_advantages), actor) / 2
        torch.testing.assert_close(sample.gradients[k], gradient)


def test_halves_and_moments_are_those_of_the_blocks():
    sample = sample_of()[-1]
    v = vectors(sample.size)
    identity = torch.eye(sample.size, dtype=torch.float64)
    hessians = torch.stack([sample.products(column) for column in identity], dim=2)
    mean = hessians.mean(0)
    for half, product in enumerate(sample.fold_products):
        torch.testing.assert_close(product(v), hessians[half::2].mean(0) @ v)
    torch.testing.assert_close(sample.mean_product(v), mean @ v)
    variance = ((hessians - mean) @ (hessians - mean)).sum(0) / 3
    for product, expected in zip(sample.moment_products(v), (mean, variance), strict=True):
        torch.testing.assert_close(product, expected @ v)


def test_writing_out_changes_nothing():
    sample = sample_of()[-1]
    written = sample.to_dense()
    v, X = vectors(sample.size), vectors(4, sample.size)
    torch.testing.assert_close(written.block_products(X), sample.block_products(X))
    torch.testing.assert_close(written.mean_product(v), sample.mean_product(v))
    torch.testing.assert_close(
        written.model_covariance_product(v), sample.model_covariance_product(v)
    )
