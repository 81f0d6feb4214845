"""The hyperparameters and the budget of an algorithm on an environment.

Peers run with those that rl-zoo publishes for the environment; where it has none, with the nearest
entry: another version of the same task, else the one named in ``NEAREST``. CRPN and ACRPN run with
the repository's ``zoo_configs``, which fall back to the constructor's defaults.
"""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sb3_crpn import PAPER, zoo

# Environment steps of a run
BUDGETS: dict[str, int] = {
    "CartPole-v1": 100_000,
    "Acrobot-v1": 100_000,
    "MountainCar-v0": 100_000,
    "MountainCarContinuous-v0": 100_000,
    "Pendulum-v1": 100_000,
    "LunarLander-v3": 200_000,
    "LunarLanderContinuous-v3": 200_000,
    "Reacher-v5": 300_000,
    "InvertedPendulum-v5": 300_000,
    "InvertedDoublePendulum-v5": 300_000,
    "Swimmer-v5": 300_000,
    "Hopper-v5": 300_000,
    "HalfCheetah-v5": 300_000,
    "Walker2d-v5": 300_000,
    "Ant-v5": 300_000,
    "FetchReachDense-v4": 100_000,
}

# The entry for tasks that a file of hyperparameters lacks in every version. rl-zoo's Hopper-v4 is
# its MuJoCo default for A2C and TRPO, and Ant-v4 is for PPO; the Bullet entries for the pendulums
# are marked "To be tuned", the one for Reacher "Tuned".
_NO_MUJOCO_ENTRY = {
    "InvertedPendulum-v5": "Hopper-v4",
    "InvertedDoublePendulum-v5": "Hopper-v4",
    "Reacher-v5": "ReacherBulletEnv-v0",
    "FetchReachDense-v4": "Hopper-v4",
}
_DISCRETE = ("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "LunarLander-v3")
_BY_ACTIONS = {env: "CartPole-v1" if env in _DISCRETE else "Reacher-v5" for env in BUDGETS}
NEAREST: dict[str, dict[str, str]] = {
    "a2c.yml": _NO_MUJOCO_ENTRY,
    "trpo.yml": _NO_MUJOCO_ENTRY,
    "ppo.yml": {"FetchReachDense-v4": "Ant-v4"},
    "crpn_paper.yml": _BY_ACTIONS,
    "acrpn_paper.yml": _BY_ACTIONS,
}

# Settings of a run that are no constructor arguments, with rl-zoo's defaults
_OF_ENVIRONMENT = {"n_envs": 1, "normalize": False}
# Arguments that do not affect learning, or that every run sets
_NOT_RECORDED = {
    "env", "n_timesteps", "seed", "device", "verbose", "tensorboard_log", "stats_window_size",
    "rollout_buffer_class", "rollout_buffer_kwargs", "_init_setup_model",
}  # fmt: skip
# CRPN's arguments that a gradient step does not use
_NOT_REINFORCE = {
    "alpha", "target_kl", "metric", "fisher_damping", "hessian_estimator", "hessian_lambda",
    "hessian_shrinkage", "krylov_dim", "n_hessian_episodes",
}  # fmt: skip


# TRPO with the settings of CRPN's entry in place of rl-zoo's
TRPO_EQUAL = "TRPO-equal"
# An entry's settings that are not the constructor's keyword arguments
_OF_ENTRY = {*_OF_ENVIRONMENT, "policy", "n_timesteps"}
# Steps of every episode where nothing but the time limit ends one. CRPN's updates are made of whole
# episodes, so that they have no fewer steps of each environment.
_EPISODE_STEPS = {"HalfCheetah-v5": 1000, "Swimmer-v5": 1000}


@dataclass(frozen=True)
class Algorithm:
    """A learner of the benchmark.

    Attributes
    ----------
    zoo_name
        Its key in rl-zoo's table of algorithms.
    config
        File name of its hyperparameters: in ``zoo_configs`` or, for peers, in rl_zoo3.
    is_peer
        Whether the hyperparameters are rl-zoo's.
    is_paper
        Whether it is the paper's algorithm: without an entry, ``PAPER``.
    """

    zoo_name: str
    config: str
    is_peer: bool = False
    is_paper: bool = False

    @property
    def config_path(self) -> Path:
        """Where the hyperparameters are."""
        if self.is_peer:
            return _zoo_package() / "hyperparams" / self.config
        return zoo.config_file(self.config.removesuffix(".yml"))


ALGORITHMS: dict[str, Algorithm] = {
    "CRPN": Algorithm("crpn", "crpn.yml"),
    "ACRPN": Algorithm("acrpn", "acrpn.yml"),
    "CRPN-paper": Algorithm("crpn", "crpn_paper.yml", is_paper=True),
    "ACRPN-paper": Algorithm("acrpn", "acrpn_paper.yml", is_paper=True),
    "REINFORCE": Algorithm("reinforce", "crpn.yml"),
    TRPO_EQUAL: Algorithm("trpo", "crpn.yml"),
    "A2C": Algorithm("a2c", "a2c.yml", is_peer=True),
    "PPO": Algorithm("ppo", "ppo.yml", is_peer=True),
    "TRPO": Algorithm("trpo", "trpo.yml", is_peer=True),
}
# Uniformly random actions: the zero of normalised scores
RANDOM = "Random"


def resolve(
    algo: str, env_id: str, overrides: Mapping[str, Any], *, defaults: bool = False
) -> tuple[str, dict[str, Any]]:
    """Return the entry's name and the hyperparameters in rl-zoo's format.

    Parameters
    ----------
    algo
        A key of ``ALGORITHMS``, or ``RANDOM``.
    env_id
        Registered id.
    overrides
        Hyperparameters in place of the entry's.
    defaults
        Take the constructor's defaults in place of the entry.
    """
    if algo == RANDOM:
        return "-", {}
    algorithm = ALGORITHMS[algo]
    entries = {} if defaults else _load(algorithm.config_path)
    found = find_entry(entries, env_id, NEAREST.get(algorithm.config, {}))
    if found is not None:
        name, entry = f"{algorithm.config}: {found}", entries[found]
    else:
        name, entry = "defaults", {"policy": "MlpPolicy", **(PAPER if algorithm.is_paper else {})}
    if algo == "REINFORCE":
        entry = {key: value for key, value in entry.items() if key not in _NOT_REINFORCE}
    elif algo == TRPO_EQUAL:
        entry = _equal_settings(entry, env_id)
    return name, {**entry, **overrides}


def update_timesteps(algo: str, entry: Mapping[str, Any]) -> int:
    """Return an update's ``n_steps`` times the number of environments."""
    n_steps = entry.get("n_steps", _signature(ALGORITHMS[algo].zoo_name)["n_steps"])
    return int(n_steps * entry.get("n_envs", 1))


def changes_for(env_id: str, n_envs: int) -> dict[str, Any]:
    """Return what CRPN's entry for so many environments changes in its usual one; {} without."""
    try:
        entry = _load(zoo.config_file(f"crpn_{n_envs}_envs")).get(env_id, {})
    except ValueError:  # there is no such file
        return {}
    usual = resolve("CRPN", env_id, {})[1]
    return {key: value for key, value in entry.items() if usual.get(key) != value}


def _equal_settings(entry: Mapping[str, Any], env_id: str) -> dict[str, Any]:
    """Return an entry of CRPN's as TRPO's: the arguments that both constructors have.

    What the entry leaves out is CRPN's default. Both algorithms fit the critic by
    ``n_critic_updates`` passes over the update's own rollout in minibatches of ``batch_size``, with
    Adam at ``learning_rate``, so that the same three numbers are the same critic work for each
    environment step.
    """
    defaults = _signature("crpn")
    shared = defaults.keys() & _signature("trpo").keys() - _NOT_RECORDED
    settings = {
        **{key: defaults[key] for key in sorted(shared) if defaults[key] is not None},
        **{key: value for key, value in entry.items() if key in shared | _OF_ENTRY},
    }
    settings["n_steps"] = max(settings["n_steps"], _EPISODE_STEPS.get(env_id, 0))
    return settings


def find_entry(entries: Mapping[str, Any], env_id: str, nearest: Mapping[str, str]) -> str | None:
    """Return the entry's key: exact, the task's newest version, the nearest, "default" or none."""
    if env_id in entries:
        return env_id
    task = re.sub(r"-v\d+$", "", env_id)
    versions = [key for key in entries if re.fullmatch(rf"{re.escape(task)}-v\d+", key)]
    if versions:
        return max(versions, key=lambda key: int(key.rsplit("-v", 1)[1]))
    name = nearest.get(env_id, "default")
    return name if name in entries else None


def parse_setting(setting: str) -> dict[str, Any]:
    """Return ``"n_steps=1024,metric=euclidean"`` as a dict.

    Values that are no Python literals stay text, which rl-zoo then reads:
    ``learning_rate=lin_1e-3`` or ``policy_kwargs=dict(net_arch=[])``.

    Raises
    ------
    ValueError
        The text is not a list of ``key=value``.
    """
    source = f"dict({setting})"
    message = f"setting={setting!r} is not allowed, must be key=value,..."
    try:
        call = ast.parse(source, mode="eval").body
    except SyntaxError as error:
        raise ValueError(message) from error
    if not isinstance(call, ast.Call) or call.args or not all(k.arg for k in call.keywords):
        raise ValueError(message)
    parsed = {}
    for keyword in call.keywords:
        text = ast.get_source_segment(source, keyword.value)
        try:
            parsed[keyword.arg] = ast.literal_eval(keyword.value)
        except ValueError:
            parsed[keyword.arg] = text
    return parsed


def setting_label(overrides: Mapping[str, Any], *, defaults: bool = False) -> str:
    """Return ``"key=value,..."``, in front ``"defaults"`` where they stand in for the entry."""
    label = ["defaults"] if defaults else []
    return ",".join([*label, *(f"{key}={value}" for key, value in sorted(overrides.items()))])


def describe(algo: str, hyperparameters: Mapping[str, Any]) -> str:
    """Return ``"key=value; ..."`` of all hyperparameters, the constructor's defaults included.

    It is what tells two runs apart: a row of other hyperparameters is not this run's.
    """
    if algo == RANDOM:
        return ""
    known = {**_OF_ENVIRONMENT, **_signature(ALGORITHMS[algo].zoo_name), **hyperparameters}
    unused = _NOT_RECORDED | (_NOT_REINFORCE if algo == "REINFORCE" else set())
    known = {key: value for key, value in known.items() if key not in unused}
    return "; ".join(f"{key}={_compact(known[key])}" for key in sorted(known))


def same_hyperparameters(first: str, second: str) -> bool:
    """Return whether two descriptions agree on every key that both have.

    An argument that the constructor gained in between does not make a run another one.
    """
    one, other = _read(first), _read(second)
    return all(one[key] == other[key] for key in one.keys() & other.keys())


def _read(description: str) -> dict[str, str]:
    parts = (part.partition("=") for part in description.split("; ") if part)
    return {key: value for key, _, value in parts}


def _compact(value: object) -> str:
    return re.sub(r"\s+", " ", str(value))


@cache
def _signature(zoo_name: str) -> dict[str, Any]:
    """Return the constructor's arguments that have a default."""
    from sb3_contrib import TRPO
    from stable_baselines3 import A2C, PPO

    from benchmarks.reinforce import REINFORCE

    # not rl-zoo's table: importing rl_zoo3 patches gymnasium, which is left to the workers
    classes = {"a2c": A2C, "ppo": PPO, "trpo": TRPO, "reinforce": REINFORCE, **zoo.ALGORITHMS}
    arguments = inspect.signature(classes[zoo_name]).parameters.values()
    return {a.name: a.default for a in arguments if a.default is not a.empty}


@cache
def _zoo_package() -> Path:
    spec = find_spec("rl_zoo3")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("the benchmark needs rl_zoo3: pip install sb3-crpn[zoo]")
    return Path(spec.origin).parent


@cache
def _load(path: Path) -> dict[str, dict[str, Any]]:
    import yaml

    entries: dict[str, dict[str, Any]] = yaml.safe_load(path.read_text())
    return entries
