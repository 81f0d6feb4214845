"""One update: estimate, solve, accept, fit the critic, log."""

from __future__ import annotations

import math

import numpy as np
import torch
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_crpn.algorithm.collection import EpisodeCollection
from sb3_crpn.algorithm.critic import fit_critic
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.algorithm.settings import CheckedSchedule
from sb3_crpn.algorithm.step import PolicyStep, take_step
from sb3_crpn.checks import COUNT, NONE, real, requires
from sb3_crpn.cubic import CubicStep
from sb3_crpn.curvature import (
    CurvatureEstimate,
    LocalModel,
    PairWeights,
    estimate_curvature,
    full_model,
    projected_model,
)
from sb3_crpn.distributed import broadcast_state, gather_counts, local_count, mean_and_variance
from sb3_crpn.episodes import (
    EpisodeBatch,
    EpisodeRolloutBuffer,
    Replay,
    concatenate,
)
from sb3_crpn.parameters import ActorParameters

# Dimension of the Krylov space when the step's length is set by the KL divergence: the number of
# conjugate-gradient iterations of Schulman et al., Trust region policy optimization, ICML 2015,
# appendix C, whose step H = 0 then reproduces.
KRYLOV_DIM = 10

# Steps are shortened where the returns' standard deviation is below this fraction of its recent
# maximum, which fades by the factor SCALE_DECAY an update
FULL_KL_FRACTION = 0.2
SCALE_DECAY = 0.99
# The shortest, a hundredth: its KL divergence can still be told from 0 in single precision
MIN_KL_SCALE = 1e-2

_VEC_ENV = requires("a VecEnv", lambda value: isinstance(value, VecEnv))


class PolicyNewtonUpdate(EpisodeCollection):
    """The update of DESIGN section 5; the subclass brings the arguments and the solver."""

    actor: ActorParameters
    replay: Replay
    alpha_schedule: Schedule
    _rng: np.random.Generator
    _fitted_alpha: float | None = None  # the last α that met target_kl
    _return_scale = 0.0  # the largest standard deviation of the returns, fading

    def train(self) -> None:
        """Update the policy from the episodes just collected (DESIGN section 5)."""
        # a bad value of the schedule ends the update before anything changes
        alpha = self.alpha_schedule(self._current_progress_remaining)
        self.policy.set_training_mode(False)
        self._update_learning_rate(self.policy.optimizer)
        batch = self._episode_batch(self.rollout_buffer)
        earlier = self.replay.reweighted(self.policy, **self._weighting)
        estimate = self._estimate(batch, earlier)
        model = self._local_model(estimate)
        target_kl = self._scaled_target_kl(batch)
        step = self._take_step(estimate.gradient_batch, model, alpha, target_kl)
        value_loss = self._fit_critic(batch, earlier)
        if step.trial.finite:  # what spoilt one step would spoil the next ones
            self.replay.append(batch)
        broadcast_state(self.policy)
        self._n_updates += 1
        self._log_update(batch, len(earlier), estimate, model, step, target_kl, value_loss)

    def estimate_curvature(self, n_episodes: int, env: VecEnv | None = None) -> CurvatureEstimate:
        """Estimate gradient and Hessian of J at the current policy from fresh episodes.

        The estimators are those of the constructor's arguments; nothing is learnt, and the
        episodes do not count as training. With several ranks all must call, and share the episodes.

        Parameters
        ----------
        n_episodes
            Number of episodes, used for the gradient and for the Hessian alike.
        env
            Where to simulate; ``None``: the training environment.
        """
        n_episodes = COUNT("estimate_curvature: n_episodes", n_episodes)
        env = (_VEC_ENV | NONE)("estimate_curvature: env", env)
        broadcast_state(self.policy)
        batch = self._episode_batch(self._collect_fresh(n_episodes, env))
        return self._estimate_from(batch, batch)

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

    def _estimate(self, batch: EpisodeBatch, earlier: list[EpisodeBatch]) -> CurvatureEstimate:
        """Estimate g from m_k and H from b_k of the episodes, and from the earlier ones.

        F, of which no return makes noise, is the m_k episodes' alone.
        """
        m, b = self._batch_sizes  # of the progress at which they were simulated
        n_simulated = sum(gather_counts(batch.n_episodes))
        drawn = self._draw(batch, m, n_simulated)
        gradient_batch = concatenate([drawn, *earlier])
        hessian_batch = gradient_batch
        if b is not None:
            hessian_batch = concatenate([self._draw(batch, b, n_simulated), *earlier])
        return self._estimate_from(gradient_batch, hessian_batch, drawn)

    def _estimate_from(
        self,
        gradient_batch: EpisodeBatch,
        hessian_batch: EpisodeBatch,
        fisher_batch: EpisodeBatch | None = None,
    ) -> CurvatureEstimate:
        return estimate_curvature(
            self.policy,
            self.actor,
            gradient_batch,
            hessian_batch,
            PairWeights(self.hessian_estimator, self.hessian_lambda),
            self.max_batch_timesteps,
            fisher_batch,
        )

    def _draw(self, batch: EpisodeBatch, n_episodes: int | None, n_simulated: int) -> EpisodeBatch:
        """Draw this rank's share of episodes without replacement; all are the batch itself."""
        if n_episodes is None or n_episodes >= n_simulated:
            return batch
        return batch.take(
            self._rng.choice(batch.n_episodes, local_count(n_episodes), replace=False)
        )

    def _prefers_dense(self) -> bool:
        """Whether the model is to be written out on all of ℝᵈ."""
        return False

    def _local_model(self, estimate: CurvatureEstimate) -> LocalModel:
        """Build the cubic model, on a subspace unless the paper's full space is asked for."""
        fisher = self.metric == "fisher"
        shrinkage = 1.0 if self.hessian_shrinkage is None else self.hessian_shrinkage
        unrestricted = self.krylov_dim is None and self.target_kl is None and not fisher
        if not self._prefers_dense() and unrestricted and shrinkage != "auto":
            return full_model(estimate, shrinkage)
        dim = KRYLOV_DIM if self.krylov_dim is None else self.krylov_dim
        return projected_model(
            estimate,
            damping=self.fisher_damping if fisher else None,
            dim=None if self._prefers_dense() else dim,
            shrinkage=None if shrinkage == "auto" else shrinkage,
        )

    def _solve(self, model: LocalModel, alpha: float) -> CubicStep:
        """Minimise the cubic model: what CRPN and ACRPN differ in."""
        raise NotImplementedError

    def _scaled_target_kl(self, batch: EpisodeBatch) -> float | None:
        """Return δ_k = δ min(1, 5σ_k/σ̄_k)², σ̄_k = max(σ_k, 0.99 σ̄_{k-1}), δ = ``target_kl``.

        σ_k is the standard deviation of the λ-returns, in the units that the rewards had before
        ``VecNormalize``. Once a task is solved all episodes are alike and σ_k falls by orders of
        magnitude: what is left to the advantages is the critic's error, which a step that is
        fitted to a target follows as far as it followed the returns. This one's length is in
        proportion to σ_k. Without ``scale_target_kl``, δ_k = δ.
        """
        if self.target_kl is None or not self.scale_target_kl:
            return self.target_kl
        deviation = self._reward_unit() * math.sqrt(mean_and_variance(batch.returns)[1])
        if not math.isfinite(deviation):  # nor is the step, which is rejected
            return self.target_kl
        self._return_scale = max(deviation, SCALE_DECAY * self._return_scale)
        full = FULL_KL_FRACTION * self._return_scale
        signal = deviation / full if full else 1.0
        return self.target_kl * min(1.0, max(MIN_KL_SCALE, signal)) ** 2

    def _reward_unit(self) -> float:
        """Return what ``VecNormalize`` divides rewards by, √(Var[Σγ^h r_h] + ε); else 1."""
        normalizer = self.get_vec_normalize_env()
        if normalizer is None or not normalizer.norm_reward:
            return 1.0
        return math.sqrt(float(normalizer.ret_rms.var) + normalizer.epsilon)

    def _take_step(
        self, batch: EpisodeBatch, model: LocalModel, alpha: float, target_kl: float | None
    ) -> PolicyStep:
        """Choose α, move the actor, and move it back if the step is no good."""
        if target_kl is not None and self._fitted_alpha is not None:
            alpha = self._fitted_alpha
        step = take_step(
            CandidateEvaluator(self.policy, self.actor, batch, self.max_batch_timesteps),
            model,
            lambda alpha: self._solve(model, alpha),
            alpha,
            target_kl,
        )
        if target_kl is not None and step.trial.finite:
            self._fitted_alpha = step.alpha
        return step

    def _fit_critic(self, batch: EpisodeBatch, earlier: list[EpisodeBatch]) -> float | None:
        """Regress V on the λ-returns; ``None`` where V is not used.

        The earlier rollouts share in the minibatches of the fresh one, which become no more.
        """
        if not self.uses_critic:
            return None
        per_pass = math.ceil(sum(gather_counts(batch.n_steps)) / self.batch_size)
        return fit_critic(
            self.policy,
            self.actor,
            concatenate([batch, *earlier]),
            n_minibatches=self.n_critic_updates * per_pass,
            batch_size=self.batch_size,
            rng=self._rng,
        )

    def _log_update(
        self,
        batch: EpisodeBatch,
        n_earlier: int,
        estimate: CurvatureEstimate,
        model: LocalModel,
        step: PolicyStep,
        target_kl: float | None,
        value_loss: float | None,
    ) -> None:
        assert isinstance(self.rollout_buffer, EpisodeRolloutBuffer)  # by _setup_model
        values = {
            "gradient_norm": float(estimate.gradient.norm()),
            "gradient_noise": estimate.gradient_noise,
            **step.log(),
            "lambda_min": step.cubic.lambda_min if model.basis is None else model.lambda_min,
            "hessian_vector_products": model.products or step.cubic.products,
            "hessian_shrinkage": model.shrinkage,
            "n_episodes": sum(gather_counts(batch.n_episodes)),
            "n_reused_rollouts": n_earlier,
            "used_timesteps_fraction": self.rollout_buffer.used_fraction,
            "explained_variance": _explained_variance(batch),
        }
        if target_kl is not None:
            values["target_kl"] = target_kl
        if value_loss is not None:
            values["value_loss"] = value_loss
        if hasattr(self.policy, "log_std"):
            values["std"] = torch.exp(self.policy.log_std).mean().item()
        for key, value in values.items():
            self.logger.record(f"train/{key}", value)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")


def _explained_variance(batch: EpisodeBatch) -> float:
    """Return 1 - Var[R - V] / Var[R] over the steps of all ranks; nan where Var[R] = 0."""
    variance = mean_and_variance(batch.returns)[1]
    unexplained = mean_and_variance(batch.returns - batch.values)[1]
    return 1.0 - unexplained / variance if variance else float("nan")
