"""PolicyNewtonAlgorithm: the arguments that CRPN and ACRPN have in common."""

from __future__ import annotations

from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_crpn.algorithm.arguments import check_arguments, check_sb3_arguments
from sb3_crpn.algorithm.critic import fuse
from sb3_crpn.algorithm.kl_control import KLControl
from sb3_crpn.algorithm.random_state import RandomState
from sb3_crpn.algorithm.update import PolicyNewtonUpdate
from sb3_crpn.curvature import HessianEstimator, Metric, Shrinkage
from sb3_crpn.distributed import rank
from sb3_crpn.episodes import (
    DictEpisodeRolloutBuffer,
    EpisodeRolloutBuffer,
    Replay,
)
from sb3_crpn.parameters import ActorParameters

Self = TypeVar("Self", bound="PolicyNewtonAlgorithm")


class PolicyNewtonAlgorithm(RandomState, PolicyNewtonUpdate):
    """Base of the cubic-regularised policy Newton algorithms.

    Each update minimises the cubic model of the cost J(θ) = -E[Σ_h γ^h r_h],

        m(s) = g·s + ½ sᵀ(ωH)s + (α/6)‖s‖³_M,

    with g and H estimated from whole episodes and M the Euclidean or the Fisher metric.

    Parameters
    ----------
    policy
        "MlpPolicy", "CnnPolicy", "MultiInputPolicy" or an ``ActorCriticPolicy`` class.
    env
        Environment, vectorised environment or registered id.
    learning_rate
        The critic's, a float or a schedule. The actor has none: its step is the cubic model's.
    n_steps
        Target timesteps per environment and update, met in whole episodes of the last update's
        mean length (at least one per environment). Before the first update one episode of each
        environment tells the length, and is not learnt from if more are to be run.
    n_episodes
        m_k, the episodes of the gradient: an int or a schedule; ``None``: from ``n_steps``.
    n_hessian_episodes
        b_k, the episodes of the Hessian, likewise; ``None``: the gradient's. Where the two
        differ, max(m_k, b_k) are simulated and each set is drawn without replacement.
    n_reused_rollouts
        Most earlier rollouts of the same call of ``learn`` that join each update, reweighted to
        the present policy (:class:`~sb3_crpn.episodes.Replay`), which ends for a rollout
        that has become too unlike it; 0: none, as in the paper.
    alpha
        α of the cubic term, a float or a schedule. With ``target_kl`` only the first guess.
    target_kl
        Mean KL divergence KL(old ‖ new) that each step keeps, met within 10 % by the choice of α;
        the mean is over states and action components, as in sb3-contrib's TRPO. Where the
        standard deviation of the λ-returns falls below a fifth of its recent maximum, steps are
        shorter in proportion. ``None``: α follows its schedule.
    metric
        "fisher": M = F + εI; "euclidean": M = I, the paper's; or a
        :class:`~sb3_crpn.curvature.Metric`.
    fisher_damping
        ε > 0 of "fisher".
    hessian_estimator
        "causal", or the paper's "trajectory"; or a :class:`~sb3_crpn.curvature.HessianEstimator`.
    hessian_lambda
        κ in [0, 1], the decay of the cross-time terms of "causal": 1 is unbiased.
    hessian_shrinkage
        ω in [0, 1]; "auto": the James-Stein factor from two groups of episodes; ``None``: 1; or a
        :class:`~sb3_crpn.curvature.Shrinkage`.
    krylov_dim
        Dimension of the Krylov space that steps are sought in; ``None``: 10 with ``target_kl`` or
        the Fisher metric, else as large as the solver's certificate needs.
    gamma
        Discount factor.
    gae_lambda
        λ of the generalised advantage estimator; 1: episode returns-to-go.
    baseline
        Subtract the critic's V(s_i) from the returns-to-go.
    normalize_advantage
        Scale and shift the advantages to standard deviation 1 and mean 0 over each batch.
    discount_visitation
        Keep the factor γ^i of step i, which the derivatives of J have and which is usually
        dropped.
    bootstrap_truncated
        Add γV(s_H) where a time limit ended the episode.
    horizon
        H, the step after which episodes are cut; ``None``: episodes end by themselves.
    batch_size
        Minibatch size of the critic.
    n_critic_updates
        Passes over the rollout that fit the critic in each update, after the actor's step; earlier
        rollouts that join share in these minibatches.
    max_batch_timesteps
        Most timesteps whose graphs are held in memory at a time, in runs of whole episodes, so
        that the longest episode is the least; ``None``: the whole batch. Batches beyond it cost
        a forward pass more at every product; results are the same to rounding.
    use_sde, sde_sample_freq, rollout_buffer_class, rollout_buffer_kwargs, stats_window_size
        As in SB3's on-policy algorithms; the buffer class must be an ``EpisodeRolloutBuffer``.
    tensorboard_log, policy_kwargs, verbose, seed, device, _init_setup_model
        As in SB3's on-policy algorithms.

    Raises
    ------
    ValueError
        An argument is out of range; the message names it, its value and what is allowed.

    References
    ----------
    Maniyar, Prashanth L.A., Mondal, Bhatnagar, A Cubic-regularized Policy Newton Algorithm for
    Reinforcement Learning, AISTATS 2024.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": ActorCriticPolicy,
        "CnnPolicy": ActorCriticCnnPolicy,
        "MultiInputPolicy": MultiInputActorCriticPolicy,
    }

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        n_steps: int = 1024,
        n_episodes: int | Schedule | None = None,
        n_hessian_episodes: int | Schedule | None = None,
        n_reused_rollouts: int = 3,
        alpha: float | Schedule = 1.0,
        target_kl: float | None = 0.02,
        metric: str | Metric = "fisher",
        fisher_damping: float = 0.1,
        hessian_estimator: str | HessianEstimator = "causal",
        hessian_lambda: float = 0.9,
        hessian_shrinkage: float | Literal["auto"] | Shrinkage | None = "auto",
        krylov_dim: int | None = None,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        baseline: bool = True,
        normalize_advantage: bool = True,
        discount_visitation: bool = False,
        bootstrap_truncated: bool = True,
        horizon: int | None = None,
        batch_size: int = 128,
        n_critic_updates: int = 20,
        max_batch_timesteps: int | None = None,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[EpisodeRolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: torch.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_sb3_arguments(
            policy,
            env,
            env_required=_init_setup_model,
            policy_kwargs=policy_kwargs,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
        )
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=0.0,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose if rank() == 0 else 0,
            seed=seed,
            device=device,
            _init_setup_model=False,
            supported_action_spaces=(
                spaces.Box,
                spaces.Discrete,
                spaces.MultiDiscrete,
                spaces.MultiBinary,
            ),
        )
        self.n_episodes = n_episodes
        self.n_hessian_episodes = n_hessian_episodes
        self.n_reused_rollouts = n_reused_rollouts
        self.alpha = alpha
        self.target_kl = target_kl
        self.metric = metric
        self.fisher_damping = fisher_damping
        self.hessian_estimator = hessian_estimator
        self.hessian_lambda = hessian_lambda
        self.hessian_shrinkage = hessian_shrinkage
        self.krylov_dim = krylov_dim
        self.baseline = baseline
        self.normalize_advantage = normalize_advantage
        self.discount_visitation = discount_visitation
        self.bootstrap_truncated = bootstrap_truncated
        self.horizon = horizon
        self.batch_size = batch_size
        self.n_critic_updates = n_critic_updates
        self.max_batch_timesteps = max_batch_timesteps
        self.kl_control = KLControl()
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_arguments(self)
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = (
                DictEpisodeRolloutBuffer if is_dict else EpisodeRolloutBuffer
            )
        super()._setup_model()
        fuse(self.policy.optimizer)
        self.alpha_schedule = FloatSchedule(self.alpha)
        self.replay = Replay(self.n_reused_rollouts, self.gamma, self.gae_lambda)
        self.actor = self._find_actor()

    def _find_actor(self) -> ActorParameters:
        """Select the parameters that log π depends on, by gradient reachability."""
        self.policy.set_training_mode(False)
        zeros = _zero_observation(self.observation_space)
        distribution = self.policy.get_distribution(self.policy.obs_to_tensor(zeros)[0])
        log_prob = distribution.log_prob(distribution.mode().detach())
        return ActorParameters.reachable(self.policy, log_prob)

    def _excluded_save_params(self) -> list[str]:
        own = ["actor", "alpha_schedule", "replay", "last_update", "_collecting", "_statistics"]
        return [*super()._excluded_save_params(), *own]

    def learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train for at least ``total_timesteps``, as SB3's algorithms do."""
        self.replay.clear()  # the environment may be another one
        self.last_update = None
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )


def _zero_observation(space: spaces.Space[Any]) -> Any:
    """Return an observation of zeros."""
    if isinstance(space, spaces.Dict):
        return {key: _zero_observation(subspace) for key, subspace in space.spaces.items()}
    return np.zeros(space.shape or (), dtype=space.dtype)
