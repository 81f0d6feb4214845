"""The contract of a Stable-Baselines3 algorithm: spaces, policies, wrappers, callbacks, files."""

from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.envs import (
    FakeImageEnv,
    IdentityEnv,
    IdentityEnvBox,
    IdentityEnvMultiBinary,
    IdentityEnvMultiDiscrete,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from torch import nn

from sb3_crpn import ACRPN, CRPN
from sb3_crpn.vec_env import GymnasiumVecEnv
from tests.envs import Drift, Sampler
from tests.training import TrainLog, all_finite, both, make, monitored, same, several, tensors

IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
OBSERVATIONS = {
    "Box": spaces.Box(-1.0, 1.0, (3,)),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
    "Dict": spaces.Dict({"vec": spaces.Box(-1.0, 1.0, (2,)), "kind": spaces.Discrete(3)}),
    "image, channels last": IMAGE,
    "image, channels first": spaces.Box(0, 255, (1, 36, 36), np.uint8),
    "Dict with image": spaces.Dict({"img": IMAGE, "vec": spaces.Box(-1.0, 1.0, (2,))}),
}
ACTIONS = {
    "Box": spaces.Box(-1.0, 1.0, (2,)),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(2),
}


class OwnPolicy(ActorCriticPolicy):
    """Nothing of it is called as SB3 calls it, and the critic hears the actor's features."""

    def _build(self, lr_schedule):
        self.mlp_extractor = nn.Identity()
        self.mlp_extractor.latent_dim_pi = self.mlp_extractor.latent_dim_vf = self.features_dim
        super()._build(lr_schedule)

    def _build_mlp_extractor(self):
        width = self.features_dim

        class Trunk(nn.Module):
            latent_dim_pi = latent_dim_vf = 4

            def __init__(self):
                super().__init__()
                self.value_of_names = nn.Sequential(nn.Linear(width, 4), nn.Tanh())

            def forward_actor(self, features):
                return self.value_of_names(features)

            forward_critic = forward_actor

            def forward(self, features):
                return self.forward_actor(features), self.forward_critic(features)

        self.mlp_extractor = Trunk()


class OwnFeatures(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=4)
        size = spaces.flatdim(observation_space)
        self.layers = nn.Sequential(nn.Flatten(), nn.Linear(size, 4), nn.BatchNorm1d(4), nn.Tanh())

    def forward(self, observations):
        return self.layers(observations)


OWN_FEATURES = {"features_extractor_class": OwnFeatures}


def policy_for(observation_space):
    if isinstance(observation_space, spaces.Dict):
        kwargs = {"cnn_output_dim": 8} if "img" in observation_space.spaces else {}
        return "MultiInputPolicy", {"features_extractor_kwargs": kwargs}
    if len(observation_space.shape) == 3:
        return "CnnPolicy", {"features_extractor_kwargs": {"features_dim": 8}}
    return "MlpPolicy", {}


def trains(model, timesteps=24):
    """Train for some updates, and assert that actor and critic have changed."""
    theta, earlier = model.actor.vector, tensors(model)
    model.learn(timesteps)
    now = model.policy.state_dict()
    assert model._n_updates > 0
    assert all_finite(model)
    assert not torch.equal(model.actor.vector, theta)
    assert any(not torch.equal(now[k], earlier[k]) for k in earlier if k.startswith("value_net"))
    return model


@pytest.mark.parametrize("actions", ACTIONS)
@pytest.mark.parametrize("observations", OBSERVATIONS)
def test_spaces(observations, actions):
    env = Sampler(OBSERVATIONS[observations], ACTIONS[actions])
    policy, kwargs = policy_for(OBSERVATIONS[observations])
    number = list(OBSERVATIONS).index(observations) + list(ACTIONS).index(actions)
    algorithm = (CRPN, ACRPN)[number % 2]
    settings = {"n_steps": 8, "krylov_dim": 4, "policy_kwargs": kwargs}
    model = trains(make(algorithm, env, policy=policy, **settings), timesteps=16)
    action, _ = model.predict(env.reset(seed=1)[0])
    assert env.action_space.contains(action)


@both
@pytest.mark.parametrize("share", [True, False])
@pytest.mark.parametrize(
    ("policy", "kwargs"),
    [("MlpPolicy", {}), ("MlpPolicy", OWN_FEATURES), (OwnPolicy, {}), (OwnPolicy, OWN_FEATURES)],
)
def test_policies(algorithm, policy, kwargs, share):
    kwargs = kwargs | {"share_features_extractor": share}
    trains(make(algorithm, policy=policy, policy_kwargs=kwargs))


@both
@pytest.mark.parametrize("own", [True, False])
def test_fake_images(algorithm, own):
    kwargs = OWN_FEATURES if own else {"features_extractor_kwargs": {"features_dim": 8}}
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1)
    model = make(algorithm, env, policy="CnnPolicy", policy_kwargs=kwargs, horizon=5, krylov_dim=4)
    model.learn(64)
    assert all_finite(model)


@both
@pytest.mark.parametrize("squash_output", [True, False])
@pytest.mark.parametrize("sde_sample_freq", [-1, 3])
def test_gsde(algorithm, squash_output, sde_sample_freq):
    env = several(2, dim=2)
    for wrapped in env.envs:
        wrapped.action_space = spaces.Box(-2.0, 2.0, (2,))
    env.action_space = env.envs[0].action_space
    model = make(
        algorithm,
        env,
        use_sde=True,
        sde_sample_freq=sde_sample_freq,
        policy_kwargs={"squash_output": squash_output},
    )
    log = TrainLog()
    trains(model).learn(100, log)
    assert np.all(np.array(log["kl_divergence"]) <= model.target_kl)
    assert min(log["std"]) > 0


@both
def test_vec_normalize(algorithm, tmp_path):
    env = VecNormalize(VecMonitor(several()))
    model = trains(make(algorithm, env))
    assert np.mean([e["l"] for e in model.ep_info_buffer]) > 1
    evaluate_policy(model, env, 3)
    model.save(tmp_path / "model")
    assert not same(make(algorithm, several()), tensors(model))
    assert same(algorithm.load(tmp_path / "model", env=env, device="cpu"), tensors(model))


@both
def test_environments_that_forbid_early_resets(algorithm):
    env = DummyVecEnv(
        [lambda limit=limit: Monitor(Drift(limit=limit), None, False) for limit in (3, 5, 12)]
    )
    log = TrainLog()
    model = make(algorithm, env, n_episodes=4).learn(150, log)
    assert len(log.rows) > 2
    assert set(log["n_episodes"]) == {4}
    assert min(log["used_timesteps_fraction"]) < 1.0
    assert model.ep_info_buffer


@both
@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
def test_gymnasium_vector_environments(algorithm, mode):
    env = gym.make_vec("CartPole-v1", num_envs=3, vectorization_mode=mode)
    model = trains(make(algorithm, GymnasiumVecEnv(env)), timesteps=400)
    assert {e["r"] == e["l"] for e in model.ep_info_buffer} == {True}


IDENTITY = {
    "Discrete": partial(IdentityEnv, 4),
    "MultiDiscrete": partial(IdentityEnvMultiDiscrete, 3),
    "MultiBinary": partial(IdentityEnvMultiBinary, 2),
    "Box": partial(IdentityEnvBox, eps=0.5),
}


@both
@pytest.mark.parametrize("kind", IDENTITY)
def test_identity(algorithm, kind):
    env = DummyVecEnv([IDENTITY[kind]] * 4)
    for seed, identity in enumerate(env.envs):
        identity.action_space.seed(seed)
    model = make(algorithm, env, n_episodes=4, gamma=0.0, target_kl=0.05, net_arch=[16])
    model.learn(6000)
    evaluate_policy(model, VecMonitor(env), 4, reward_threshold=90)


@both
def test_drift_is_a_proper_environment_and_is_learnt(algorithm):
    check_env(Drift())
    env = several(4)
    model = make(algorithm, env, n_episodes=8, target_kl=0.1)
    first = evaluate_policy(model, VecMonitor(env), 4)[0]
    last = evaluate_policy(model.learn(2000), VecMonitor(env), 4)[0]
    assert last > first + 1.0


class Hooks(BaseCallback):
    def __init__(self):
        super().__init__()
        self.calls = []

    def _on_training_start(self):
        self.calls.append("training starts")

    def _on_rollout_start(self):
        self.calls.append("rollout starts")

    def _on_step(self):
        assert {"infos", "dones", "rewards", "new_obs", "actions"} <= self.locals.keys()
        self.steps = self.num_timesteps
        return True

    def _on_rollout_end(self):
        assert self.locals["rollout_buffer"].lengths.sum() > 0
        self.calls.append(f"rollout {self.num_timesteps} ends")

    def _on_training_end(self):
        self.calls.append("training ends")


@both
def test_hooks_and_timesteps(algorithm):
    env, hooks = several(), Hooks()
    model = make(algorithm, env)
    assert model.learn(200, hooks) is model
    assert hooks.calls[0] == "training starts"
    assert hooks.calls[-1] == "training ends"
    assert hooks.calls[1:-1:2] == ["rollout starts"] * model._n_updates
    assert all(call.endswith("ends") for call in hooks.calls[2:-1:2])
    assert hooks.calls[-2] == f"rollout {model.num_timesteps} ends"
    assert hooks.steps == model.num_timesteps >= 200
    assert sum(drift.total for drift in env.envs) == model.num_timesteps


class StopAt(BaseCallback):
    def __init__(self, step):
        super().__init__()
        self.step = step

    def _on_step(self):
        return self.num_timesteps < self.step


@both
@pytest.mark.parametrize(
    ("arguments", "simulated", "learnt_from"),
    [
        ({"n_steps": 40}, 20 + 80, 8),  # two episodes tell how long they are
        ({"n_steps": 12}, 20, 2),  # which is what was wanted anyway
        ({"n_episodes": 8}, 80, 8),  # nobody asks
    ],
)
def test_the_first_update_learns_from_as_much_as_the_others(
    algorithm, arguments, simulated, learnt_from
):
    log, hooks = TrainLog(), Hooks()
    env = several(2, bound=np.inf, limit=10)
    model = make(algorithm, env, **arguments).learn(1, [log, hooks])
    assert model.num_timesteps == simulated
    assert log["n_episodes"] == [learnt_from]
    assert log["used_timesteps_fraction"] == [1.0]
    assert hooks.calls[1:-1] == ["rollout starts", f"rollout {simulated} ends"]
    model.learn(1, log, reset_num_timesteps=False)
    assert log["n_episodes"][1] == learnt_from


@both
def test_stopped_while_the_length_of_episodes_is_found_out(algorithm):
    model = make(algorithm, several(2, bound=np.inf, limit=10), n_steps=40)
    before = tensors(model)
    model.learn(1000, StopAt(10))
    assert model.num_timesteps == 10
    assert same(model, before)
    log = TrainLog()
    model.learn(1, log, reset_num_timesteps=False)
    assert log["n_episodes"] == [8]


@both
@pytest.mark.parametrize("early_resets", [True, False])
def test_stopped_in_mid_rollout_and_continued(algorithm, early_resets):
    env = monitored(2, early_resets=early_resets)
    model = make(algorithm, env, n_episodes=6)
    model.learn(1000, StopAt(70))
    assert model.num_timesteps == 70
    theta, updates, hooks = model.actor.vector, model._n_updates, Hooks()
    model.learn(100, hooks, reset_num_timesteps=False)
    assert model.num_timesteps >= 170
    assert model._n_updates > updates
    assert not torch.equal(model.actor.vector, theta)
    assert sum(drift.unwrapped.total for drift in env.envs) == model.num_timesteps


@both
def test_evaluations(algorithm, tmp_path):
    callback = EvalCallback(
        monitored(),
        n_eval_episodes=2,
        eval_freq=20,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
    )
    make(algorithm).learn(100, callback)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert list(evaluations["timesteps"][:4]) == [20, 40, 60, 80]
    assert np.isfinite(evaluations["results"]).all()
    trains(algorithm.load(tmp_path / "best_model", env=Drift(), device="cpu"))


@both
def test_checkpoints(algorithm, tmp_path):
    model = make(algorithm).learn(60, CheckpointCallback(10, str(tmp_path)))
    files = sorted(path.name for path in tmp_path.iterdir())
    assert len(files) == model.num_timesteps // 10
    loaded = algorithm.load(tmp_path / "rl_model_50_steps", env=Drift(), device="cpu")
    assert loaded.num_timesteps == 50
    trains(loaded)


def test_stops():
    by_episodes = make(CRPN, several()).learn(10_000, StopTrainingOnMaxEpisodes(5))
    assert by_episodes.num_timesteps < 300
    stop = StopTrainingOnRewardThreshold(-1e6, verbose=0)
    evaluation = EvalCallback(monitored(), stop, eval_freq=20, verbose=0)
    by_reward = make(CRPN).learn(10_000, evaluation)
    assert by_reward.num_timesteps == 20


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_progress_bar():
    assert make(CRPN).learn(40, progress_bar=True)._n_updates > 0


LOGGED = {
    "gradient_norm",
    "step_norm",
    "alpha",
    "kl_divergence",
    "multiplier",
    "predicted_decrease",
    "lambda_min",
    "confirmed_lambda_min",
    "hessian_vector_products",
    "step_rejected",
    "hessian_shrinkage",
    "gradient_noise",
    "value_loss",
    "explained_variance",
    "n_episodes",
    "used_timesteps_fraction",
    "n_updates",
    "n_trials",
    "certified",
    "kl_divergence_loss",
    "policy_objective",
    "is_line_search_success",
}


@both
@pytest.mark.parametrize("dim", [0, 2])
@pytest.mark.parametrize("settings", [{}, {"metric": "euclidean"}, {"target_kl": None}])
def test_logged_quantities(algorithm, dim, settings):
    log = TrainLog()
    make(algorithm, Drift(dim=dim), n_episodes=4, **settings).learn(200, log)
    expected = LOGGED | {"std"} if dim else LOGGED
    for row in log.rows:
        assert expected <= row.keys()
        assert np.isfinite([row[key] for key in expected]).all()
        assert row["n_episodes"] == 4
        assert row["used_timesteps_fraction"] == 1.0
        assert row["step_rejected"] in (0, 1)
        assert row["kl_divergence_loss"] == row["kl_divergence"]
        assert row["is_line_search_success"] == 1 - row["step_rejected"]
        assert row["multiplier"] >= 0
        assert row["alpha"] > 0
        assert 0 <= row["hessian_shrinkage"] <= 1
        assert row["kl_divergence"] >= -1e-9
    assert log["n_updates"] == list(range(1, len(log.rows) + 1))
    assert ("std" in log.rows[0]) == bool(dim)


def test_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    make(CRPN, tensorboard_log=str(tmp_path)).learn(100)
    make(ACRPN, tensorboard_log=str(tmp_path)).learn(100, tb_log_name="other")
    assert {path.name for path in tmp_path.iterdir()} == {"CRPN_1", "other_1"}
    events = accumulator.EventAccumulator(str(tmp_path / "CRPN_1"))
    events.Reload()
    # SB3 keeps n_updates, which counts the steps of the curves, out of TensorBoard
    wanted = {f"train/{key}" for key in LOGGED - {"n_updates"}} | {"rollout/ep_rew_mean"}
    assert wanted <= set(events.Tags()["scalars"])


PER_UPDATE = {"n_episodes": 4, "net_arch": [8]}
SAVED = [
    {},
    {"metric": "euclidean", "krylov_dim": 5},
    {"target_kl": None, "alpha": 50.0, "n_hessian_episodes": 2},
    {"n_episodes": None, "n_steps": 20, "learning_rate": lambda progress: 1e-3 * progress},
]


def trajectory(algorithm, learn, **settings):
    """Train a new model with ``learn`` and return it with its state."""
    model = make(algorithm, several(2, dim=2), **(PER_UPDATE | settings))
    model = learn(model)
    optimizer = model.policy.optimizer.state_dict()["state"]
    moments = [value for state in optimizer.values() for value in state.values()]
    return model, tensors(model), moments


@both
@pytest.mark.parametrize("settings", SAVED)
def test_loaded_model_goes_on_as_if_it_had_not_stopped(algorithm, settings, tmp_path):
    def uninterrupted(model):
        return model.learn(60).learn(60, reset_num_timesteps=False)

    def interrupted(model):
        model.learn(60).save(tmp_path / "model")
        loaded = algorithm.load(tmp_path / "model", env=several(2, dim=2), device="cpu")
        torch.rand(7)
        return loaded.learn(60, reset_num_timesteps=False)

    first, parameters, moments = trajectory(algorithm, uninterrupted, **settings)
    second, _, same_moments = trajectory(algorithm, interrupted, **settings)
    assert second.num_timesteps == first.num_timesteps
    assert second._n_updates == first._n_updates > 2
    assert same(second, parameters)
    assert all(torch.equal(a, b) for a, b in zip(moments, same_moments, strict=True))
    assert second.kl_control == first.kl_control
    assert second.rollouts.mean_episode_length == first.rollouts.mean_episode_length
    assert second._rng.random() == first._rng.random()


def test_files_of_the_first_version_go_on(tmp_path):
    """They hold what is now in ``rollouts`` as attributes of the model."""
    model = make(CRPN, several(2, dim=2), n_steps=20).learn(60)
    flat = {f"_{name}": value for name, value in vars(model.rollouts).items()}
    vars(model).update(flat)
    model.save(tmp_path / "model", exclude=["rollouts"])
    loaded = CRPN.load(tmp_path / "model", env=several(2, dim=2), device="cpu")
    assert flat.keys().isdisjoint(vars(loaded))
    assert loaded.rollouts.mean_episode_length == model.rollouts.mean_episode_length
    assert np.array_equal(loaded.rollouts.trajectory_times, model.rollouts.trajectory_times)


@both
def test_seeds(algorithm):
    def learn(model):
        return model.learn(60)

    _, parameters, _ = trajectory(algorithm, learn, seed=3)
    torch.rand(5)
    assert same(trajectory(algorithm, learn, seed=3)[0], parameters)
    assert not same(trajectory(algorithm, learn, seed=4)[0], parameters)


@both
def test_load_for_use(algorithm, tmp_path):
    model = make(algorithm, several(2)).learn(60)
    model.save(tmp_path / "model")
    observations = np.random.default_rng(0).normal(size=(5, 2)).astype(np.float32)
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    assert loaded.get_env() is None
    assert torch.equal(loaded.actor.vector, model.actor.vector)
    with pytest.raises(ValueError, match="env"):
        loaded.estimate_curvature(2)
    loaded.set_env(several(2))
    trains(loaded)


@both
def test_load_with_another_number_of_environments(algorithm, tmp_path):
    make(algorithm, several(2), n_episodes=5).learn(60).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=several(3), device="cpu")
    log = TrainLog()
    loaded.learn(100, log, reset_num_timesteps=False)
    assert set(log["n_episodes"]) == {5}


@both
def test_load_as_rl_zoo_does_to_enjoy(algorithm, tmp_path):
    make(algorithm).learn(40).save(tmp_path / "model")
    objects = {"learning_rate": 0.0, "lr_schedule": lambda _: 0.0, "clip_range": lambda _: 0.0}
    loaded = algorithm.load(tmp_path / "model", Drift(), "cpu", objects, seed=0, buffer_size=1)
    assert evaluate_policy(loaded, Monitor(Drift()), 2)[0] != 0


@both
def test_set_parameters(algorithm):
    trained, other = make(algorithm).learn(60), make(algorithm, seed=1)
    other.set_parameters(trained.get_parameters())
    assert same(other, tensors(trained))
    assert torch.equal(other.actor.vector, trained.actor.vector)
    trains(other)
    with pytest.raises(ValueError, match="policy"):
        other.set_parameters({})


@both
@pytest.mark.parametrize("damage", ["truncated", "text", "foreign"])
def test_files_that_are_no_models(algorithm, damage, tmp_path):
    """The errors are those of SB3's own algorithms."""
    path = Path(tmp_path / "model.zip")
    make(algorithm).save(path)
    content = path.read_bytes()
    if damage == "foreign":
        np.savez(path.with_suffix(""), weights=np.zeros(3))
        path.with_suffix(".npz").replace(path)
    else:
        path.write_bytes(content[: len(content) // 2] if damage == "truncated" else b"a text")
    with pytest.raises(Exception) as expected:  # noqa: PT011 whatever SB3 raises
        PPO.load(path, device="cpu")
    with pytest.raises(type(expected.value)) as error:
        algorithm.load(path, device="cpu")
    assert str(error.value) == str(expected.value)


@both
def test_models_of_other_algorithms_are_refused(algorithm, tmp_path):
    PPO("MlpPolicy", Drift(), device="cpu").save(tmp_path / "ppo")
    with pytest.raises(ValueError, match="EpisodeRolloutBuffer"):
        algorithm.load(tmp_path / "ppo", device="cpu")
