"""Checks of constructor arguments: the argument, its value, and what is allowed."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import get_device

from sb3_crpn.curvature import HESSIAN_ESTIMATORS, METRICS, SHRINKAGES
from sb3_crpn.episodes import EpisodeRolloutBuffer

Function = TypeVar("Function", bound=Callable[..., Any])


def check_choice(name: str, value: object, allowed: Collection[object]) -> None:
    """Require one of the ``allowed`` values."""
    if value not in allowed:
        options = ", ".join(repr(option) for option in allowed)
        raise ValueError(f"{name}={value!r} is not allowed, must be one of {options}")


def check_flag(name: str, value: object) -> None:
    """Require a bool."""
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}={value!r} is not allowed, must be True or False")


def check_integer(name: str, value: object, minimum: int) -> None:
    """Require a whole number of at least ``minimum``."""
    if not _is_number(value, (int, np.integer)) or value < minimum:  # type: ignore[operator]
        raise ValueError(f"{name}={value!r} is not allowed, must be an integer >= {minimum}")


def check_real(
    name: str,
    value: object,
    low: float,
    high: float = float("inf"),
    *,
    open_low: bool = False,
) -> None:
    """Require a finite number in [low, high], or in (low, high]."""
    number = (
        float(value)  # type: ignore[arg-type]
        if _is_number(value, (int, float, np.integer, np.floating))
        else float("nan")
    )
    if not (np.isfinite(number) and low <= number <= high and not (open_low and number == low)):
        interval = f"{'(' if open_low else '['}{low:g}, {high:g}{')' if np.isinf(high) else ']'}"
        raise ValueError(f"{name}={value!r} is not allowed, must be a finite number in {interval}")


def check_schedule(name: str, value: object, check: Callable[[str, object], None]) -> None:
    """Require a value that passes ``check``, or a callable of the remaining progress."""
    if not callable(value):
        check(name, value)


def check_optional(name: str, value: object, check: Callable[[str, object], None]) -> None:
    """Require ``None`` or a value that passes ``check``."""
    if value is not None:
        check(name, value)


def check_arguments(model: Any) -> None:
    """Check every constructor argument of a ``PolicyNewtonAlgorithm`` but the policy and env.

    Raises
    ------
    ValueError
        For the first one that is out of range.
    """
    positive = partial(check_real, low=0.0, open_low=True)
    fraction = partial(check_real, low=0.0, high=1.0)
    at_least_one = partial(check_integer, minimum=1)
    at_least_zero = partial(check_integer, minimum=0)
    schedule = partial(check_schedule, check=at_least_one)
    rules: dict[str, Callable[[str, object], None]] = {
        "learning_rate": partial(check_schedule, check=partial(check_real, low=0.0)),
        "n_steps": at_least_one,
        "n_episodes": partial(check_optional, check=schedule),
        "n_hessian_episodes": partial(check_optional, check=schedule),
        "n_reused_rollouts": at_least_zero,
        "alpha": partial(check_schedule, check=positive),
        "target_kl": partial(check_optional, check=positive),
        "metric": METRICS.check,
        "fisher_damping": positive,
        "hessian_estimator": HESSIAN_ESTIMATORS.check,
        "hessian_lambda": fraction,
        "hessian_shrinkage": _check_shrinkage,
        "krylov_dim": partial(check_optional, check=at_least_one),
        "gamma": fraction,
        "gae_lambda": fraction,
        "baseline": check_flag,
        "normalize_advantage": check_flag,
        "discount_visitation": check_flag,
        "bootstrap_truncated": check_flag,
        "horizon": partial(check_optional, check=at_least_one),
        "batch_size": at_least_one,
        "n_critic_updates": at_least_zero,
        "max_batch_timesteps": partial(check_optional, check=at_least_one),
        "use_sde": check_flag,
        "sde_sample_freq": partial(check_integer, minimum=-1),
        "rollout_buffer_class": _check_buffer_class,
        "_stats_window_size": at_least_one,
        "seed": _check_seed,
    }
    for name, rule in rules.items():
        rule(name.lstrip("_"), getattr(model, name))


def check_sb3_arguments(
    policy: object, env: object, *, env_required: bool, **arguments: Any
) -> None:
    """Check the arguments that SB3 passes on unchecked, before it does."""
    if not isinstance(policy, str) and not (
        isinstance(policy, type) and issubclass(policy, ActorCriticPolicy)
    ):
        raise ValueError(
            f"policy={policy!r} is not allowed, must be a name or a subclass of ActorCriticPolicy"
        )
    if env is None and env_required:
        raise ValueError("env=None is not allowed, must be an environment or a registered id")
    for name in ("policy_kwargs", "rollout_buffer_kwargs"):
        if not isinstance(arguments[name], dict | None):
            raise ValueError(f"{name}={arguments[name]!r} is not allowed, must be None or a dict")
    log = arguments["tensorboard_log"]
    if not isinstance(log, str | os.PathLike | None):
        raise ValueError(f"tensorboard_log={log!r} is not allowed, must be None or a path")
    verbose = arguments["verbose"]
    if not _is_number(verbose, (int, np.integer)) or verbose not in (0, 1, 2):
        raise ValueError(f"verbose={verbose!r} is not allowed, must be one of 0, 1, 2")
    device = arguments["device"]
    try:
        if not isinstance(device, str | torch.device):
            raise TypeError
        get_device(device)
    except (RuntimeError, TypeError):
        raise ValueError(
            f'device={device!r} is not allowed, must be "auto" or a device of PyTorch'
        ) from None


def _check_seed(name: str, value: object) -> None:
    # NumPy's legacy generator, which SB3 seeds, takes 32 bits
    if value is not None and not (
        _is_number(value, (int, np.integer)) and 0 <= value < 2**32  # type: ignore[operator]
    ):
        raise ValueError(
            f"{name}={value!r} is not allowed, must be None or an integer in [0, 2^32)"
        )


def _check_shrinkage(name: str, value: object) -> None:
    if value is not None and not SHRINKAGES.accepts(value):
        try:
            check_real(name, value, 0.0, 1.0)
        except ValueError as error:
            raise ValueError(f"{error}, or None, or {SHRINKAGES.allowed}") from None


def _check_buffer_class(name: str, value: object) -> None:
    if value is not None and not (
        isinstance(value, type) and issubclass(value, EpisodeRolloutBuffer)
    ):
        raise ValueError(
            f"{name}={value!r} is not allowed, must be None or a subclass of EpisodeRolloutBuffer"
        )


def _is_number(value: object, kinds: tuple[type, ...]) -> bool:
    return isinstance(value, kinds) and not isinstance(value, (bool, np.bool_))


def inherits_arguments(parent: type) -> Callable[[Function], Function]:
    """Show the arguments of ``parent.__init__`` in the signature of an ``__init__(**kwargs)``.

    So ``help`` and editors list every argument and default, each written in one place only.
    """

    def decorate(function: Function) -> Function:
        inherited = list(inspect.signature(parent.__init__).parameters.values())  # type: ignore[misc]
        own = [
            parameter
            for parameter in inspect.signature(function).parameters.values()
            if parameter.name != "self"
            and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        ]
        function.__signature__ = inspect.Signature(inherited + own)  # type: ignore[attr-defined]
        return function

    return decorate
