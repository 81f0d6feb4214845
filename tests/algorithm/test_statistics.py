from dataclasses import asdict, fields

import pytest
from stable_baselines3.common.logger import Logger

from sb3_crpn import ACRPN
from sb3_crpn.algorithm.statistics import LOG_KEYS, UpdateStats
from tests.training import TrainLog, both, make


@both
@pytest.mark.parametrize("settings", [{}, {"target_kl": None}])
def test_the_log_is_written_from_the_last_update(algorithm, settings):
    log = TrainLog()
    model = make(algorithm, **settings).learn(100, log)
    stats = model.last_update
    assert stats.n_updates == model._n_updates
    absent = {"std"} | ({"target_kl"} if settings else set())
    row = log.rows[-1]
    assert set(LOG_KEYS) - set(row) == absent
    for key in set(LOG_KEYS) - absent:
        assert row[key] == getattr(stats, LOG_KEYS[key])
    assert isinstance(row["certified"], int)


def test_every_field_but_the_end_of_training_is_logged():
    assert {field.name for field in fields(UpdateStats)} == set(LOG_KEYS.values()) - {
        "rejected"
    } | {"at_sosp"}


def test_policy_objective_is_trpos():
    """The mean over steps of advantage times ratio, on the batch of the step."""
    model = make(ACRPN, n_reused_rollouts=0, normalize_advantage=False)
    batches = []
    estimate = model._estimate

    def recorded(*arguments):
        batch = estimate(*arguments).gradient_batch
        batches.append((batch, log_prob(batch)))
        return estimate(*arguments)

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
