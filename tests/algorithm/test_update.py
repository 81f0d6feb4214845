import numpy as np
import pytest
import torch
from stable_baselines3.common.logger import Logger

from sb3_crpn import CRPN, PAPER
from sb3_crpn.algorithm.update import UpdateData
from tests.policies import frozen_episodes, small_policy
from tests.training import TrainLog, make

N_FRESH, N_EARLIER = 6, 2


def data_of(n_earlier):
    """Episodes whose lengths tell them apart: 1 to 6 steps, and 11, 12, … the earlier ones."""
    policy = small_policy("discrete")[0]
    fresh = frozen_episodes(policy, lengths=range(1, N_FRESH + 1))
    earlier = [frozen_episodes(policy, lengths=(11 + k,)) for k in range(n_earlier)]
    return UpdateData(fresh, earlier)


@pytest.mark.parametrize("n_earlier", [0, N_EARLIER])
@pytest.mark.parametrize(("m", "b"), [(2, 4), (4, 2), (6, 6), (None, 3), (3, None), (3, 9)])
def test_each_derivative_gets_its_episodes_and_the_earlier_ones(m, b, n_earlier):
    data = data_of(n_earlier)
    earlier = [11 + k for k in range(n_earlier)]
    batch, hessian_batch, fisher_batch = data.draw(m, b, np.random.default_rng(0))
    hessian_batch, fisher_batch = hessian_batch or batch, fisher_batch or batch
    n_hessian = min(b, N_FRESH) if b else m or N_FRESH
    for drawn, number, joined in (
        (batch, min(m or N_FRESH, N_FRESH), earlier),
        (hessian_batch, n_hessian, earlier),
        (fisher_batch, min(m or N_FRESH, N_FRESH), []),
    ):
        fresh, rest = drawn.lengths[:number], drawn.lengths[number:]
        assert len(set(fresh)) == number
        assert set(fresh) <= set(range(1, N_FRESH + 1))
        assert rest.tolist() == joined


def test_episodes_are_drawn_at_random():
    data, rng = data_of(0), np.random.default_rng(0)
    counts = sum(np.bincount(data.draw(2, None, rng)[0].lengths, minlength=7) for _ in range(600))
    assert counts[1:].sum() == 1200
    assert np.abs(counts[1:] - 200).max() < 5 * np.sqrt(600 * (2 / 6) * (4 / 6))


def test_a_target_of_a_subclass_counts_where_the_constructor_has_none():
    class Bounded(CRPN):
        def _update_target_kl(self, batch):
            return 0.01

    log = TrainLog()
    make(Bounded, solver="krylov", n_steps=32, **PAPER).learn(200, log)
    assert all(0.0 <= row["kl_divergence"] <= 0.01 for row in log.rows)
    assert max(row["kl_divergence"] for row in log.rows) > 0.009


def test_a_frozen_critic_is_not_fitted():
    model = make(CRPN)
    critic = [*model.policy.value_net.parameters()]
    critic += model.policy.mlp_extractor.value_net.parameters()
    for parameter in critic:
        parameter.requires_grad_(False)
    before, theta = [parameter.clone() for parameter in critic], model.actor.vector
    model.learn(80)
    assert all(map(torch.equal, before, critic))
    assert model.last_update.value_loss is None
    assert not torch.equal(model.actor.vector, theta)


def test_an_error_of_the_logger_undoes_no_update(monkeypatch):
    def full(logger, key, value, exclude=None):
        if key == "train/alpha":
            raise OSError("no space left on device")

    model = make(CRPN)
    theta = model.actor.vector
    monkeypatch.setattr(Logger, "record", full)
    with pytest.raises(OSError, match="no space"):
        model.learn(80)
    assert model._n_updates == 1
    assert model.last_update.accepted
    assert not torch.equal(model.actor.vector, theta)
