"""The certificate of an ε-second-order stationary point."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, get_args

import numpy as np
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.checks import (
    COUNT,
    FLAG,
    NONE,
    POSITIVE,
    Check,
    choice,
    integer,
    not_allowed,
    pair,
    real,
)
from sb3_crpn.episodes.batch import EpisodeBatch
from sb3_crpn.episodes.observations import map_observations
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import find_actor
from sb3_crpn.progress import load_bar, progress
from sb3_crpn.sosp.batch_means import BatchMeans
from sb3_crpn.sosp.episodes import collect_episodes, preserve_state, with_baseline
from sb3_crpn.sosp.inference import Interval, bernstein_intervals, bootstrap_intervals
from sb3_crpn.sosp.report import IntervalMethod, SospReport
from sb3_crpn.sosp.spectrum import Spectrum, lanczos_spectrum
from sb3_crpn.sosp.target import environment_of, paper_alpha, policy_of
from sb3_crpn.sosp.thresholds import TaskScales, choose_thresholds, likely_norm

# Blocks that the noise is measured by: t_{49} is within 4 % of the normal quantile, and products
# with 50 blocks cost about twice those with the whole batch at 500 steps a block
MAX_BLOCKS = 50

_CHECKS: dict[str, Check] = {
    "n_episodes": integer(4),
    "epsilon": POSITIVE | NONE,
    "rho": POSITIVE | NONE,
    "confidence": real(0.0, 1.0, open_low=True, open_high=True),
    "interval": choice(*get_args(IntervalMethod)),
    "bounds": pair(POSITIVE) | NONE,
    "n_eigenvalues": COUNT,
    "n_probes": COUNT,
    "seed": integer(0) | NONE,
    "progress_bar": FLAG,
}


@torch.enable_grad()
def certify_sosp(
    model: OnPolicyAlgorithm,
    n_episodes: int,
    epsilon: float | None = None,
    rho: float | None = None,
    *,
    env: GymEnv | None = None,
    confidence: float = 0.95,
    interval: IntervalMethod = "bootstrap",
    bounds: tuple[float, float] | None = None,
    n_eigenvalues: int = 5,
    n_probes: int = 1,
    seed: int | None = None,
    progress_bar: bool = False,
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
    were. Be prepared for "undecided": 57 % of 640 verdicts in this project's experiments, from 20
    to 2,000 episodes. The report says about how many episodes would decide.

    Parameters
    ----------
    model
        PPO, A2C, TRPO, CRPN, ACRPN or any other SB3 on-policy model with an ``ActorCriticPolicy``.
    n_episodes
        Episodes to simulate, at least 4; rounded up so that at most 50 blocks hold equally many.
    epsilon
        ε > 0, in the units of ∇J. ``None``: a slope that changes the return by a tenth of its size
        over a step that changes the distribution of episodes by a KL divergence of ½. See
        :mod:`~sb3_crpn.sosp.thresholds`.
    rho
        ρ > 0, a Lipschitz constant of ∇²J. ``None``: the current α of a model whose cubic term is
        the paper's, with α in the place of ρ (Euclidean metric, ``target_kl=None``). For others
        the ρ with which the curvature -√(ρε) changes the return over that step by as much as the
        slope ε. The intervals depend on neither ε nor ρ: the confidence is that of the intervals
        however the two were chosen, be it from these episodes.
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
    progress_bar
        Show the episodes simulated and the Hessian products done; needs tqdm and rich.

    Raises
    ------
    ValueError
        An argument is out of range, the environment's spaces are not the model's, or no episode
        ends.
    RuntimeError
        ``env=None`` in the middle of a rollout.
    ImportError
        ``progress_bar=True`` without tqdm and rich.
    """
    options = checked_options(
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
        progress_bar=progress_bar,
    )
    policy, target = policy_of(model), environment_of(model, env)
    rng = np.random.default_rng(options["seed"])
    n_blocks, n_episodes = _blocks(options["n_episodes"])
    with preserve_state(policy, target, int(rng.integers(2**31))):
        batch = _simulate(model, policy, target, n_episodes, options)
        actor = _actor(policy, batch)
        sample = BatchMeans.from_episodes(policy, actor, batch, n_blocks, model.gamma, rng)
        spectrum, intervals = _infer(sample, n_episodes, rng, options)
        scales = partial(TaskScales.from_episodes, policy, actor, batch)
        thresholds = choose_thresholds(
            options["epsilon"], options["rho"], paper_alpha(model), scales
        )
    gradient = sample.gradients.mean(0)
    return SospReport(
        *intervals,
        epsilon=thresholds.epsilon,
        rho=thresholds.rho,
        thresholds=thresholds.origin,
        confidence=options["confidence"],
        interval=options["interval"],
        n_episodes=n_episodes,
        n_steps=batch.n_steps,
        likely_gradient_norm=likely_norm(sample.gradients),
        gradient=gradient,
        escape_direction=_downhill(gradient, spectrum.vector),
        spectrum=spectrum,
    )


def _simulate(
    model: OnPolicyAlgorithm,
    policy: ActorCriticPolicy,
    env: VecEnv,
    n_episodes: int,
    options: dict[str, Any],
) -> EpisodeBatch:
    """Return episodes end to end, with the model's critic as baseline for "bootstrap"."""
    horizon = getattr(model, "horizon", None)
    with progress("episodes", n_episodes, show=options["progress_bar"]) as tick:
        batch = collect_episodes(
            policy, env, n_episodes, gamma=model.gamma, horizon=horizon, tick=tick
        )
    if options["interval"] == "bootstrap":
        return with_baseline(policy, batch, model.gamma)
    return batch


def _infer(
    sample: BatchMeans, n_episodes: int, rng: np.random.Generator, options: dict[str, Any]
) -> tuple[Spectrum, tuple[Interval, Interval]]:
    """Return the spectrum of Ĥ and the intervals of ‖∇J‖ and λ_min(∇²J)."""
    confidence, bounds = options["confidence"], options["bounds"]
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    with progress("Hessian products", None, show=options["progress_bar"]) as tick:
        sample = sample.with_ticks(tick)
        spectrum = lanczos_spectrum(
            sample.mean_product,
            sample.gradients[0],
            generator,
            n_probes=options["n_probes"],
            n_leftmost=options["n_eigenvalues"],
        )
        if bounds is None:
            intervals = bootstrap_intervals(sample, spectrum, confidence, generator, rng)
        else:  # of "bernstein", by checked_options
            intervals = bernstein_intervals(sample, spectrum, confidence, bounds, n_episodes)
    return spectrum, intervals


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
    if options.get("progress_bar"):
        load_bar()
    return options
