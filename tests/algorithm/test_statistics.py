from dataclasses import asdict, fields

import numpy as np
import pytest
import scipy.linalg
import torch
from stable_baselines3.common.logger import Logger

from sb3_crpn import ACRPN, CRPN
from sb3_crpn.algorithm.statistics import UpdateStats
from sb3_crpn.curvature.derivatives import EpisodeDerivatives
from tests.training import TrainLog, both, make

ALSO = {
    "step_rejected": "step_rejected",
    "kl_divergence_loss": "kl_divergence",
    "is_line_search_success": "accepted",
}


@both
@pytest.mark.parametrize("settings", [{}, {"target_kl": None}])
def test_the_log_is_written_from_the_last_update(algorithm, settings):
    log = TrainLog()
    model = make(algorithm, **settings).learn(100, log)
    stats, row = model.last_update, log.rows[-1]
    assert stats.n_updates == model._n_updates
    absent = {"std", "accepted", "at_sosp"} | ({"target_kl"} if settings else set())
    logged = {field.name for field in fields(UpdateStats)} - absent
    assert set(row) == logged | set(ALSO) | {"learning_rate"}
    for key in logged | set(ALSO):
        assert row[key] == getattr(stats, ALSO.get(key, key))
    assert isinstance(row["certified"], int)


def test_policy_objective_is_trpos():
    """The mean over steps of advantage times ratio, on the batch of the step."""
    model = make(ACRPN, n_reused_rollouts=0, normalize_advantage=False)
    batches = []
    estimate = model._estimate

    def recorded(data):
        batch = estimate(data).gradient_batch
        batches.append((batch, log_prob(batch)))
        return estimate(data)

    def log_prob(batch):
        distribution = model.policy.get_distribution(batch.observations)
        return distribution.log_prob(batch.actions).detach()

    model._estimate = recorded
    model.learn(1)
    batch, before = batches[-1]
    ratio = (log_prob(batch) - before).exp().double().numpy()
    expected = -(batch.cost_advantages * ratio).mean()
    assert model.last_update.accepted
    assert model.last_update.policy_objective == pytest.approx(expected, rel=1e-5)


def test_text_and_counters_stay_out_of_tensorboard(tmp_path):
    model = make(ACRPN).learn(1)
    logger = Logger(str(tmp_path), [])
    model.last_update.write(logger)
    excluded = {k for k, v in logger.name_to_excluded.items() if v and "tensorboard" in v}
    assert excluded == {"train/solver_status", "train/n_updates"}
    assert asdict(model.last_update)["solver_status"] == model.last_update.solver_status


@both
def test_a_new_learn_forgets_the_last_update(algorithm, tmp_path):
    model = make(algorithm).learn(50)
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model", device="cpu").last_update is None
    seen = []
    model.learn(1, lambda local, _: seen.append(local["self"].last_update) or True)
    assert seen[0] is None
    assert model.last_update.n_updates == model._n_updates


def test_logged_values_are_those_of_the_rollout_and_its_matrices(monkeypatch):
    """Explained variance, the leftmost eigenvalue of H relative to M = F + εI, and products."""
    model, log = make(CRPN, net_arch=[], n_reused_rollouts=0, solver="dense"), TrainLog()
    estimate, product = model._estimate, EpisodeDerivatives.fisher_product
    seen, products = [], []

    def recorded(data):
        found = estimate(data)
        seen.append((found.gradient_batch, found.hessian.to_dense(), found.fisher.to_dense()))
        products.clear()
        return found

    def counted(self, vector):
        products.append(vector)
        return product(self, vector)

    model._estimate = recorded
    monkeypatch.setattr(EpisodeDerivatives, "fisher_product", counted)
    model.learn(1, log)
    [(batch, hessian, fisher)] = seen
    unexplained = np.var(batch.returns - batch.values) / np.var(batch.returns)
    assert log["explained_variance"] == pytest.approx([1.0 - unexplained])
    metric = fisher + model.fisher_damping * torch.eye(len(fisher))
    leftmost = scipy.linalg.eigh(hessian, metric, eigvals_only=True)[0]
    assert log["lambda_min"] == pytest.approx([leftmost], rel=1e-4)
    assert log["hessian_vector_products"] == [len(products) / 2]  # two folds


@both
def test_a_krylov_space_costs_as_many_products_as_it_has_dimensions(algorithm):
    log, settings = TrainLog(), {"solver": "krylov"} if algorithm is CRPN else {}
    make(algorithm, krylov_dim=7, **settings).learn(100, log)
    assert log["hessian_vector_products"] == [7] * len(log.rows)
