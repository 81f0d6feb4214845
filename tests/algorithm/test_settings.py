import inspect
import re

import numpy as np
import pytest
import torch
from sb3_contrib import TRPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback

import sb3_crpn
from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from tests.envs import Drift
from tests.training import both, make, same, tensors

NAN, INF = float("nan"), float("inf")
FLAG = ("yes", 1, None, NAN)
FRACTION = ("1", None, True, -0.1, 1.1, NAN, INF)
POSITIVE = ("1", None, True, 0.0, -1.0, NAN, INF)
COUNT = ("3", True, 0, -2, 1.5, NAN, INF, [4])
BAD = {
    "learning_rate": ("1", None, True, -1e-3, NAN, INF),
    "n_steps": (*COUNT, None),
    "rollout": ("steps", None, 3, ["episodes"]),
    "n_episodes": COUNT,
    "n_hessian_episodes": COUNT,
    "alpha": POSITIVE,
    "target_kl": tuple(value for value in POSITIVE if value is not None),
    "scale_target_kl": FLAG,
    "metric": ("natural", None, 1, NAN, "Fisher"),
    "fisher_damping": POSITIVE,
    "hessian_estimator": ("dice", None, 0, NAN),
    "hessian_lambda": FRACTION,
    "hessian_shrinkage": ("half", True, -0.1, 1.1, NAN, INF),
    "krylov_dim": COUNT,
    "gamma": FRACTION,
    "gae_lambda": FRACTION,
    "baseline": FLAG,
    "normalize_advantage": FLAG,
    "discount_visitation": FLAG,
    "bootstrap_truncated": FLAG,
    "horizon": COUNT,
    "batch_size": (*COUNT, None),
    "n_reused_rollouts": ("3", None, True, -1, 1.5, NAN),
    "n_critic_updates": ("3", None, True, -1, 1.5, NAN),
    "max_batch_timesteps": COUNT,
    "use_sde": FLAG,
    "sde_sample_freq": ("3", None, True, -2, 1.5, NAN),
    "rollout_buffer_class": (dict, "EpisodeRolloutBuffer", 1),
    "rollout_buffer_kwargs": (5, "x", [1]),
    "stats_window_size": (*COUNT, None),
    "tensorboard_log": (5, ["log"]),
    "policy_kwargs": (5, "x", [1]),
    "verbose": ("loud", None, -1, 1.5, 3),
    "seed": ("0", -1, 1.5, NAN, True, 2**32),
    "device": ("nope", 5, None),
}
BAD_CRPN = {"solver": ("lanczos", None, 1, NAN)}
BAD_ACRPN = {
    "gradient_lipschitz": ("big", None, True, 0.0, -1.0, NAN, INF),
    "sosp_epsilon": POSITIVE,
    "subsolver_steps": COUNT,
    "stop_at_sosp": FLAG,
}
CASES = [
    (algorithm, name, value)
    for algorithm, own in ((CRPN, BAD_CRPN), (ACRPN, BAD_ACRPN))
    for name, values in (BAD | own).items()
    for value in values
]


@pytest.mark.parametrize(("algorithm", "name", "value"), CASES, ids=lambda case: str(case)[-30:])
def test_bad_values_are_named_with_what_is_allowed(algorithm, name, value):
    with pytest.raises(ValueError, match="must be") as error:
        algorithm("MlpPolicy", Drift(dim=2), **{"device": "cpu", name: value})
    assert f"{name}={value!r}" in str(error.value)


@both
def test_every_argument_is_in_the_table(algorithm):
    own = BAD_CRPN if algorithm is CRPN else BAD_ACRPN
    names = inspect.signature(algorithm).parameters.keys()
    assert names - {"policy", "env", "_init_setup_model"} == BAD.keys() | own.keys()


@both
@pytest.mark.parametrize("policy", ["Nope", None, 5, dict])
def test_bad_policies(algorithm, policy):
    with pytest.raises(ValueError, match=r"(?i)policy"):
        algorithm(policy, Drift(), device="cpu")


@both
@pytest.mark.parametrize("env", [None, 5])
def test_bad_environments(algorithm, env):
    with pytest.raises(ValueError, match=r"(?i)env"):
        algorithm("MlpPolicy", env, device="cpu")


@both
def test_unknown_arguments(algorithm):
    class Derived(algorithm):
        pass

    with pytest.raises(TypeError, match=r"^Derived has no argument clip_range: target_kl bounds"):
        Derived("MlpPolicy", Drift(), clip_range=0.2)
    with pytest.raises(TypeError, match=r"argument clip_range: .*; ent_coef: there is no entropy"):
        algorithm("MlpPolicy", Drift(), clip_range=0.2, ent_coef=0.01)
    with pytest.raises(TypeError, match=r"has no argument taget_kl: did you mean target_kl\?"):
        algorithm("MlpPolicy", Drift(), taget_kl=0.2)
    with pytest.raises(TypeError, match=r"no argument xyz: help\(.*\) lists them"):
        algorithm("MlpPolicy", Drift(), xyz=1)
    with pytest.raises(TypeError, match="env"):
        algorithm("MlpPolicy")


@both
@pytest.mark.parametrize("other", [PPO, A2C, TRPO])
def test_arguments_of_other_algorithms_are_there_or_named(algorithm, other):
    """A positional argument that SB3 has too has the same position."""
    theirs, ours = (inspect.signature(cls).parameters for cls in (other, algorithm))
    assert theirs.keys() - ours.keys() <= algorithm.replacements.keys()
    for name in theirs.keys() - ours.keys():
        with pytest.raises(TypeError, match=f"^{algorithm.__name__} has no argument {name}: ") as e:
            algorithm("MlpPolicy", Drift(), **{name: theirs[name].default})
        assert algorithm.replacements[name] in str(e.value)
    assert list(theirs)[:4] == list(ours)[:4]
    with pytest.raises(TypeError, match="arguments after n_steps must be given by name"):
        algorithm("MlpPolicy", Drift(), 1e-3, 64, 128)


@both
def test_replacements_exist_or_are_none_of_ours(algorithm):
    arguments = inspect.signature(algorithm).parameters
    assert algorithm.replacements.keys().isdisjoint(arguments)
    for advice in algorithm.replacements.values():
        words = re.findall(r"(?<=use )[a-z_]+", advice)
        assert set(words) <= arguments.keys()


@both
def test_every_argument_is_documented(algorithm):
    for name in inspect.signature(algorithm).parameters:
        assert re.search(rf"^{name}\n    \S", algorithm.__doc__, re.MULTILINE)
    assert "{parameters}" not in algorithm.__doc__


SCALARS = {
    "alpha": (np.float32(2), np.array(2.0), torch.tensor(2.0)),
    "learning_rate": (np.float32(0.5), np.array(0.5), torch.tensor(0.5)),
    "seed": (np.int64(3), np.array(3), torch.tensor(3)),
    "n_reused_rollouts": (np.int64(2), np.array(2), torch.tensor(2)),
    "stats_window_size": (np.int64(5), np.array(5), torch.tensor(5)),
    "n_episodes": (np.int64(3), np.array(3), torch.tensor(3)),
    "baseline": (np.bool_(False), np.array(False), torch.tensor(False)),
    "metric": (np.str_("fisher"), np.array("euclidean")),
}


@both
@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in SCALARS.items() for value in values]
)
def test_scalars_are_taken_as_pythons(algorithm, name, value, tmp_path):
    model = make(algorithm, **{name: value}).learn(40)
    attribute = {"stats_window_size": "_stats_window_size"}.get(name, name)
    kept = getattr(model, attribute)
    assert type(kept) in (int, float, bool, str)
    assert kept == value.item()
    model.save(tmp_path / "model")
    assert getattr(algorithm.load(tmp_path / "model"), attribute) == kept


ARRAYS = (np.array([1.0, 2.0]), np.array(["fisher", "causal"]), torch.ones(2))


@both
@pytest.mark.parametrize("value", ARRAYS, ids=str)
def test_arrays_are_refused_by_name(algorithm, value):
    for name in inspect.signature(algorithm).parameters.keys() - {"env"}:
        with pytest.raises(ValueError, match=f"^{algorithm.__name__}: {name}="):
            algorithm(**{"policy": "MlpPolicy", "env": Drift(), "device": "cpu", name: value})


def test_recurrent_policies_are_refused():
    allowed = "must be .* a feed-forward subclass of ActorCriticPolicy"
    for policy in (RecurrentActorCriticPolicy, MaskableActorCriticPolicy):
        with pytest.raises(ValueError, match=allowed):
            CRPN(policy, Drift(), device="cpu")


@both
def test_policies_are_exported(algorithm):
    for name in ("MlpPolicy", "CnnPolicy", "MultiInputPolicy"):
        assert getattr(sb3_crpn, name) is algorithm.policy_aliases[name]
    algorithm(sb3_crpn.MlpPolicy, Drift(), device="cpu")


def test_one_algorithm_does_not_take_the_others_arguments():
    with pytest.raises(TypeError, match="sosp_epsilon"):
        CRPN("MlpPolicy", Drift(), sosp_epsilon=0.1)
    with pytest.raises(TypeError, match="solver"):
        ACRPN("MlpPolicy", Drift(), solver="dense")


@both
def test_signature_lists_all_arguments_with_their_defaults(algorithm):
    signature = inspect.signature(algorithm)
    inherited = dict(inspect.signature(PolicyNewtonAlgorithm).parameters)
    assert list(signature.parameters)[: len(inherited)] == list(inherited)
    own = {"solver"} if algorithm is CRPN else BAD_ACRPN.keys()
    assert signature.parameters.keys() == inherited.keys() | own
    assert PAPER.keys() < signature.parameters.keys()
    model = make(algorithm)
    for name in signature.parameters.keys() - {"env", "policy", "device", "_init_setup_model"}:
        assert hasattr(model, name) or hasattr(model, f"_{name}")


@both
def test_numbers_of_numpy_and_positions_are_taken(algorithm):
    model = make(
        algorithm,
        n_steps=np.int64(16),
        gamma=np.float32(0.5),
        baseline=np.bool_(True),
        n_episodes=np.int32(2),
        alpha=2,
        hessian_shrinkage=1,
        krylov_dim=3,
    )
    model.learn(20)
    by_position = algorithm("MlpPolicy", Drift(), 0.5, 64, device="cpu")
    assert by_position.learning_rate == 0.5
    assert by_position.n_steps == 64


@both
def test_setting_up_later_checks_later(algorithm):
    model = make(algorithm, _init_setup_model=False)
    model.gamma = 2.0
    with pytest.raises(ValueError, match=r"gamma=2\.0"):
        model._setup_model()


@both
@pytest.mark.parametrize("n_episodes", [0, 1.5, "2", None])
def test_estimate_curvature_checks_its_argument(algorithm, n_episodes):
    with pytest.raises(ValueError, match="n_episodes"):
        make(algorithm).estimate_curvature(n_episodes)


@both
@pytest.mark.parametrize(
    ("name", "value"),
    [
        (name, value)
        for name in ("alpha", "n_episodes", "learning_rate")
        for value in (NAN, -1.0, "1")
    ],
)
def test_schedules_with_bad_values(algorithm, name, value):
    """A schedule is checked when it is called. The policy is then unchanged."""
    model = make(algorithm, target_kl=None, **{name: lambda left: 1.0 if left > 0.9 else value})
    before = None

    class Keep(BaseCallback):
        def _on_step(self):
            nonlocal before
            before = tensors(model)
            return True

    message = rf"^{algorithm.__name__}: {name}\(0\.\d+\)={value!r} is not allowed, must be a finite"
    with pytest.raises(ValueError, match=message):
        model.learn(500, Keep())
    # numbers of episodes are checked before the next rollout, the others before the update
    assert model._n_updates > 0 if name == "n_episodes" else same(model, before)


@both
def test_a_learning_rate_that_begins_badly(algorithm):
    with pytest.raises(ValueError, match=r"learning_rate\(1\)=-1"):
        make(algorithm, learning_rate=lambda _: -1)


@both
def test_krylov_dim_beyond_the_number_of_parameters(algorithm):
    """A basis of ℝᵈ has at most d vectors."""
    large, exact = (
        make(algorithm, net_arch=[], krylov_dim=dim).learn(60)
        for dim in (10**12, len(make(algorithm, net_arch=[]).actor))
    )
    assert torch.equal(large.actor.vector, exact.actor.vector)
