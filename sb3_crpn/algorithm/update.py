"""One update: estimate, solve, accept, fit the critic, log."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm.critic import fit_critic
from sb3_crpn.algorithm.distributed_training import share_policy
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.algorithm.kl_control import KLControl
from sb3_crpn.algorithm.rollouts import RolloutAlgorithm
from sb3_crpn.algorithm.settings import CheckedSchedule
from sb3_crpn.algorithm.solvers import SubproblemSolver
from sb3_crpn.algorithm.statistics import UpdateStats
from sb3_crpn.algorithm.step import PolicyStep, take_step
from sb3_crpn.checks import COUNT, FLAG, NONE, real, requires
from sb3_crpn.curvature import (
    HESSIAN_ESTIMATORS,
    METRICS,
    Constant,
    CurvatureEstimate,
    Euclidean,
    FullModel,
    LocalModel,
    estimate_curvature,
    resolve_shrinkage,
    subspace_model,
)
from sb3_crpn.episodes import (
    EpisodeBatch,
    EpisodeRolloutBuffer,
    Replay,
    concatenate,
)
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import unchanged_on_error

# Dimension of the Krylov space when the step's length is set by the KL divergence: the number of
# conjugate-gradient iterations of Schulman et al., Trust region policy optimization, ICML 2015,
# appendix C, whose step H = 0 then reproduces.
KRYLOV_DIM = 10

_VEC_ENV = requires("a VecEnv", lambda value: isinstance(value, VecEnv))


class PolicyNewtonUpdate(RolloutAlgorithm):
    """The update of DESIGN section 5; the subclass brings the arguments and the solver."""

    replay: Replay
    alpha_schedule: CheckedSchedule
    kl_control: KLControl
    last_update: UpdateStats | None = None  # of this call of learn
    _rng: np.random.Generator

    @property
    def actor(self) -> ActorParameters:
        """The parameters θ that log π depends on."""
        raise NotImplementedError

    def train(self) -> None:
        """Update the policy from the rollout just collected (DESIGN section 5), or not at all."""
        with unchanged_on_error(self.policy):
            self._update()

    def _update(self) -> None:
        self.policy.set_training_mode(False)
        self._update_learning_rate(self.policy.optimizer)
        batch = self._episode_batch(self.rollout_buffer)
        if not self.tracker.whole_episodes:
            batch = replace(batch, unit="n_steps")
        earlier = self.replay.reweighted(self.policy, **self._weighting)
        joined = concatenate([batch, *earlier])
        estimate = self._estimate(batch, joined, earlier)
        solver = self._update_solver(batch)
        model = self._local_model(estimate, solver)
        target_kl = self._update_target_kl(batch)
        evaluator = CandidateEvaluator(
            self.policy, self.actor, estimate.gradient_batch, self.max_batch_timesteps
        )
        alpha = self._first_alpha(target_kl)
        step, accepted = take_step(evaluator, model, solver, alpha, target_kl)
        value_loss = self._fit_critic(batch, joined)
        if step.evaluation.finite:  # a rollout whose step was not finite is not reused
            self.replay.append(batch)
            if target_kl is not None:
                self.kl_control.alpha = step.alpha
        share_policy(self.policy)
        self._n_updates += 1
        self.last_update = UpdateStats(
            **_step_statistics(estimate, model, step, accepted),
            **self._batch_statistics(batch),
            n_reused_rollouts=len(earlier),
            n_trials=evaluator.n_trials,
            target_kl=target_kl,
            value_loss=value_loss,
        )
        self.last_update.write(self.logger)

    @torch.enable_grad()
    def estimate_curvature(
        self, n_episodes: int, env: VecEnv | None = None, *, progress_bar: bool = False
    ) -> CurvatureEstimate:
        """Estimate gradient and Hessian of J at the current policy from fresh episodes.

        The estimators are those of the constructor's arguments; nothing is learnt, and the
        episodes do not count as training. With several ranks all must call, and share the episodes.

        Parameters
        ----------
        n_episodes
            Number of episodes, used for the gradient and for the Hessian alike.
        env
            Where to simulate; ``None``: the training environment.
        progress_bar
            Show the episodes simulated, on each rank its own; needs tqdm and rich.
        """
        n_episodes = COUNT("estimate_curvature: n_episodes", n_episodes)
        env = (_VEC_ENV | NONE)("estimate_curvature: env", env)
        show = FLAG("estimate_curvature: progress_bar", progress_bar)
        share_policy(self.policy)
        batch = self._episode_batch(self._collect_evaluation_episodes(n_episodes, env, show))
        return self._estimate_from(batch)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """Keep the progress of schedules in [0, 1]: whole episodes overrun the last timestep."""
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

    def _scheduled_episodes(self) -> tuple[int | None, int | None]:
        progress = self._current_progress_remaining

        def number(name: str, value: int | Schedule | None) -> int | None:
            if value is None:
                return None
            name = f"{type(self).__name__}: {name}"
            return round(CheckedSchedule(name, value, real(1.0))(progress))

        return (
            number("n_episodes", self.n_episodes),
            number("n_hessian_episodes", self.n_hessian_episodes),
        )

    def _episode_batch(self, buffer: RolloutBuffer) -> EpisodeBatch:
        assert isinstance(buffer, EpisodeRolloutBuffer)  # by _setup_model
        return buffer.episode_batch(**self._weighting)

    @property
    def _weighting(self) -> dict[str, bool]:
        return {
            "baseline": self.baseline,
            "normalize_advantage": self.normalize_advantage,
            "discount_visitation": self.discount_visitation,
        }

    def _estimate(
        self, batch: EpisodeBatch, joined: EpisodeBatch, earlier: list[EpisodeBatch]
    ) -> CurvatureEstimate:
        """Estimate g from m_k and H from b_k of the episodes, and from the earlier ones.

        F, of which no return makes noise, is the m_k episodes' alone.
        """
        m, b = self._batch_sizes  # of the progress at which they were simulated
        n_simulated = batch.total_episodes
        drawn = batch if m is None or m >= n_simulated else self._draw(batch, m)
        hessian_batch = None
        if b is not None and b < n_simulated:
            hessian_batch = concatenate([self._draw(batch, b), *earlier])
        elif b is not None and drawn is not batch:
            hessian_batch = joined
        return self._estimate_from(
            joined if drawn is batch else concatenate([drawn, *earlier]),
            hessian_batch=hessian_batch,
            fisher_batch=drawn if earlier else None,
        )

    def _estimate_from(
        self, batch: EpisodeBatch, **others: EpisodeBatch | None
    ) -> CurvatureEstimate:
        return estimate_curvature(
            self.policy,
            self.actor,
            batch,
            HESSIAN_ESTIMATORS.resolve(self.hessian_estimator, self),
            max_steps=self.max_batch_timesteps,
            **others,
        )

    def _draw(self, batch: EpisodeBatch, n_episodes: int) -> EpisodeBatch:
        """Draw this rank's share of ``n_episodes`` without replacement."""
        return batch.take(
            self._rng.choice(batch.n_episodes, batch.share(n_episodes), replace=False)
        )

    def _update_solver(self, batch: EpisodeBatch) -> SubproblemSolver:
        """Return the solver of this update: what CRPN and ACRPN differ in."""
        raise NotImplementedError

    def _local_model(self, estimate: CurvatureEstimate, solver: SubproblemSolver) -> LocalModel:
        """Build the cubic model, on a subspace unless the paper's full space is asked for."""
        metric = METRICS.resolve(self.metric, self)
        shrinkage = resolve_shrinkage(self.hessian_shrinkage, self)
        if solver.needs_matrix(len(self.actor)):
            return subspace_model(estimate, metric, shrinkage)
        unrestricted = self.krylov_dim is None and self.target_kl is None
        if unrestricted and isinstance(metric, Euclidean) and isinstance(shrinkage, Constant):
            return FullModel(estimate, shrinkage.value)
        dim = KRYLOV_DIM if self.krylov_dim is None else self.krylov_dim
        return subspace_model(estimate, metric, shrinkage, dim)

    def _update_target_kl(self, batch: EpisodeBatch) -> float | None:
        """Return ``target_kl``, scaled by the spread of the returns unless the user objects."""
        if self.target_kl is None or not self.scale_target_kl:
            return self.target_kl
        deviation = self._reward_unit() * math.sqrt(batch.moments(batch.returns)[1])
        return self.kl_control.scaled_target(self.target_kl, deviation)

    def _reward_unit(self) -> float:
        """Return what ``VecNormalize`` divides rewards by, √(Var[Σγ^h r_h] + ε); else 1."""
        normalizer = self.get_vec_normalize_env()
        if normalizer is None or not normalizer.norm_reward:
            return 1.0
        return math.sqrt(float(normalizer.ret_rms.var) + normalizer.epsilon)

    def _first_alpha(self, target_kl: float | None) -> float:
        alpha = self.alpha_schedule(self._current_progress_remaining)
        return alpha if target_kl is None else self.kl_control.first_alpha(alpha)

    def _fit_critic(self, batch: EpisodeBatch, joined: EpisodeBatch) -> float | None:
        """Regress V on the λ-returns; ``None`` where V is not used.

        Reused rollouts share the minibatches of the fresh one: their number does not grow.
        """
        if not self.uses_critic:
            return None
        per_pass = math.ceil(batch.total_steps / self.batch_size)
        return fit_critic(
            self.policy,
            self.actor,
            joined,
            n_minibatches=self.n_critic_updates * per_pass,
            batch_size=self.batch_size,
            rng=self._rng,
        )

    def _batch_statistics(self, batch: EpisodeBatch) -> dict[str, Any]:
        log_std = getattr(self.policy, "log_std", None)
        return {
            "n_updates": self._n_updates,
            "mean_reward": self._mean_reward,
            "n_episodes": batch.total_episodes,
            "used_timesteps_fraction": self._used_fraction,
            "explained_variance": _explained_variance(batch),
            "std": None if log_std is None else torch.exp(log_std).mean().item(),
        }


def _step_statistics(
    estimate: CurvatureEstimate, model: LocalModel, step: PolicyStep, accepted: bool
) -> dict[str, Any]:
    """Return what is known of the step; one that was not accepted has had no effect."""
    cubic, batch = step.cubic, estimate.gradient_batch
    change = step.evaluation.surrogate_change if accepted else 0.0
    mean_cost = batch.moments(batch.cost_advantages)[0]
    return {
        "gradient_norm": float(estimate.gradient.norm()),
        "gradient_noise": estimate.gradient_noise,
        "alpha": step.alpha,
        "multiplier": cubic.multiplier,
        "predicted_decrease": cubic.predicted_decrease,
        "step_norm": float(step.step.norm()) if accepted else 0.0,
        "kl_divergence": step.kl if accepted else 0.0,
        "surrogate_change": change,
        "policy_objective": -mean_cost - change * batch.total_size / batch.total_steps,
        "accepted": accepted,
        "certified": cubic.certified,
        "solver_status": cubic.status,
        # the ranks' solves agree to rounding: the end of training is rank 0's decision
        "at_sosp": bool(batch.agreed(torch.tensor(cubic.at_sosp))),
        "lambda_min": model.lambda_min(cubic),
        "hessian_vector_products": model.products(cubic),
        "hessian_shrinkage": model.shrinkage,
    }


def _explained_variance(batch: EpisodeBatch) -> float:
    """Return 1 - Var[R - V] / Var[R] over the steps of all ranks; nan where Var[R] = 0."""
    variance = batch.moments(batch.returns)[1]
    unexplained = batch.moments(batch.returns - batch.values)[1]
    return 1.0 - unexplained / variance if variance else float("nan")
