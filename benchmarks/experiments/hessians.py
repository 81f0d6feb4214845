"""CRPN with H from other episodes, or as far as held-out episodes confirm it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Mapping
from functools import cached_property
from typing import Any, TypeVar

import torch
from gymnasium import Env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor

from benchmarks.experiments.crossfit import CrossFit, Fold
from benchmarks.experiments.steps import step_of_kl
from sb3_crpn import CRPN
from sb3_crpn.algorithm.update import UpdateData
from sb3_crpn.curvature import CurvatureEstimate
from sb3_crpn.episodes import EpisodeBatch, Replay, concatenate

Choice = TypeVar("Choice", bound=Hashable)

MAX_ORACLE_ENVS = 16
# Previous rollouts in the H of `MemoryHessian`
N_REMEMBERED = 8
# Candidates of ω
OMEGAS = (0.0, 0.25, 0.5, 0.75, 1.0)
MEMORY = 0.9  # by which the values of the past fade in an update


class FreshHessian(CRPN):
    """H from the new rollout only, g also from previous rollouts."""

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        fresh = data.fresh
        return self._estimate_from(
            data.joined, hessian_batch=self._hessian_batch(fresh), fisher_batch=fresh
        )

    def _hessian_batch(self, batch: EpisodeBatch) -> EpisodeBatch:
        return batch


class OracleHessian(FreshHessian):
    """H from ``factor`` times as many fresh, independent episodes as the rollout has.

    They are simulated in environments of their own, and counted nowhere: what a better estimate of
    H would be worth, not a method. For environments without ``VecNormalize``.

    Attributes
    ----------
    factor
        The factor.
    env_id
        The environment's registered name, or a function that makes it.
    """

    factor: int
    env_id: str | Callable[[], Env[Any, Any]]

    @cached_property
    def _oracle_env(self) -> VecEnv:
        return make_vec_env(self.env_id, MAX_ORACLE_ENVS, seed=1000 + (self.seed or 0))

    def _hessian_batch(self, batch: EpisodeBatch) -> EpisodeBatch:
        n_episodes = self.factor * batch.n_episodes
        return self._batch(self.rollouts.evaluate(self, n_episodes, self._oracle_env))


class LongReplay(Replay):
    """Replay that keeps a rollout until its effective sample size is a tenth of its steps."""

    min_effective_size = 0.1


class MemoryHessian(CRPN):
    """H from the new rollout and up to ``N_REMEMBERED`` previous ones, g as in CRPN."""

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        self._memory = LongReplay(N_REMEMBERED, self.gamma, self.gae_lambda)
        return super()._setup_learn(*args, **kwargs)

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        remembered = self._memory.reweighted(self.policy, **self._weighting)
        self._memory.append(data.fresh)
        return self._estimate_from(
            data.joined,
            hessian_batch=concatenate([data.fresh, *remembered]),
            fisher_batch=data.fresh,
        )


class ConfirmedHessian(CRPN):
    """ω, and the use of previous rollouts in H, chosen by the step's value on held-out episodes.

    The value of a choice is the mean over folds of -(g·s + ½ sᵀHs), g and H the fold's, s made from
    all other episodes with that choice and ``target_kl``; and over updates, the past fading.

    Attributes
    ----------
    values
        The mean values so far, by (source, ω).
    choice
        The (source, ω) of the last update.
    """

    def _setup_model(self) -> None:
        self.values: dict[tuple[str, float], float] = {}
        self.choice = ("all", 0.0)
        super()._setup_model()

    def _estimate(self, data: UpdateData) -> CurvatureEstimate:
        fresh = data.fresh
        if fresh.n_episodes > 1:
            self._judge(CrossFit(self, fresh, data.earlier))
            self.choice = max(self.values, key=self.values.__getitem__)
        source, self.hessian_shrinkage = self.choice
        hessian_batch = None if source == "all" else fresh
        return self._estimate_from(data.joined, hessian_batch=hessian_batch, fisher_batch=fresh)

    def _judge(self, folds: CrossFit) -> None:
        """Update the exponentially weighted means with this rollout's values."""
        total: dict[tuple[str, float], float] = {}
        for fold in folds:
            for choice, value in self._fold_values(folds, fold).items():
                total[choice] = total.get(choice, 0.0) + fold.weight * value
        remember(self.values, total)

    def _fold_values(self, folds: CrossFit, fold: Fold) -> dict[tuple[str, float], float]:
        assert self.target_kl is not None
        forms, k = folds.hessian_forms(fold), fold.index
        test = forms[k] / folds.sizes[k]
        values = {}
        for source, omega in itertools.product(("all", "fresh"), OMEGAS):
            groups = slice(None) if source == "all" else slice(folds.n_folds)
            rest = (forms[groups].sum(0) - forms[k]) / (folds.sizes[groups].sum() - folds.sizes[k])
            y = step_of_kl(fold.gradient, omega * rest, fold.space, self.target_kl)
            values[source, omega] = step_value(fold.test_gradient, test, y)
        return values


def remember(values: dict[Choice, float], present: Mapping[Choice, float]) -> None:
    """Update the exponentially weighted means ``values``; a choice's first value is its mean."""
    for choice, value in present.items():
        values[choice] = MEMORY * values.get(choice, value) + (1.0 - MEMORY) * value


def step_value(gradient: Tensor, hessian: Tensor, y: Tensor) -> float:
    """Return -(g·y + ½ yᵀHy), the decrease of the cost to second order."""
    return -float(gradient @ y + 0.5 * torch.dot(y, hessian @ y))
