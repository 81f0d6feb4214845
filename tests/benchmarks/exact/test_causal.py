import pytest
import torch

from benchmarks.exact import actor_vector, coordination_mdp, expected_causal_hessian
from benchmarks.experiments.learners import make_learner
from tests.benchmarks.exact.test_mdp import MDPS, parameters
from tests.mdp import differs


@pytest.mark.parametrize("mdp", MDPS)
def test_undecayed_it_is_the_hessian(mdp):
    theta = parameters(mdp)
    expected = expected_causal_hessian(mdp, theta, 1.0)
    torch.testing.assert_close(expected, mdp.hessian(theta), rtol=0, atol=1e-12)


def test_it_is_what_the_estimator_of_the_package_estimates():
    mdp = coordination_mdp(0.9, noise=1.0)  # all curvature is between the two steps
    arguments = {"hessian_estimator": "causal", "hessian_lambda": 0.5}
    model = make_learner("CRPN, paper", mdp, 500, 0.3 * parameters(mdp), 0, **arguments)
    samples = torch.stack([model.estimate_curvature(500).hessian.to_dense() for _ in range(20)])
    theta = actor_vector(model.policy)
    assert not differs(samples, expected_causal_hessian(mdp, theta, 0.5))
    assert differs(samples, expected_causal_hessian(mdp, theta, 1.0))
