import pytest
import torch

from benchmarks.exact import actor_vector, coordination_mdp
from benchmarks.experiments.learners import ALGORITHMS, make_learner, run_until

MDP = coordination_mdp()
START = torch.tensor([0.5, 0, 0, 0.25, 0, -0.5], dtype=torch.float64)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.filterwarnings("ignore::UserWarning")  # PPO and TRPO, of a minibatch cut short
def test_every_update_sees_the_batch_of_whole_episodes(algorithm):
    model = make_learner(algorithm, MDP, 6, START, seed=0)
    seen = []
    until = run_until(model, lambda theta: seen.append(theta) is not None, max_updates=2)
    assert until.n_updates == 2
    assert not until.met
    assert torch.equal(seen[0], START)
    assert not torch.equal(seen[1], START)
    assert torch.equal(until.theta, seen[2])
    assert torch.equal(actor_vector(model.policy), until.theta)
    # two updates of six episodes of two steps; the step that ends the third rollout is not used
    assert model.num_timesteps == 2 * 6 * 2 + 6


def test_it_stops_where_the_condition_holds():
    model = make_learner("REINFORCE", MDP, 50, START, seed=0, actor_learning_rate=1.0)
    until = run_until(model, lambda theta: -MDP.cost(theta).item() > 0.3, max_updates=100)
    assert until.met
    assert 0 < until.n_updates < 100
    assert -MDP.cost(until.theta).item() > 0.3
