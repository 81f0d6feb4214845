from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.callbacks import RandomIterateCallback
from tests.training import make, same, several, tensors


class Iterates(BaseCallback):
    """Records all iterates θ_0, θ_1, …, which the reservoir does not."""

    def __init__(self):
        super().__init__()
        self.kept = []

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self.kept.append(tensors(self.model))

    def _on_training_end(self):
        self.kept.append(tensors(self.model))


class Stop(BaseCallback):
    def _on_step(self):
        return False


def quick(**arguments):
    return make(CRPN, net_arch=[], n_steps=16, **PAPER, **{"alpha": 100.0} | arguments)


def peer(algorithm, **arguments):
    return algorithm("MlpPolicy", several(2), n_steps=8, seed=0, device="cpu", **arguments)


MODELS = {
    "CRPN": lambda: make(CRPN, n_steps=16),
    "CRPN, paper": quick,
    "ACRPN": lambda: make(ACRPN, n_steps=16),
    "PPO": lambda: peer(PPO, n_epochs=2, batch_size=8),
    "A2C": lambda: peer(A2C),
}


@pytest.fixture(params=MODELS)
def model(request):
    return MODELS[request.param]()


def equal(left, right):
    return left.keys() == right.keys() and all(torch.equal(left[k], right[k]) for k in left)


def test_it_keeps_the_iterate_after_the_drawn_update(model):
    iterates, draws = Iterates(), [RandomIterateCallback(seed=seed) for seed in range(4)]
    model.learn(100, [iterates, *draws])
    n_updates = len(iterates.kept) - 1
    assert n_updates > 3
    for draw in draws:
        assert draw.n_iterations == n_updates
        assert 1 <= draw.iteration <= n_updates
        assert equal(draw.parameters, iterates.kept[draw.iteration])
    assert len({draw.iteration for draw in draws}) > 1
    assert same(model, iterates.kept[-1])


def draw(model, alphas, seed):
    """R after updates with the given α, by the hooks that training calls."""
    callback = RandomIterateCallback(seed=seed)
    callback.init_callback(model)
    callback.on_training_start({}, {})
    for alpha in alphas:
        callback.on_rollout_start()
        model._n_updates += 1
        model.last_update = SimpleNamespace(alpha=alpha)
    callback.on_training_end()
    return callback.iteration


@pytest.mark.parametrize("ours", [True, False])
def test_the_distribution_is_proportional_to_alpha(ours):
    model = quick() if ours else peer(A2C)
    model.set_logger(Logger(None, []))
    alphas, n_draws = np.array([4.0, 1.0, 2.0, 0.5, 2.5]), 400
    drawn = [draw(model, alphas, seed) for seed in range(n_draws)]
    counts = np.bincount(drawn, minlength=6)[1:]
    expected, other = alphas / alphas.sum(), np.full(5, 0.2)
    if not ours:
        expected, other = other, expected
    assert chisquare(counts, n_draws * expected).pvalue > 1e-6
    assert chisquare(counts, n_draws * other).pvalue < 1e-6


def test_the_weights_are_the_alphas_of_the_updates():
    callback, weights = RandomIterateCallback(seed=0), []
    weight = callback._weight
    callback._weight = lambda: weights.append(weight()) or weights[-1]
    model = quick(alpha=lambda rest: 10.0 + 90.0 * max(rest, 0.0)).learn(100, callback)
    assert weights == sorted(weights, reverse=True)
    assert 10.0 <= weights[-1] < 50.0 < weights[0] <= 100.0
    assert len(weights) == model._n_updates


def test_the_seed_decides():
    model = quick()
    model.set_logger(Logger(None, []))
    draws = [draw(model, [1.0] * 100, seed) for seed in (1, 2, 3, 1, 2, 3)]
    assert draws[:3] == draws[3:]
    assert len(set(draws)) == 3


def test_it_leaves_training_as_it_is():
    plain, watched = quick().learn(100), quick().learn(100, RandomIterateCallback())
    assert same(plain, tensors(watched))


@pytest.mark.parametrize("assign", [False, True])
def test_saved_and_assigned(tmp_path, assign):
    path, last = tmp_path / "new" / "random.zip", Iterates()
    callback = RandomIterateCallback(path, assign=assign, seed=1)
    model = quick().learn(200, [last, callback])
    loaded = CRPN.load(path, device="cpu")
    assert callback.iteration < callback.n_iterations
    assert same(loaded, callback.parameters)
    assert not same(loaded, last.kept[-1])
    assert same(model, callback.parameters if assign else last.kept[-1])


def test_a_failed_save_leaves_the_model_as_it_was(tmp_path, monkeypatch):
    model, last = quick(), Iterates()

    def fail(path):
        raise OSError("disk full")

    monkeypatch.setattr(model, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        model.learn(200, [last, RandomIterateCallback(tmp_path / "model", seed=1)])
    assert same(model, last.kept[-1])


def test_without_an_update_nothing_is_kept_or_saved(tmp_path):
    callback = RandomIterateCallback(tmp_path / "model")
    quick().learn(100, [Stop(), callback])
    assert callback.iteration is None
    assert callback.n_iterations == 0
    assert list(tmp_path.iterdir()) == []


def test_the_last_update_counts_where_an_algorithm_ends_training_itself(capsys):
    model = make(ACRPN, stop_at_sosp=True, sosp_epsilon=1e4, gradient_lipschitz=400.0)
    callback = RandomIterateCallback(verbose=1)
    model.learn(10_000, callback)
    assert callback.n_iterations == callback.iteration == model._n_updates == 1
    assert "R = 1 of N = 1" in capsys.readouterr().out


def test_it_goes_on_counting_over_several_calls_of_learn():
    model, callback = quick(), RandomIterateCallback(seed=0)
    model.learn(100, callback).learn(100, callback, reset_num_timesteps=False)
    assert callback.n_iterations == model._n_updates
