"""The certificate of an ε-second-order stationary point."""

from __future__ import annotations

import math
from typing import Any, get_args

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm import PolicyNewtonAlgorithm
from sb3_crpn.checks import (
    COUNT,
    NONE,
    POSITIVE,
    Check,
    choice,
    integer,
    not_allowed,
    pair,
    real,
    requires,
)
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.episodes.observations import map_observations
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import find_actor
from sb3_crpn.sosp.batch_means import BatchMeans
from sb3_crpn.sosp.episodes import collect_episodes, preserve_state, with_baseline
from sb3_crpn.sosp.inference import bernstein_intervals, bootstrap_intervals
from sb3_crpn.sosp.report import IntervalMethod, SospReport
from sb3_crpn.sosp.spectrum import lanczos_spectrum

# Blocks that the noise is measured by: t_{49} is within 4 % of the normal quantile, and products
# with 50 blocks cost about twice those with the whole batch at 500 steps a block
MAX_BLOCKS = 50

ENVIRONMENT = requires(
    "an environment or a VecEnv", lambda value: isinstance(value, gym.Env | VecEnv)
)

_CHECKS: dict[str, Check] = {
    "n_episodes": integer(4),
    "epsilon": POSITIVE,
    "rho": POSITIVE | NONE,
    "confidence": real(0.0, 1.0, open_low=True, open_high=True),
    "interval": choice(*get_args(IntervalMethod)),
    "bounds": pair(POSITIVE) | NONE,
    "n_eigenvalues": COUNT,
    "n_probes": COUNT,
    "seed": integer(0) | NONE,
}


@torch.enable_grad()
def certify_sosp(
    model: OnPolicyAlgorithm,
    n_episodes: int,
    epsilon: float,
    rho: float | None = None,
    *,
    env: GymEnv | None = None,
    confidence: float = 0.95,
    interval: IntervalMethod = "bootstrap",
    bounds: tuple[float, float] | None = None,
    n_eigenvalues: int = 5,
    n_probes: int = 1,
    seed: int | None = None,
) -> SospReport:
    r"""Certify from fresh episodes whether the policy is an ε-second-order stationary point.

    .. math:: \|\nabla J(\theta)\| \le \varepsilon, \qquad
              \lambda_{\min}(\nabla^2 J(\theta)) \ge -\sqrt{\rho\varepsilon}

    (Maniyar et al., AISTATS 2024), J(θ) = -E[Σ_h γ^h r_h] the cost of the stochastic policy π_θ.

    The estimates are unbiased whatever the model was trained with: costs-to-go of whole episodes
    with γ^i kept, nothing bootstrapped or normalised, the causal Hessian at κ = 1 (DESIGN section
    2). The model's critic, fitted on earlier episodes, is the baseline. A time limit ends an
    episode, and so does the ``horizon`` of a model that has one. Rewards are those that the
    environment returns, scaled where a ``VecNormalize`` scales them.

    Works on products with Hessians alone. The policy, its generators and its mode are left as they
    were.

    Parameters
    ----------
    model
        PPO, A2C, TRPO, CRPN, ACRPN or any other SB3 on-policy model with an ``ActorCriticPolicy``.
    n_episodes
        Episodes to simulate, at least 4; rounded up so that at most 50 blocks hold equally many.
    epsilon
        ε > 0, in the units of ∇J.
    rho
        ρ > 0, a Lipschitz constant of ∇²J. ``None``: the current α of a model whose cubic term is
        the paper's, with α in the place of ρ (Euclidean metric, ``target_kl=None``); 1 for others,
        so that the condition is λ_min ≥ -√ε. It is not estimated, lest its error enter the verdict.
    env
        Where to simulate; reset at the start. ``None``: the model's own, which is not possible in
        the middle of a rollout, and which the next ``learn`` resets.
    confidence
        1 - δ: both intervals hold, and so no verdict is wrong, with at least this probability.
    interval
        "bootstrap": from the spread over blocks of whole episodes; see
        :mod:`~sb3_crpn.sosp.inference`. Approximate for finitely many episodes: what no episode
        shows, a rare catastrophe or reward, no interval allows for. "bernstein": the paper's
        matrix Bernstein bound with ``bounds``, valid for any number of episodes and far wider; the
        estimates are then without baseline, as those that the bounds hold for.
    bounds
        M_1 and M_2, largest deviations of one episode's estimates from ∇J and, in the spectral
        norm, from ∇²J: those of :class:`sb3_crpn.theory.Constants`. For "bernstein" alone.
    n_eigenvalues
        Leftmost eigenvalues to report.
    n_probes
        Random starts of the spectral density.
    seed
        Of actions, blocks and resamples; ``None``: fresh entropy.

    Raises
    ------
    ValueError
        An argument is out of range, the environment's spaces are not the model's, or no episode
        ends.
    RuntimeError
        ``env=None`` in the middle of a rollout.
    """
    checked = checked_options(
        "certify_sosp",
        n_episodes=n_episodes,
        epsilon=epsilon,
        rho=rho,
        confidence=confidence,
        interval=interval,
        bounds=bounds,
        n_eigenvalues=n_eigenvalues,
        n_probes=n_probes,
        seed=seed,
    )
    confidence, interval, bounds = (checked[k] for k in ("confidence", "interval", "bounds"))
    lanczos = {"n_probes": checked["n_probes"], "n_leftmost": checked["n_eigenvalues"]}
    policy, target = _policy(model), _environment(model, env)
    rng = np.random.default_rng(checked["seed"])
    n_blocks, n_episodes = _blocks(checked["n_episodes"])
    with preserve_state(policy, target, int(rng.integers(2**31))):
        batch = _simulate(model, policy, target, n_episodes, baseline=interval == "bootstrap")
        actor = _actor(policy, batch)
        sample = BatchMeans.from_episodes(policy, actor, batch, n_blocks, model.gamma, rng)
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        spectrum = lanczos_spectrum(sample.mean_product, sample.gradients[0], generator, **lanczos)
        if bounds is None:
            intervals = bootstrap_intervals(sample, spectrum, confidence, generator, rng)
        else:  # of "bernstein", by checked_options
            intervals = bernstein_intervals(sample, spectrum, confidence, bounds, n_episodes)
    gradient = sample.gradients.mean(0)
    return SospReport(
        *intervals,
        epsilon=checked["epsilon"],
        rho=_default_rho(model) if checked["rho"] is None else checked["rho"],
        confidence=confidence,
        interval=interval,
        n_episodes=n_episodes,
        n_steps=batch.n_steps,
        gradient=gradient,
        escape_direction=_downhill(gradient, spectrum.vector),
        spectrum=spectrum,
    )


def _simulate(
    model: OnPolicyAlgorithm,
    policy: ActorCriticPolicy,
    env: VecEnv,
    n_episodes: int,
    *,
    baseline: bool,
) -> EpisodeBatch:
    """Return episodes end to end, their costs-to-go less the model's critic if ``baseline``."""
    horizon = getattr(model, "horizon", None)
    batch = collect_episodes(policy, env, n_episodes, gamma=model.gamma, horizon=horizon)
    return with_baseline(policy, batch, model.gamma) if baseline else batch


def _actor(policy: ActorCriticPolicy, batch: EpisodeBatch) -> ActorParameters:
    first = map_observations(batch.observations, lambda tensor: tensor[:1])
    return find_actor(policy, first)


def _downhill(gradient: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    return -direction if gradient @ direction > 0.0 else direction


def _blocks(n_episodes: int) -> tuple[int, int]:
    """Return an even number of blocks, and the episodes that fill them evenly."""
    per_block = math.ceil(n_episodes / MAX_BLOCKS)
    n_blocks = 2 * math.ceil(n_episodes / (2 * per_block))
    return n_blocks, n_blocks * per_block


def _policy(model: OnPolicyAlgorithm) -> ActorCriticPolicy:
    policy = getattr(model, "policy", None)
    if not isinstance(policy, ActorCriticPolicy) or hasattr(policy, "lstm_actor"):
        raise ValueError(
            f"certify_sosp: model={model!r} is not allowed, must be an on-policy model with a "
            f"feed-forward ActorCriticPolicy, not {type(policy).__name__}"
        )
    return policy


def _environment(model: OnPolicyAlgorithm, env: GymEnv | None) -> VecEnv:
    """Return the environment to simulate in, wrapped as SB3 does."""
    if env is not None:
        ENVIRONMENT("certify_sosp: env", env)
        env = model._wrap_env(env, monitor_wrapper=False)
        check_for_correct_spaces(env, model.observation_space, model.action_space)
        return env
    own = model.get_env()
    if own is None:
        raise not_allowed("certify_sosp: env", None, "given: the model has no environment")
    if _in_rollout(model):
        raise RuntimeError(
            "the model's environment is in the middle of a rollout: "
            "pass an environment of its own with env="
        )
    model._last_obs = None  # the next learn() resets the environment
    return own


def _in_rollout(model: OnPolicyAlgorithm) -> bool:
    """Whether resetting the model's environment would break a rollout.

    SB3 keeps no flag, but a rollout that has begun leaves its buffer partly filled.
    """
    if isinstance(model, PolicyNewtonAlgorithm):
        return model._collecting
    started = model._last_obs is not None and model.num_timesteps > 0
    return started and not model.rollout_buffer.full


def _default_rho(model: OnPolicyAlgorithm) -> float:
    if not isinstance(model, PolicyNewtonAlgorithm):
        return 1.0
    if model.target_kl is not None or model.metric != "euclidean":
        return 1.0
    return model.alpha_schedule(model._current_progress_remaining)


def checked_options(owner: str, **options: Any) -> dict[str, Any]:
    """Return what :func:`certify_sosp` is told but the model and its environment, checked.

    Parameters
    ----------
    owner
        The class or function that the user called, for messages.

    Raises
    ------
    TypeError
        An option does not exist.
    ValueError
        One is out of range.
    """
    for name, value in options.items():
        if name not in _CHECKS:
            raise TypeError(f"{owner} has no argument {name}")
        options[name] = _CHECKS[name](f"{owner}: {name}", value)
    bounds, interval = options.get("bounds"), options.get("interval", "bootstrap")
    if (bounds is None) != (interval == "bootstrap"):
        allowed = 'two numbers with interval="bernstein", None with "bootstrap"'
        raise not_allowed(f"{owner}: bounds", bounds, allowed)
    return options
