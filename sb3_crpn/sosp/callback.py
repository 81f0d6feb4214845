"""SospCallback: certificates during training."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import sync_envs_normalization

from sb3_crpn.checks import COUNT, FLAG, NONE, VERBOSE, integer
from sb3_crpn.sosp.certificate import certify_sosp, checked_options
from sb3_crpn.sosp.report import SospReport
from sb3_crpn.sosp.target import ENVIRONMENT


class SospCallback(BaseCallback):
    """Certify the policy every ``eval_freq`` calls and log the verdict, for any on-policy model.

    Logs ``sosp/gradient_norm``, ``sosp/lambda_min`` and ``sosp/verdict``. The callback does not
    change training. It simulates episodes in a separate environment, and restores the policy's
    state and the random generators.

    Parameters
    ----------
    eval_freq
        Calls between certificates. A call is one step of all training environments.
    eval_env
        Environment of the certificates, wrapped like the training environment. The statistics of a
        ``VecNormalize`` are copied to it, as in ``EvalCallback``.
    n_episodes, epsilon, rho
        As in :func:`certify_sosp`. ``None`` chooses thresholds anew for each policy. Certificates
        along training are comparable only if both ε and ρ are given.
    stop_at_sosp
        End training at the first verdict "sosp".
    seed
        Seed of the sequence of certificates.
    verbose
        1: print each report.
    **options
        Further arguments of :func:`certify_sosp`.

    Raises
    ------
    ValueError
        An argument is out of range.
    TypeError
        An option is no argument of :func:`certify_sosp`.

    Attributes
    ----------
    report
        The latest :class:`SospReport`. ``None`` before the first.
    """

    def __init__(
        self,
        eval_freq: int,
        eval_env: GymEnv,
        n_episodes: int,
        epsilon: float | None = None,
        rho: float | None = None,
        *,
        stop_at_sosp: bool = False,
        seed: int | None = None,
        verbose: int = 0,
        **options: Any,
    ) -> None:
        name = type(self).__name__
        super().__init__(VERBOSE(f"{name}: verbose", verbose))
        self.eval_freq: int = COUNT(f"{name}: eval_freq", eval_freq)
        self.eval_env = eval_env
        self.stop_at_sosp: bool = FLAG(f"{name}: stop_at_sosp", stop_at_sosp)
        self.report: SospReport | None = None
        self._options = checked_options(
            name, n_episodes=n_episodes, epsilon=epsilon, rho=rho, **options
        )
        ENVIRONMENT(f"{name}: eval_env", eval_env)
        self._rng = np.random.default_rng((integer(0) | NONE)(f"{name}: seed", seed))

    def _init_callback(self) -> None:
        self._env = self.model._wrap_env(self.eval_env, monitor_wrapper=False)

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq:
            return True
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self._env)
        assert isinstance(self.model, OnPolicyAlgorithm)
        self.report = certify_sosp(
            self.model, env=self._env, seed=int(self._rng.integers(2**31)), **self._options
        )
        self._log(self.report)
        return not (self.stop_at_sosp and self.report.verdict == "sosp")

    def _log(self, report: SospReport) -> None:
        if self.verbose:
            print(report)
        self.logger.record("sosp/gradient_norm", report.gradient_norm.estimate)
        self.logger.record("sosp/lambda_min", report.lambda_min.estimate)
        self.logger.record("sosp/verdict", report.verdict)
        # written at once, as in EvalCallback, so that the timestep is that of the certificate
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
