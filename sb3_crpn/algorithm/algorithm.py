"""PolicyNewtonAlgorithm: the arguments that CRPN and ACRPN have in common."""

from __future__ import annotations

import io
import os
import pathlib
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    BasePolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_crpn.algorithm.arguments import check_arguments, check_sb3_arguments
from sb3_crpn.algorithm.checkpoint import (
    load_random_state,
    read_random_state,
    replaced_in_one_go,
)
from sb3_crpn.algorithm.critic import fuse
from sb3_crpn.algorithm.distributed_training import DistributedTraining
from sb3_crpn.algorithm.rollouts import warn_of_endless_episodes
from sb3_crpn.algorithm.update import PolicyNewtonUpdate
from sb3_crpn.curvature.derivatives import HessianEstimator
from sb3_crpn.distributed import rank, rank_seed
from sb3_crpn.episodes import (
    DictEpisodeRolloutBuffer,
    EpisodeRolloutBuffer,
    EpisodeTracker,
    Replay,
    Tracker,
)
from sb3_crpn.episodes.collector import all_finite
from sb3_crpn.episodes.running_moments import RunningMoments
from sb3_crpn.parameters import ActorParameters
from sb3_crpn.policy import find_actor, find_actor_anywhere, to_tensor

Self = TypeVar("Self", bound="PolicyNewtonAlgorithm")


class PolicyNewtonAlgorithm(PolicyNewtonUpdate):
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
        "fisher": M = F + εI; "euclidean": M = I, the paper's.
    fisher_damping
        ε > 0 of the Fisher metric.
    hessian_estimator
        "causal", or the paper's "trajectory".
    hessian_lambda
        κ in [0, 1], the decay of the causal estimator's cross-time terms: 1 is unbiased.
    hessian_shrinkage
        ω in [0, 1]; "auto": the James-Stein factor from two groups of episodes; ``None``: 1.
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

    _actor: ActorParameters | None = None
    _actor_among: Sequence[tuple[torch.Tensor, bool]] = ()
    _rng: np.random.Generator = np.random.default_rng()
    _saved_random_state: dict[str, Any] | None = None

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
        metric: Literal["euclidean", "fisher"] = "fisher",
        fisher_damping: float = 0.1,
        hessian_estimator: HessianEstimator = "causal",
        hessian_lambda: float = 0.9,
        hessian_shrinkage: float | Literal["auto"] | None = "auto",
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
        self.hessian_estimator: HessianEstimator = hessian_estimator
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
        self.tracker: Tracker = EpisodeTracker()
        if self.env is not None and self.tracker.whole_episodes and self.horizon is None:
            warn_of_endless_episodes(self.env)

    @property
    def actor(self) -> ActorParameters:
        """The parameters θ that log π depends on, looked for again where the policy has others.

        The policy, or layers of it, may be replaced, frozen or unfrozen at any time.
        """
        present = [(tensor, tensor.requires_grad) for tensor in self.policy.parameters()]
        if self._actor is None or not _same(present, self._actor_among):
            self.policy.set_training_mode(False)
            if self._last_obs is None:
                self._actor = find_actor_anywhere(self.policy, self.observation_space)
            else:
                self._actor = find_actor(self.policy, to_tensor(self.policy, self._last_obs))
            self._actor_among = present
        return self._actor

    def _excluded_save_params(self) -> list[str]:
        found = ["_actor", "_actor_among"]
        derived = ["alpha_schedule", "replay", "tracker", "ranks", "_collecting"]
        return [*super()._excluded_save_params(), *found, *derived]

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed Python, NumPy, PyTorch, the environments and the model's own generator.

        Every rank but the first seeds them with a hash of ``seed`` and its number.
        """
        self._seed(None if seed is None else rank_seed(seed))

    def _seed(self, seed: int | None) -> None:
        super().set_random_seed(seed)
        self._rng = np.random.default_rng(seed)

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
        with torch.enable_grad():
            return super().learn(
                total_timesteps=total_timesteps,
                callback=callback,
                log_interval=log_interval,
                tb_log_name=tb_log_name or type(self).__name__,
                reset_num_timesteps=reset_num_timesteps,
                progress_bar=progress_bar,
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        state, self._saved_random_state = self._saved_random_state, None
        if self.seed is None or reset_num_timesteps:
            state = None
        if rank() > 0:
            callback, progress_bar = None, False
            self.set_logger(Logger(folder=None, output_formats=[]))
            if state is not None and self.seed is not None:
                self._seed(rank_seed(self.seed, self.num_timesteps))
        normalizer = self.get_vec_normalize_env()
        self.ranks = DistributedTraining(self.policy, normalizer)
        moments = None if normalizer is None else RunningMoments(normalizer)
        before = None if moments is None else moments.snapshot()
        total_timesteps, callback = super()._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        if moments is not None and before is not None and not all_finite(self._last_obs):
            moments.restore(before)
        if state is not None and rank() == 0:
            load_random_state(state, self.device)
            self._rng = state["model"]
        return total_timesteps, self.ranks.callback(callback)

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """Save all attributes, parameters and random states in a zip file; rank 0 alone does.

        A file of that name is replaced at the end, in one go: whatever happens in between leaves
        it intact. ``learn(reset_num_timesteps=False)`` of a loaded model with a seed restores the
        random states, so that it goes on as if it had not stopped; loading for evaluation touches
        nothing. The environments' own generators are theirs to save.
        """
        if rank() > 0:
            return
        self._saved_random_state = {**read_random_state(self.device), "model": self._rng}
        try:
            if not isinstance(path, str | os.PathLike):
                super().save(path, exclude, include)
                return
            file = path if pathlib.Path(path).suffix else f"{path}.zip"  # as SB3 does
            with replaced_in_one_go(file) as stream:
                super().save(stream, exclude, include)
        finally:
            self._saved_random_state = None


def _same(
    present: Sequence[tuple[torch.Tensor, bool]], earlier: Sequence[tuple[torch.Tensor, bool]]
) -> bool:
    return len(present) == len(earlier) and all(
        now is then and trainable == was_trainable
        for (now, trainable), (then, was_trainable) in zip(present, earlier, strict=True)
    )
