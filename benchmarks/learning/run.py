"""One training run: one row of results and its learning curve."""

from __future__ import annotations

import contextlib
import io
import platform
import tempfile
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.learning.settings import (
    ALGORITHMS,
    BUDGETS,
    RANDOM,
    describe,
    resolve,
    setting_label,
)
from sb3_crpn import zoo

N_BINS = 50  # points of a learning curve
N_EVAL_EPISODES = 20
EVAL_SEED = 10_000  # plus the run's seed: episodes that training has not seen

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """A training run. Its identifying fields are the leading columns of the results."""

    algo: str
    env: str
    setting: str
    timesteps: int
    seed: int
    hyperparameters: str
    entry: str
    arguments: dict[str, Any] = field(compare=False, repr=False)


@dataclass(frozen=True)
class Result:
    """Outcome of a run.

    Attributes
    ----------
    row
        Result columns by name: returns are raw, of whole episodes.
    curve
        The ``N_BINS`` points of :func:`learning_curve`.
    """

    row: dict[str, Any]
    curve: Sequence[tuple[int, float]]


def make_run(
    algo: str,
    env: str,
    seed: int,
    overrides: Mapping[str, Any],
    *,
    timesteps: int | None = None,
    defaults: bool = False,
) -> Run:
    """Return the run of an entry with some hyperparameters overridden.

    Parameters
    ----------
    algo, env, seed
        What tells runs apart.
    overrides
        Hyperparameters in place of the entry's.
    timesteps
        Budget; ``None``: the benchmark's.
    defaults
        Take the constructor's defaults in place of the entry.
    """
    entry, arguments = resolve(algo, env, overrides, defaults=defaults)
    return Run(
        algo=algo,
        env=env,
        setting="" if algo == RANDOM else setting_label(overrides, defaults=defaults),
        timesteps=timesteps or BUDGETS[env],
        seed=seed,
        hyperparameters=describe(algo, arguments),
        entry=entry,
        arguments=arguments,
    )


def execute(run: Run) -> Result:
    """Train or, for the random policy, evaluate."""
    if run.env.startswith(("Fetch", "PointMaze")):
        import gymnasium as gym
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
    with contextlib.redirect_stdout(io.StringIO()):  # rl-zoo prints what it does
        return _evaluate_random(run) if run.algo == RANDOM else _train(run)


def _train(run: Run) -> Result:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import sync_envs_normalization

    with tempfile.TemporaryDirectory() as folder:
        manager, model = set_up(run, Path(folder))
        recorder = _episode_recorder(run.timesteps)
        wall, cpu = time.perf_counter(), time.process_time()
        model.learn(run.timesteps, callback=recorder)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        eval_env = manager.create_envs(1, eval_env=True)
        eval_env.seed(EVAL_SEED + run.seed)
        sync_envs_normalization(model.get_env(), eval_env)
        final, _ = evaluate_policy(model, eval_env, N_EVAL_EPISODES, deterministic=True, warn=False)
        n_envs, steps = model.n_envs, min(model.num_timesteps, run.timesteps)
        model.get_env().close()
        eval_env.close()
    mean, curve = learning_curve(recorder.episodes, n_envs, run.timesteps)
    row = {
        "mean_return": mean,
        "final_return": final,
        "steps": steps,
        "episodes": len(recorder.episodes),
        "updates": recorder.n_rollouts,
        "wall_seconds": wall,
        "cpu_seconds": cpu,
        "versions": versions(),
    }
    return Result(row, curve)


def set_up(run: Run, folder: Path) -> tuple[Any, Any]:
    """Return rl-zoo's manager and the model, made from the run's hyperparameters as rl-zoo does."""
    import yaml
    from rl_zoo3.exp_manager import ExperimentManager
    from rl_zoo3.utils import ALGOS

    from benchmarks.reinforce import REINFORCE

    zoo.register()
    ALGOS.update(reinforce=REINFORCE)  # in place, as zoo does
    arguments = {**run.arguments, "n_timesteps": run.timesteps}
    if _has_dict_observations(run.env):
        arguments["policy"] = "MultiInputPolicy"
    config = folder / "entry.yml"
    config.write_text(yaml.safe_dump({run.env: arguments}))
    manager = ExperimentManager(
        Namespace(),
        ALGORITHMS[run.algo].zoo_name,
        run.env,
        str(folder),
        n_timesteps=run.timesteps,
        eval_freq=-1,
        seed=run.seed,
        device="cpu",
        verbose=0,
        config=str(config),
    )
    experiment = manager.setup_experiment()
    assert experiment is not None  # it is None for optimisation
    return manager, experiment[0]


def _has_dict_observations(env_id: str) -> bool:
    import gymnasium as gym

    env = gym.make(env_id)
    env.close()
    return isinstance(env.observation_space, gym.spaces.Dict)


def _episode_recorder(timesteps: int) -> Any:
    """Return a callback that keeps (end step, length, return) of episodes and ends the budget."""
    from stable_baselines3.common.callbacks import BaseCallback

    class EpisodeRecorder(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.episodes: list[tuple[int, int, float]] = []
            self.n_rollouts = 0

        def _on_step(self) -> bool:
            # no algorithm trains on a rollout that exceeds the budget
            if self.num_timesteps > timesteps:
                return False
            for info in self.locals["infos"]:
                if "episode" in info:  # raw rewards: VecNormalize is outside the monitor
                    episode = info["episode"]
                    self.episodes.append((self.num_timesteps, episode["l"], episode["r"]))
            return True

        def _on_rollout_end(self) -> None:
            self.n_rollouts += 1

    return EpisodeRecorder()


def learning_curve(
    episodes: Sequence[tuple[int, int, float]], n_envs: int, timesteps: int
) -> tuple[float, list[tuple[int, float]]]:
    """Return the mean return over training and the learning curve.

    Every environment step counts the return of its episode: an episode of length l that ends at
    step t of all n environments took the steps (t - nl, t], every n-th of them. The mean is over
    all these steps, a point of the curve over those in its bin. Time limits end an episode; steps
    of episodes that a reset or the end of the budget cut have no return and count nowhere.

    Parameters
    ----------
    episodes
        (end step, length, return) of each.
    n_envs
        Parallel environments.
    timesteps
        The budget, divided into ``N_BINS`` bins.

    Returns
    -------
    mean
        NaN if no episode ended.
    curve
        (last step of the bin, mean return) of each bin; NaN where no finished episode reaches.
    """
    edges = np.linspace(0, timesteps, N_BINS + 1)
    ends, lengths, returns = np.array(episodes, dtype=np.float64).reshape(-1, 3).T
    first = np.maximum(edges[:-1], (ends - n_envs * lengths)[:, None])
    steps = np.clip(np.minimum(edges[1:], ends[:, None]) - first, 0, None)  # (episodes, bins)
    weights = steps.sum(0)
    sums = returns @ steps
    with np.errstate(invalid="ignore"):
        curve, mean = sums / weights, sums.sum() / weights.sum()
    return float(mean), [(round(e), float(v)) for e, v in zip(edges[1:], curve, strict=True)]


class _RandomPolicy:
    """Uniformly random actions, for ``evaluate_policy``."""

    def __init__(self, env: Any, seed: int) -> None:
        self.space, self.n_envs = env.action_space, env.num_envs
        self.space.seed(seed)

    def predict(self, observation: Any, state: Any = None, **_: Any) -> tuple[Any, Any]:
        return np.array([self.space.sample() for _ in range(self.n_envs)]), state


def _evaluate_random(run: Run) -> Result:
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    env = make_vec_env(run.env, seed=run.seed)
    wall, cpu = time.perf_counter(), time.process_time()
    policy: Any = _RandomPolicy(env, run.seed)
    returns, lengths = evaluate_policy(
        policy, env, N_EVAL_EPISODES, return_episode_rewards=True, warn=False
    )
    env.close()
    row = {
        "mean_return": np.average(returns, weights=lengths),
        "final_return": np.mean(returns),
        "steps": sum(lengths),
        "episodes": len(returns),
        "updates": 0,
        "wall_seconds": time.perf_counter() - wall,
        "cpu_seconds": time.process_time() - cpu,
        "versions": versions(),
    }
    return Result(row, [])


def versions() -> str:
    """Return the versions of the libraries that determine a result."""
    packages = (
        "sb3-crpn", "stable-baselines3", "sb3-contrib", "rl-zoo3", "gymnasium", "mujoco", "torch",
        "numpy",
    )  # fmt: skip
    found = [f"{package} {version(package)}" for package in packages]
    return "; ".join([f"python {platform.python_version()}", *found])
