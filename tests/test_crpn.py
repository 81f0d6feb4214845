"""The update that both algorithms share, and CRPN as the paper's Algorithm 1."""

import copy
import dataclasses
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import MultiCategoricalDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.algorithm import algorithm as base
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.cubic import solve_dense
from tests.envs import Drift, Sampler
from tests.oracle import paper_estimates
from tests.policies import frozen_episodes, small_policy
from tests.training import TrainLog, both, make, same, several, tensors

METRICS = pytest.mark.parametrize("metric", ["fisher", "euclidean"])
NUMBERS = spaces.Box(-1.0, 1.0, (3,))


def mean_kl(model, observations, before, after):
    """Mean KL(π_before ‖ π_after) over states and the action's components."""
    policies = []
    for theta in (before, after):
        policy = copy.deepcopy(model)
        policy.actor.assign(theta)
        policies.append(policy.policy.get_distribution(observations))
    pairs = [(policies[0].distribution, policies[1].distribution)]
    if isinstance(policies[0], MultiCategoricalDistribution):
        pairs = zip(policies[0].distribution, policies[1].distribution, strict=True)
    kl = [torch.distributions.kl_divergence(old, new) for old, new in pairs]
    return torch.stack([part.mean() for part in kl]).mean().item()


class States(BaseCallback):
    """The observations of each rollout."""

    def __init__(self):
        super().__init__()
        self.kept = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        buffer = self.model.rollout_buffer
        self.kept.append(torch.as_tensor(buffer.observations[: buffer.pos]).flatten(0, 1))


@both
@METRICS
@pytest.mark.parametrize(
    "actions",
    [
        spaces.Discrete(3),
        spaces.Box(-1.0, 1.0, (3,)),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
    ],
    ids=lambda space: type(space).__name__,
)
def test_target_kl_is_met_within_ten_per_cent(algorithm, metric, actions):
    """The divergence is computed from the policies. With H = 0 every divergence can be met."""
    log, states = TrainLog(), States()
    env = Sampler(NUMBERS, actions)
    settings = {"metric": metric, "hessian_shrinkage": 0.0, "n_episodes": 8}
    model = make(algorithm, env, n_reused_rollouts=0, **settings)
    model.learn(120, [log, states])
    assert sum(log["step_rejected"]) <= 1
    steps = zip(log.rows, states.kept, log.before, log.after, strict=True)
    for row, observations, before, after in steps:
        if not row["step_rejected"]:
            kl = mean_kl(model, observations, before, after)
            assert row["kl_divergence"] == pytest.approx(kl, rel=1e-3)
            assert 0.9 * model.target_kl <= kl <= model.target_kl * (1 + 1e-3)


@both
@METRICS
@pytest.mark.parametrize("settings", [{}, {"krylov_dim": 3}, {"hessian_estimator": "trajectory"}])
def test_target_kl_is_never_exceeded(algorithm, metric, settings):
    log = TrainLog()
    settings = {"metric": metric, "target_kl": 0.02, "n_reused_rollouts": 0, **settings}
    make(algorithm, several(), **settings).learn(1000, log)
    met = [0.9 * 0.02 <= kl <= 0.02 for kl in log["kl_divergence"]]
    assert max(log["kl_divergence"]) <= 0.02
    assert np.mean(met) >= 0.5


@both
@METRICS
def test_fixed_alpha_follows_its_schedule(algorithm, metric):
    log = TrainLog()
    model = make(
        algorithm,
        Drift(bound=np.inf, limit=10),
        n_episodes=4,
        target_kl=None,
        metric=metric,
        alpha=lambda progress: 100.0 + 900.0 * progress,
    )
    model.learn(160, log)
    np.testing.assert_allclose(log["alpha"], [775.0, 550.0, 325.0, 100.0])
    lengths = [b - a for a, b in zip(log.before, log.after, strict=True)]
    np.testing.assert_allclose(
        [float(step.norm()) for step in lengths], log["step_norm"], rtol=1e-3
    )
    if metric == "euclidean":
        halves = np.array(log["alpha"]) * log["step_norm"] / 2
        np.testing.assert_allclose(log["multiplier"], halves, rtol=1e-6)


@both
def test_schedules_end_where_whole_episodes_overrun_the_last_timestep(algorithm):
    """40 steps an update. The last one ends at a remaining progress of -1."""
    log = TrainLog()
    env = Drift(bound=np.inf, limit=10)
    linear = {"alpha": lambda progress: 1.0 + progress, "learning_rate": lambda progress: progress}
    make(algorithm, env, n_episodes=4, target_kl=None, **linear).learn(20, log)
    assert log["alpha"] == [1.0]
    assert log["learning_rate"] == [0.0]


class Batches:
    """Records the batches of the curvature estimates."""

    def __init__(self, monkeypatch):
        self.sizes, self.observations, self.of_fisher = [], [], []
        self.estimate = base.estimate_curvature
        monkeypatch.setattr(base, "estimate_curvature", self)

    def __call__(self, policy, actor, batch, estimator, **options):
        hessian_batch = options["hessian_batch"] or batch
        self.sizes.append((batch.n_episodes, hessian_batch.n_episodes))
        self.observations.append((batch.observations, hessian_batch.observations))
        self.of_fisher.append((options["fisher_batch"] or batch).n_episodes)
        return self.estimate(policy, actor, batch, estimator, **options)


@both
@pytest.mark.parametrize(("m", "b"), [(3, 6), (6, 3), (5, 5), (4, None), (None, 3), (None, 12)])
def test_batch_sizes(algorithm, m, b, monkeypatch):
    """m_k and b_k episodes, each drawn without replacement from max(m_k, b_k)."""
    batches, log = Batches(monkeypatch), TrainLog()
    env = DummyVecEnv([lambda: Sampler(NUMBERS, spaces.Discrete(2))] * 2)
    sizes = {"n_episodes": m, "n_hessian_episodes": b}
    make(algorithm, env, n_steps=8, n_reused_rollouts=0, **sizes).learn(100, log)
    from_steps = 4  # 2 environments, 8 steps, episodes of 4; a single one in the first update
    simulated = log["n_episodes"]
    assert simulated[1] == max(m or 0, b or 0, 0 if m else from_steps)
    m_used, b_used = batches.sizes[1]
    assert m_used == (m or simulated[1])
    assert b_used == (b or m_used)
    for pair, sizes in zip(batches.observations, batches.sizes, strict=True):
        for observations, size in zip(pair, sizes, strict=True):
            assert len(torch.unique(observations, dim=0)) == len(observations) == 4 * size
    if m_used < simulated[1]:
        pairs = batches.observations[1:]
        assert any(not torch.equal(gradient[0], hessian[0]) for gradient, hessian in pairs)


@both
@pytest.mark.parametrize("rising", [True, False])
def test_scheduled_batch_sizes(algorithm, rising, monkeypatch):
    """An update uses the batch sizes of its simulation."""
    batches, log = Batches(monkeypatch), TrainLog()

    def n_episodes(progress):
        return 10 - 8 * progress if rising else 2 + 8 * progress

    def n_hessian_episodes(progress):
        return n_episodes(progress) / 2

    make(
        algorithm,
        Sampler(NUMBERS, spaces.Discrete(2)),
        n_episodes=n_episodes,
        n_hessian_episodes=n_hessian_episodes,
        n_reused_rollouts=0,
    ).learn(100, log)
    gradient_sizes, hessian_sizes = zip(*batches.sizes, strict=True)
    assert list(gradient_sizes) == log["n_episodes"]
    assert gradient_sizes[0] == (2 if rising else 10)
    assert [abs(2 * b - m) <= 1 for m, b in batches.sizes] == [True] * len(batches.sizes)
    assert (gradient_sizes[-1] > gradient_sizes[0]) == rising
    assert min(hessian_sizes) >= 1


@both
def test_earlier_rollouts_of_the_same_call_join_an_update(algorithm, monkeypatch):
    batches, log = Batches(monkeypatch), TrainLog()
    model = make(algorithm, n_episodes=3, n_hessian_episodes=2, n_reused_rollouts=2)
    model.learn(100, log)
    assert set(log["n_episodes"]) == {3}
    assert log["n_reused_rollouts"][:3] == [0, 1, 2]
    assert set(log["n_reused_rollouts"][3:]) == {2}
    assert batches.sizes[:3] == [(3, 2), (3 + 3, 2 + 3), (3 + 6, 2 + 6)]
    assert set(batches.sizes[3:]) == {(9, 8)}
    assert set(batches.of_fisher) == {3}
    fresh, joined = (batches.observations[k][0] for k in (0, 1))
    assert torch.equal(joined[-len(fresh) :], fresh)  # as they were
    batches.sizes.clear()
    model.learn(10)
    assert batches.sizes[0] == (3, 2)


@both
def test_target_kl_is_scaled_unless_the_user_objects(algorithm):
    batch = frozen_episodes(small_policy("discrete")[0], lengths=(3, 1, 4, 2))
    differences = np.linspace(-1.0, 1.0, batch.n_steps)

    def targets(**arguments):
        model = make(algorithm, target_kl=0.02, **arguments)
        return [
            model._update_target_kl(dataclasses.replace(batch, returns=scale * differences))
            for scale in (100.0, 2.0, 1e-9)
        ]

    expected = [0.02, 0.02 * (2.0 / (0.2 * 100.0 * 0.99)) ** 2, 0.02 * 1e-4]
    assert targets() == pytest.approx(expected)
    assert targets(scale_target_kl=False) == [0.02] * 3


@pytest.mark.parametrize("norm_reward", [False, True])
def test_returns_are_compared_in_the_units_of_the_environment(norm_reward):
    env = VecNormalize(several(2, dim=2), norm_reward=norm_reward)
    model = make(CRPN, env, target_kl=0.02)
    batch = frozen_episodes(small_policy("discrete")[0], lengths=(3, 1, 4, 2))

    def target(variance):  # of the same returns
        env.ret_rms.var = np.array(variance)
        return model._update_target_kl(batch)

    assert target(1.0) == 0.02
    shorter = 0.02 * (0.01 / (0.2 * 0.99)) ** 2
    assert target(1e-4) == pytest.approx(shorter if norm_reward else 0.02, rel=1e-3)


def test_scaling_of_the_target_can_be_turned_off():
    model = make(CRPN, target_kl=0.02)
    batch = frozen_episodes(small_policy("discrete")[0], lengths=(3, 1, 4, 2))
    model.kl_control.return_scale = 1e9
    model.scale_target_kl = False
    assert model._update_target_kl(batch) == 0.02
    model.scale_target_kl = True
    assert model._update_target_kl(batch) == pytest.approx(0.02 * 1e-4)
    assert make(CRPN, target_kl=None)._update_target_kl(batch) is None


@both
def test_the_target_of_each_update_is_logged_and_kept(algorithm):
    log = TrainLog()
    make(algorithm, Sampler(NUMBERS, spaces.Discrete(2)), target_kl=0.02).learn(200, log)
    assert log["target_kl"][0] == 0.02
    assert all(
        kl <= target for kl, target in zip(log["kl_divergence"], log["target_kl"], strict=True)
    )


def replaced(algorithm, change):
    """Return ``_update_solver`` with the solver's steps changed."""
    solver_of = algorithm._update_solver

    def changed(self, batch):
        return Changed(solver_of(self, batch), change)

    return changed


@dataclasses.dataclass
class Changed:
    solver: SubproblemSolver
    change: Callable[[torch.Tensor], torch.Tensor]

    def needs_matrix(self, dim):
        return self.solver.needs_matrix(dim)

    def solve(self, model, alpha):
        cubic = self.solver.solve(model, alpha)
        return dataclasses.replace(cubic, step=self.change(cubic.step))


@both
@METRICS
@pytest.mark.parametrize(
    ("change", "target_kl"),
    [
        (lambda step: step * float("nan"), 0.02),
        (lambda step: step * float("inf"), None),
        (lambda step: step / step.norm() * 1e30, None),
        (lambda step: -step, 0.02),
        (lambda step: step * 1e6 / step.norm(), 1e-12),
    ],
    ids=["nan", "infinite", "overflow", "uphill", "too far"],
)
def test_bad_steps_are_rejected_bitwise(algorithm, metric, change, target_kl, monkeypatch):
    model, log = make(algorithm, metric=metric, target_kl=target_kl), TrainLog()
    earlier = tensors(model)
    monkeypatch.setattr(algorithm, "_update_solver", replaced(algorithm, change))
    monkeypatch.setattr(model, "_fit_critic", lambda data: None)
    model.learn(20, log)
    assert log["step_rejected"] == [1] * len(log.rows)
    assert log["step_norm"] == log["kl_divergence"] == [0.0] * len(log.rows)
    assert same(model, earlier)
    monkeypatch.undo()
    recovered = TrainLog()
    model.learn(20, recovered, reset_num_timesteps=False)
    if target_kl == 0.02:
        assert recovered["step_rejected"] == [0]


@both
@pytest.mark.parametrize("batch_norm", [False, True])
def test_critic_leaves_what_it_shares_with_the_actor(algorithm, batch_norm, monkeypatch):
    class Features(ActorCriticPolicy):
        def _build_mlp_extractor(self):
            super()._build_mlp_extractor()
            norm = torch.nn.BatchNorm1d(8) if batch_norm else torch.nn.Tanh()
            shared = torch.nn.Sequential(torch.nn.Linear(2, 8), norm)
            self.mlp_extractor.policy_net = self.mlp_extractor.value_net = shared

    model = make(algorithm, policy=Features, net_arch=(8,), n_critic_updates=5)
    monkeypatch.setattr(
        algorithm, "_update_solver", replaced(algorithm, lambda step: step * np.nan)
    )
    observations = torch.randn(5, 2)
    values, logits = _outputs(model, observations)
    model.learn(60)
    new_values, new_logits = _outputs(model, observations)
    assert torch.equal(new_logits, logits)
    assert not torch.equal(new_values, values)


def _outputs(model, observations):
    model.policy.set_training_mode(False)
    with torch.no_grad():
        logits = model.policy.get_distribution(observations).distribution.logits
        return model.policy.predict_values(observations), logits


@pytest.mark.parametrize(
    ("settings", "fitted"),
    [
        ({}, True),
        ({"baseline": False}, True),
        ({"baseline": False, "bootstrap_truncated": False}, True),
        ({"baseline": False, "bootstrap_truncated": False, "gae_lambda": 1.0}, True),
        (
            {
                "baseline": False,
                "bootstrap_truncated": False,
                "gae_lambda": 1.0,
                "n_reused_rollouts": 0,
            },
            False,
        ),
        ({"n_critic_updates": 0}, False),
    ],
)
def test_critic_is_fitted_where_it_is_used(settings, fitted):
    model, log = make(CRPN, **settings), TrainLog()
    head = model.policy.value_net.weight.clone()
    model.learn(40, log)
    assert torch.equal(model.policy.value_net.weight, head) != fitted


SOLVERS = pytest.mark.parametrize("solver", ["dense", "krylov"])


@SOLVERS
@pytest.mark.parametrize("limit", [6.0, 40.0], ids=["fixed length", "random length"])
@pytest.mark.parametrize("alpha", [50.0, 5000.0])
@pytest.mark.parametrize("dim", [0, 2], ids=["Discrete", "Box"])
def test_paper_settings_are_algorithm_1(solver, limit, alpha, dim):
    env = DummyVecEnv([lambda: Drift(bound=1.5 if limit > 6 else np.inf, limit=limit, dim=dim)] * 2)
    model = make(CRPN, env, net_arch=[], n_episodes=6, alpha=alpha, solver=solver, **PAPER)
    theta, log = model.actor.vector, TrainLog()
    model.learn(1, log)
    gradient, hessian, lengths = paper_estimates(model, theta, model.rollout_buffer, quota=3)
    assert (len(set(lengths)) > 1) == (limit > 6)
    expected = solve_dense(gradient, hessian, alpha)
    assert expected.certified
    step = model.actor.vector - theta
    assert float((step - expected.step).norm()) <= 2e-3 * float(expected.step.norm())
    assert log["gradient_norm"] == pytest.approx([float(gradient.norm())], rel=1e-4)
    assert log["multiplier"] == pytest.approx([expected.multiplier], rel=1e-3)
    assert log["predicted_decrease"] == pytest.approx([expected.predicted_decrease], rel=1e-3)
    leftmost = float(torch.linalg.eigvalsh(hessian)[0])
    assert log["lambda_min"] == pytest.approx([leftmost], rel=1e-3, abs=1e-3)
    assert log["step_rejected"] == [0]
    assert log["hessian_shrinkage"] == [1.0]


@METRICS
def test_solvers_agree(metric):
    """Dense and Krylov steps are equal if the Krylov space is ℝᵈ."""
    steps = []
    for settings in ({"solver": "dense"}, {"solver": "krylov", "krylov_dim": 1000}):
        model = make(CRPN, net_arch=[], metric=metric, hessian_shrinkage=0.5, **settings)
        theta = model.actor.vector
        steps.append(model.learn(1).actor.vector - theta)
    assert float((steps[0] - steps[1]).norm()) <= 1e-2 * float(steps[0].norm())


@both
@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("n_envs", [None, 1, 3])
def test_estimate_curvature_leaves_all_as_it_was(algorithm, trained, n_envs):
    model = make(algorithm, several(2), n_episodes=4)
    if trained:
        model.learn(1000, lambda local, _: local["self"].num_timesteps < 50)
    place = model._last_obs
    earlier, timesteps = tensors(model), model.num_timesteps
    episodes, updates = copy.deepcopy(model.ep_info_buffer), model._n_updates
    env = several(n_envs) if n_envs else None
    estimate = model.estimate_curvature(5, env)
    d = len(model.actor)
    assert estimate.gradient_batch.n_episodes == 5
    assert estimate.gradient.shape == (d,)
    assert estimate.hessian.shape == (d, d)
    assert same(model, earlier)
    assert model.num_timesteps == timesteps
    assert model.ep_info_buffer == episodes
    assert model._n_updates == updates
    if env is not None:
        assert model._last_obs is place

    log = TrainLog()
    model.learn(60, log, reset_num_timesteps=not trained)
    assert set(log["n_episodes"]) == {4}
    assert log["used_timesteps_fraction"][-1] > 0.5


def test_estimate_curvature_on_the_training_environment_by_its_name():
    model = make(CRPN, several(1), n_episodes=2).learn(20)
    model.estimate_curvature(3, model.get_env())
    drift = model.get_env().envs[0]
    np.testing.assert_array_equal(model._last_obs, [drift._observe()])


def test_estimate_curvature_is_the_one_of_the_update():
    model = make(CRPN, Drift(), net_arch=[], **PAPER)
    estimate = model.estimate_curvature(4)
    dense = estimate.hessian.to_dense()
    vector = torch.randn(len(model.actor), dtype=torch.float64)
    assert torch.equal(dense, dense.T)
    torch.testing.assert_close(estimate.hessian @ vector, dense @ vector, rtol=1e-4, atol=1e-4)


def test_estimate_curvature_leaves_running_statistics():
    env = VecNormalize(several(2))
    model = make(CRPN, env).learn(40)
    statistics = copy.deepcopy((env.obs_rms.mean, env.obs_rms.count, env.ret_rms.count))
    model.estimate_curvature(4)
    assert env.training
    np.testing.assert_equal((env.obs_rms.mean, env.obs_rms.count, env.ret_rms.count), statistics)


def test_estimate_curvature_shows_its_episodes(capsys):
    plain = make(CRPN, several(2)).estimate_curvature(5)
    assert "episodes" not in "".join(capsys.readouterr())
    shown = make(CRPN, several(2)).estimate_curvature(5, progress_bar=True)
    assert "5/5" in "".join(capsys.readouterr())
    assert torch.equal(shown.gradient, plain.gradient)


def test_estimate_curvature_tells_of_a_missing_bar_before_it_simulates(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.rich", None)
    model = make(CRPN)
    with pytest.raises(ImportError, match="tqdm and rich"):
        model.estimate_curvature(2, progress_bar=True)
    assert model._last_obs is None


class Estimate(BaseCallback):
    def __init__(self, hook, env=None):
        super().__init__()
        self.env, self.gradients = env, []
        setattr(self, hook, self.estimate)

    def estimate(self):
        self.gradients.append(self.model.estimate_curvature(2, self.env).gradient)
        return True

    def _on_step(self):
        return True


@both
def test_estimate_curvature_in_mid_rollout(algorithm):
    """In mid-rollout another environment is needed. Between rollouts any environment is allowed."""
    with pytest.raises(RuntimeError, match="env="):
        make(algorithm).learn(30, Estimate("_on_step"))
    for callback in (Estimate("_on_step", several(2)), Estimate("_on_rollout_end")):
        log = TrainLog()
        model = make(algorithm, n_episodes=3).learn(30, [callback, log])
        assert callback.gradients
        assert sum(model.env.get_attr("total")) >= model.num_timesteps
        assert set(log["n_episodes"]) == {3}


def test_paper_is_a_set_of_arguments():
    for algorithm in (CRPN, ACRPN):
        model = make(algorithm, **PAPER)
        assert {name: getattr(model, name) for name in PAPER} == PAPER
        assert not model.uses_critic
