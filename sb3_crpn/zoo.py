"""rl-zoo's command line with CRPN and ACRPN.

``python -m sb3_crpn.zoo train --algo crpn --env CartPole-v1`` runs rl_zoo3's own script, with its
own options, after both algorithms have joined rl_zoo3's registries. rl_zoo3 is imported only then:
it is optional, and it patches Gymnasium's ``TimeLimit``.
"""

from __future__ import annotations

import argparse
import atexit
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_crpn import ACRPN, CRPN
from sb3_crpn.checks import not_allowed
from sb3_crpn.cli import parse
from sb3_crpn.distributed import broadcast, init_from_env, rank, world_size

if TYPE_CHECKING:
    from optuna import Trial

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"crpn": CRPN, "acrpn": ACRPN}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of rl_zoo3's scripts, named by the first of the command line's ``arguments``.

    Raises
    ------
    SystemExit
        The arguments are wrong, or rl_zoo3 or what it needs is not installed.
    """
    parsed = parse(arguments)
    try:
        import rl_zoo3.cli
    except ModuleNotFoundError as error:
        sys.exit(f'sb3-crpn: {error}; install the extra: pip install ".[zoo]" in a clone')
    register()
    options = parsed.options
    if parsed.script == "train":
        options = [*zoo_options(options), *_config(options)]
    sys.argv = ["sb3-crpn", parsed.script, *options]
    rl_zoo3.cli.main()


def register() -> None:
    """Add both algorithms to rl_zoo3's registries: class, Optuna sampler, converter."""
    from rl_zoo3.hyperparams_opt import (
        HYPERPARAMS_CONVERTER,
        HYPERPARAMS_SAMPLER,
        convert_onpolicy_params,
    )
    from rl_zoo3.utils import ALGOS

    # in place: rl_zoo3's modules have imported these very dicts by name
    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(crpn=sample_crpn_params, acrpn=sample_acrpn_params)
    HYPERPARAMS_CONVERTER.update(dict.fromkeys(ALGORITHMS, convert_onpolicy_params))


def zoo_options(options: Sequence[str]) -> list[str]:
    """Join the run that ``torchrun`` started and return this rank's options for rl-zoo's ``train``.

    All ranks get the seed of rank 0. The others print nothing, evaluate nothing, and write below a
    temporary folder of their own. Without ``torchrun`` the options stay as they are.

    Raises
    ------
    ValueError
        A search for hyperparameters is asked for: its trials are independent runs.
    """
    init_from_env()
    if world_size() == 1:
        return list(options)
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--seed", type=int, default=-1)
    parser.add_argument("-optimize", "--optimize-hyperparameters", action="store_true")
    parsed = parser.parse_known_args(options)[0]
    if parsed.optimize_hyperparameters:
        raise ValueError(
            "-optimize is not allowed with torchrun: start several processes that share a "
            "--storage and a --study-name"
        )
    seed = parsed.seed if parsed.seed >= 0 else int(np.random.default_rng().integers(2**32))
    quiet: Iterable[str] = ()
    if rank() > 0:
        folder = tempfile.TemporaryDirectory()
        atexit.register(folder.cleanup)
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 until the process ends
        quiet = ("--log-folder", folder.name, "--eval-freq", "-1", "--save-freq", "-1")
    return [*options, "--seed", str(int(broadcast(torch.tensor(seed)))), *quiet]


def config_file(name: str) -> Path:
    """Return the path of ``zoo_configs/NAME.yml``.

    crpn and acrpn are the defaults of ``sb3-crpn train``, crpn_paper and acrpn_paper the paper's
    experiments; crpn_16_envs and crpn_64_envs are for so many environments.

    Raises
    ------
    ValueError
        There is no such file.
    """
    installed = Path(str(resources.files("sb3_crpn"))) / "zoo_configs"
    folder = installed if installed.is_dir() else installed.parents[1] / "zoo_configs"
    files = {file.stem: file for file in sorted(folder.glob("*.yml"))}
    if name not in files:
        raise not_allowed("config_file: name", name, f"one of {', '.join(files)}")
    return files[name]


def _config(options: Sequence[str]) -> list[str]:
    """Return the option that names a file of ours, to stand after the ``options``.

    It is the algorithm's where they name none, and that which ``--conf-file crpn_16_envs`` names,
    with or without ``.yml``, where no file of the user's has this name.
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("-conf", "--conf-file")
    parsed = parser.parse_known_args(options)[0]
    if parsed.conf_file is None:
        return ["--conf-file", str(config_file(parsed.algo))] if parsed.algo in ALGORITHMS else []
    try:
        ours = config_file(parsed.conf_file.removesuffix(".yml"))
    except ValueError:
        return []
    return [] if Path(parsed.conf_file).exists() else ["--conf-file", str(ours)]


def sample_crpn_params(
    trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Draw CRPN's hyperparameters for a trial of rl_zoo3's search, as constructor arguments.

    Names and ranges are those of rl_zoo3's samplers where these have them.
    """
    from rl_zoo3.hyperparams_opt import convert_onpolicy_params

    sampled = {
        "n_steps_pow": trial.suggest_int("n_steps_pow", 8, 12),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 9),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.0001, 0.03, log=True),
        "one_minus_gae_lambda": trial.suggest_float("one_minus_gae_lambda", 0.0001, 0.1, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
        "n_reused_rollouts": trial.suggest_int("n_reused_rollouts", 0, 7),
        "n_critic_updates": trial.suggest_int("n_critic_updates", 5, 30),
        "target_kl": trial.suggest_float("target_kl", 0.001, 0.3, log=True),
        "fisher_damping": trial.suggest_float("fisher_damping", 1e-3, 1.0, log=True),
        "hessian_lambda": trial.suggest_float("hessian_lambda", 0.0, 1.0),
        "krylov_dim": trial.suggest_int("krylov_dim", 5, 30),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium"]),
        "activation_fn": trial.suggest_categorical("activation_fn", ["tanh", "relu"]),
    }
    converted: dict[str, Any] = convert_onpolicy_params(sampled)
    for name in ("n_steps", "batch_size", "gamma", "gae_lambda"):
        trial.set_user_attr(name, converted[name])  # the values behind powers and differences
    return converted


def sample_acrpn_params(
    trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Draw ACRPN's hyperparameters: those of CRPN and N̂."""
    shared = sample_crpn_params(trial, n_actions, n_envs, additional_args)
    return shared | {"subsolver_steps": trial.suggest_int("subsolver_steps", 10, 200, log=True)}


if __name__ == "__main__":
    main()
