"""The table from which the constructor's defaults were chosen: one factor at a time.

    python -m benchmarks.defaults --envs CartPole-v1 Pendulum-v1 --seeds 5
    python -m benchmarks.defaults --table

Runs every missing (algorithm, setting, environment, seed) in parallel processes, appends a row
each to ``benchmarks/defaults.csv`` as it ends, and prints the table. The peer is sb3-contrib's
TRPO with the hyperparameters of rl-zoo, which needs the ``zoo`` extra.
"""

from __future__ import annotations

import argparse
import ast
import csv
import itertools
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib.util import find_spec
from multiprocessing import get_context
from pathlib import Path
from typing import Any

CSV = Path(__file__).with_suffix(".csv")
KEYS = ("algo", "setting", "env", "timesteps", "seed")
COLUMNS = (*KEYS, "mean_return", "final_return", "seconds")


def _make_trpo(env_id: str, seed: int) -> Any:
    """Return TRPO as tuned in rl-zoo for this environment."""
    import yaml
    from sb3_contrib import TRPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    root = Path(str(find_spec("rl_zoo3").submodule_search_locations[0]))  # type: ignore
    tuned = yaml.safe_load((root / "hyperparams" / "trpo.yml").read_text())[env_id]
    tuned = {key: float(v) if key == "learning_rate" else v for key, v in tuned.items()}
    env: Any = make_vec_env(env_id, n_envs=tuned.pop("n_envs", 1), seed=seed)
    if tuned.pop("normalize", False):
        env = VecNormalize(env, gamma=tuned.get("gamma", 0.99))
    del tuned["n_timesteps"]
    return TRPO(env=env, seed=seed, device="cpu", **tuned)


def _make(algo: str, setting: str, env_id: str, seed: int) -> Any:
    from stable_baselines3.common.env_util import make_vec_env

    import sb3_crpn

    if algo == "TRPO":
        return _make_trpo(env_id, seed)
    arguments = dict(part.split("=") for part in setting.split(",")) if setting else {}
    arguments = {key: ast.literal_eval(value) for key, value in arguments.items()}
    env = make_vec_env(env_id, n_envs=arguments.pop("n_envs", 1), seed=seed)
    policy_class = getattr(sb3_crpn, algo)
    return policy_class("MlpPolicy", env, seed=seed, device="cpu", **arguments)


def run(algo: str, setting: str, env_id: str, timesteps: int, seed: int) -> dict[str, Any]:
    """Train once; return the mean return over training steps and the final deterministic one."""
    import torch
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.vec_env import VecNormalize

    torch.set_num_threads(1)
    episodes: list[tuple[float, int]] = []

    class Record(BaseCallback):
        def _on_step(self) -> bool:
            ended = (info["episode"] for info in self.locals["infos"] if "episode" in info)
            episodes.extend((episode["r"], episode["l"]) for episode in ended)
            return True

    start = time.perf_counter()
    model = _make(algo, setting, env_id, seed)
    model.learn(timesteps, callback=Record())
    seconds = time.perf_counter() - start
    env = model.get_env()
    if isinstance(env, VecNormalize):
        env.training, env.norm_reward = False, False
    final, _ = evaluate_policy(model, env, n_eval_episodes=20, warn=False)
    # every environment step counts the return of its episode
    mean = sum(r * steps for r, steps in episodes) / sum(steps for _, steps in episodes)
    values = (algo, setting, env_id, timesteps, seed, mean, final, seconds)
    return dict(zip(COLUMNS, values, strict=True))


def read() -> list[dict[str, str]]:
    """Return the rows measured so far."""
    if not CSV.exists():
        return []
    with CSV.open() as file:
        return list(csv.DictReader(file))


def table() -> str:
    """Return a Markdown table: mean over seeds of mean return / final return, with the SE."""
    import numpy as np

    groups = defaultdict(list)
    for row in read():
        groups[row["env"], row["algo"], row["setting"]].append(
            (float(row["mean_return"]), float(row["final_return"]))
        )
    lines = [
        "| environment | algorithm | setting | seeds | mean return | final return |",
        "|---|---|---|---|---|---|",
    ]
    for (env, algo, setting), values in sorted(groups.items()):
        data = np.array(values)
        error = data.std(0, ddof=1) / np.sqrt(len(data)) if len(data) > 1 else [np.nan, np.nan]
        cells = [f"{m:.0f} ± {e:.0f}" for m, e in zip(data.mean(0), error, strict=True)]
        lines.append(f"| {env} | {algo} | {setting or '-'} | {len(data)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--algos", nargs="+", default=["CRPN"])
    parser.add_argument("--settings", nargs="+", default=[""], help="e.g. target_kl=0.01,gamma=1")
    parser.add_argument("--envs", nargs="+", default=["CartPole-v1", "Acrobot-v1", "Pendulum-v1"])
    parser.add_argument("--timesteps", type=int, default=100_000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="only print the table")
    args = parser.parse_args()
    if not args.table:
        done = {tuple(row[key] for key in KEYS) for row in read()}
        wanted = itertools.product(range(args.seeds), args.settings, args.algos, args.envs)
        jobs = [
            job
            for seed, setting, algo, env in wanted
            if tuple(map(str, job := (algo, setting, env, args.timesteps, seed))) not in done
        ]
        _run_all(jobs, args.jobs)
    print(table())


def _run_all(jobs: list[tuple[Any, ...]], n_processes: int) -> None:
    from tqdm import tqdm

    with ProcessPoolExecutor(n_processes, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(run, *job) for job in jobs]
        for future in tqdm(as_completed(futures), total=len(futures)):
            is_new = not CSV.exists()
            with CSV.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS)
                if is_new:
                    writer.writeheader()
                writer.writerow(future.result())


if __name__ == "__main__":
    main()
