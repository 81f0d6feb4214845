"""The constructor arguments that CRPN and ACRPN have in common."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import KW_ONLY, InitVar, dataclass, field
from typing import Any, ClassVar

import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import get_device

from sb3_crpn.algorithm.declaration import described, setting
from sb3_crpn.checks import (
    COUNT,
    DICT,
    FLAG,
    FRACTION,
    NONE,
    PATH,
    POSITIVE,
    SCHEDULE,
    SEED,
    VERBOSE,
    Check,
    integer,
    real,
    requires,
)
from sb3_crpn.curvature import (
    HESSIAN_ESTIMATORS,
    METRICS,
    SHRINKAGES,
    HessianEstimator,
    Metric,
    Shrinkage,
)
from sb3_crpn.episodes import TRACKERS, EpisodeRolloutBuffer, Tracker


def _is_policy(value: object) -> bool:
    """Whether SB3 may know the name, or the class is an actor-critic without recurrent state."""
    if not isinstance(value, type):
        return isinstance(value, str)
    if not issubclass(value, ActorCriticPolicy):
        return False
    methods: list[Callable[..., Any]] = [value.forward, value.evaluate_actions]
    return not any("lstm_states" in inspect.signature(method).parameters for method in methods)


def _is_device(value: object) -> bool:
    if not isinstance(value, str | torch.device):
        return False
    try:
        get_device(value)
    except RuntimeError:
        return False
    return True


def _is_buffer_class(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, EpisodeRolloutBuffer)


_POLICY = requires(
    '"MlpPolicy", "CnnPolicy", "MultiInputPolicy" or a feed-forward subclass of ActorCriticPolicy',
    _is_policy,
)
_ENV = requires("an environment or a registered id", lambda value: value is not None)
_TRACKER = requires(
    '"episodes", "timesteps" or a class of Tracker',
    lambda value: value in TRACKERS if isinstance(value, str) else callable(value),
)
_DEVICE = requires('"auto" or a device of PyTorch', _is_device)
_BUFFER = requires("a subclass of EpisodeRolloutBuffer", _is_buffer_class)
LEARNING_RATE = real(0.0)


@dataclass(frozen=True)
class CheckedSchedule:
    """A schedule, or a constant, whose values are checked as they come.

    Attributes
    ----------
    name
        "Name of the class: name of the argument", for messages.
    value
        A number, or a function of the progress that remains, from 1 to 0.
    check
        Of the values.
    """

    name: str
    value: float | Schedule
    check: Check

    def __call__(self, progress: float) -> float:
        """Return the value, or raise ValueError naming schedule, progress and value."""
        value = self.value(progress) if callable(self.value) else self.value
        checked: float = self.check(f"{self.name}({progress:g})", value)
        return checked


def checked_schedule(model: object, name: str, check: Check) -> CheckedSchedule:
    """Return the argument ``name`` of ``model`` as a schedule."""
    return CheckedSchedule(f"{type(model).__name__}: {name}", getattr(model, name), check)


@dataclass(init=False, eq=False, repr=False)
class PolicyNewtonSettings:
    """What the constructors take; see :class:`~sb3_crpn.algorithm.PolicyNewtonAlgorithm`.

    Arguments that SB3 keeps under another name or in another form are ``InitVar``.
    """

    policy: InitVar[str | type[ActorCriticPolicy]] = field(
        metadata=described(
            _POLICY,
            '"MlpPolicy", "CnnPolicy", "MultiInputPolicy" or an ``ActorCriticPolicy`` class.',
        )
    )
    env: InitVar[GymEnv | str] = field(
        metadata=described(_ENV, "Environment, vectorised environment or registered id.")
    )
    learning_rate: float | Schedule = setting(
        LEARNING_RATE | SCHEDULE,
        "The critic's, a float or a schedule. The actor has none: its step is the cubic model's.",
        1e-3,
    )
    n_steps: int = setting(
        COUNT,
        "Timesteps per environment and update. Whole episodes meet it as a target, at the mean "
        "length of the last update's (at least one per environment). Before the first update one "
        "episode of each environment tells the length, and is not learnt from if more are to be "
        "run.",
        512,
    )
    _: KW_ONLY
    rollout: str | Callable[[], Tracker] = setting(
        _TRACKER,
        '"episodes": whole episodes, without length bias, and the paper\'s; "timesteps": SB3\'s '
        "``n_steps`` of each environment, which goes on from where it stood, segments bootstrapped "
        "with V and derivatives means over steps, J's divided by a trajectory's mean length "
        "(DESIGN section 2); or a class of :class:`~sb3_crpn.episodes.Tracker`.",
        "episodes",
    )
    n_episodes: int | Schedule | None = setting(
        COUNT | SCHEDULE | NONE,
        "m_k, the episodes of the gradient: an int or a schedule; ``None``: from ``n_steps``. "
        'Rollouts of "timesteps" take ``None`` alone.',
        None,
    )
    n_hessian_episodes: int | Schedule | None = setting(
        COUNT | SCHEDULE | NONE,
        "b_k, the episodes of the Hessian, likewise; ``None``: the gradient's. Where the two "
        "differ, max(m_k, b_k) are simulated and each set is drawn without replacement.",
        None,
    )
    n_reused_rollouts: int = setting(
        integer(0),
        "Maximum number of previous rollouts reused in each update, importance-weighted "
        "(:class:`~sb3_crpn.episodes.Replay`). A rollout is dropped once its effective sample "
        "size falls below half, and when ``learn`` ends. 0 disables reuse (the paper).",
        3,
    )
    alpha: float | Schedule = setting(
        POSITIVE | SCHEDULE,
        "α of the cubic term, a float or a schedule. With ``target_kl`` only the first guess.",
        1.0,
    )
    target_kl: float | None = setting(
        POSITIVE | NONE,
        "Mean KL divergence KL(old ‖ new) of each step, met within 10 % by the choice of α. The "
        "mean is over states and action components, as in sb3-contrib's TRPO. ``None``: α follows "
        "its schedule.",
        0.02,
    )
    scale_target_kl: bool = setting(
        FLAG,
        "Lower the target where the standard deviation of the λ-returns falls below a fifth of its "
        "recent maximum, in proportion to its square: a solved task is then left alone. False: "
        "every step is fitted to ``target_kl`` itself.",
        True,
    )
    metric: str | Metric = setting(
        METRICS.check,
        '"fisher": M = F + εI; "euclidean": M = I, the paper\'s; or a '
        ":class:`~sb3_crpn.curvature.Metric`.",
        "fisher",
    )
    fisher_damping: float = setting(POSITIVE, 'ε > 0 of "fisher".', 0.1)
    hessian_estimator: str | HessianEstimator = setting(
        HESSIAN_ESTIMATORS.check,
        '"causal", or the paper\'s "trajectory"; or a '
        ":class:`~sb3_crpn.curvature.HessianEstimator`.",
        "causal",
    )
    hessian_lambda: float = setting(
        FRACTION,
        'κ in [0, 1], the decay of the cross-time terms of "causal": 1 is unbiased.',
        0.9,
    )
    hessian_shrinkage: float | str | Shrinkage | None = setting(
        FRACTION | SHRINKAGES.check | NONE,
        'ω in [0, 1]; "auto": the James-Stein factor from two folds of trajectories; ``None``: 1; '
        "or a :class:`~sb3_crpn.curvature.Shrinkage`.",
        "auto",
    )
    krylov_dim: int | None = setting(
        COUNT | NONE,
        "Dimension of the Krylov space that steps are sought in, at most d; ``None``: 10 with "
        "``target_kl`` or the Fisher metric, else as large as the solver's certificate needs.",
        None,
    )
    gamma: float = setting(FRACTION, "Discount factor.", 0.99)
    gae_lambda: float = setting(
        FRACTION, "λ of the generalised advantage estimator; 1: episode returns-to-go.", 0.95
    )
    baseline: bool = setting(FLAG, "Subtract the critic's V(s_i) from the returns-to-go.", True)
    normalize_advantage: bool = setting(
        FLAG,
        "Scale and shift the advantages to standard deviation 1 and mean 0 over each batch.",
        True,
    )
    discount_visitation: bool = setting(
        FLAG,
        "Keep the factor γ^i of step i, which the derivatives of J have and which is usually "
        "dropped.",
        False,
    )
    bootstrap_truncated: bool = setting(
        FLAG, "Add γV(s_H) where a time limit ended the episode.", True
    )
    horizon: int | None = setting(
        COUNT | NONE,
        "H, the step after which whole episodes are cut, in training, estimates and certificates; "
        "``None``: episodes end by themselves. Training on timesteps cuts none.",
        None,
    )
    batch_size: int = setting(COUNT, "Minibatch size of the critic.", 128)
    n_critic_updates: int = setting(
        integer(0),
        "Passes over the rollout that fit the critic in each update, after the actor's step. "
        "Reused rollouts share in these minibatches.",
        20,
    )
    max_batch_timesteps: int | None = setting(
        COUNT | NONE,
        "Maximum number of timesteps whose graphs are held in memory at a time, in chunks of whole "
        "episodes or segments (at least one); ``None``: the whole batch. Batches beyond it cost "
        "one more forward pass at every product; results are the same to rounding.",
        None,
    )
    use_sde: bool = setting(FLAG, "As in SB3: generalised state-dependent exploration.", False)
    sde_sample_freq: int = setting(
        integer(-1), "As in SB3: steps between noise matrices of gSDE; -1: one a rollout.", -1
    )
    rollout_buffer_class: type[RolloutBuffer] | None = setting(
        _BUFFER | NONE, "An ``EpisodeRolloutBuffer`` class; ``None``: chosen by observations.", None
    )
    rollout_buffer_kwargs: InitVar[dict[str, Any] | None] = setting(
        DICT | NONE, "As in SB3: further arguments of the buffer.", None
    )
    stats_window_size: InitVar[int] = setting(
        COUNT, "As in SB3: episodes that logged means are taken over.", 100
    )
    tensorboard_log: str | None = setting(PATH | NONE, "As in SB3: folder of the log.", None)
    policy_kwargs: InitVar[dict[str, Any] | None] = setting(
        DICT | NONE, "As in SB3: further arguments of the policy.", None
    )
    verbose: int = setting(VERBOSE, "As in SB3: 0 silent, 1 information, 2 debugging.", 0)
    seed: int | None = setting(SEED | NONE, "Of all random generators; ``None``: not seeded.", None)
    device: InitVar[torch.device | str] = setting(_DEVICE, '"auto" or a device of PyTorch.', "auto")
    _init_setup_model: InitVar[bool] = setting(
        FLAG, "As in SB3: build networks and buffer in the constructor.", True
    )

    replacements: ClassVar[dict[str, str]] = {
        "clip_range": "target_kl bounds the step",
        "clip_range_vf": "the critic's fit is not clipped",
        "n_epochs": "use n_critic_updates; the actor takes one step an update",
        "ent_coef": "there is no entropy bonus; a lower target_kl keeps actions random for longer",
        "vf_coef": "actor and critic have separate losses; learning_rate is the critic's",
        "max_grad_norm": "gradients are not clipped; target_kl, or else alpha, bounds the step",
        "rms_prop_eps": "use policy_kwargs=dict(optimizer_kwargs=...), the critic's optimiser",
        "use_rms_prop": "use policy_kwargs=dict(optimizer_class=...), the critic's optimiser",
        "normalize": "rl-zoo's: wrap the environment in VecNormalize",
        "n_timesteps": "pass it to learn",
        "cg_max_steps": "use krylov_dim",
        "cg_damping": "use fisher_damping",
        "line_search_shrinking_factor": "there is no line search; alpha is fitted to target_kl",
        "line_search_max_iter": "there is no line search; alpha is fitted to target_kl",
        "sub_sampling_factor": "use n_hessian_episodes, fewer than n_episodes",
    }
    """What stands in the place of arguments of SB3's PPO and A2C, sb3-contrib's TRPO and rl-zoo."""
