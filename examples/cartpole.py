"""Train CRPN on CartPole-v1, evaluate it while it learns, and draw its learning curve.

python examples/cartpole.py            # one seed: model and picture go to runs/
python examples/cartpole.py --seeds 5  # five seeds in one picture
"""

from __future__ import annotations

import argparse
from datetime import datetime
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import load_results

from sb3_crpn import CRPN

TIMESTEPS = 50_000
SOLVED = 475  # Gymnasium's threshold


def main() -> None:
    """Run the whole example."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=1, help="number of runs, seeds 0, 1, ...")
    parser.add_argument("--timesteps", type=int, default=TIMESTEPS, help="of each run")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # on so small a network threads cost more than they bring
    folder = Path("runs") / f"CartPole-v1_{datetime.now():%Y%m%d-%H%M%S}"
    runs = [folder / f"seed_{seed}" for seed in range(arguments.seeds)]
    for seed, run in enumerate(runs):
        print(f"CRPN on CartPole-v1, seed {seed}: {arguments.timesteps} timesteps")
        train(run, seed, arguments.timesteps)
    picture = folder / "learning_curve.png"
    draw(runs, picture)
    print(f"models: {folder}/seed_*/model.zip\nlearning curve: {picture}")


def train(run: Path, seed: int, timesteps: int) -> None:
    """Train with the default settings; evaluations use an environment of their own."""
    env = make_vec_env("CartPole-v1", seed=seed, monitor_dir=str(run / "training"))
    eval_env = make_vec_env("CartPole-v1", seed=1000 + seed)
    evaluations = EvalCallback(
        eval_env, n_eval_episodes=5, eval_freq=2_500, log_path=str(run), verbose=0
    )
    model = CRPN("MlpPolicy", env, seed=seed, device="cpu")
    model.learn(timesteps, evaluations, progress_bar=True)
    model.save(run / "model")
    mean, std = evaluate_policy(model, eval_env, n_eval_episodes=20)
    print(f"score: {mean:.1f} ± {std:.1f} over 20 episodes (solved: {SOLVED})")


def draw(runs: list[Path], picture: Path) -> None:
    """Draw all runs' training episodes, their means over 10, and the evaluations."""
    plt.switch_backend("Agg")
    figure, axes = plt.subplots(figsize=(7.0, 5.0), layout="constrained")
    axes.axhline(SOLVED, color="gray", ls="--", lw=1, label=f"solved: {SOLVED}")
    for number, run in enumerate(runs):
        first = number == 0
        episodes = load_results(str(run / "training"))
        steps, returns = episodes.l.cumsum(), episodes.r
        axes.plot(steps, returns, ".", color="C0", ms=2, alpha=0.2)
        mean = returns.rolling(10, min_periods=1).mean()
        axes.plot(steps, mean, color="C0", label="training, mean of 10 episodes" * first)
        saved = np.load(run / "evaluations.npz")
        evaluated = saved["results"].mean(axis=1)
        axes.plot(
            saved["timesteps"], evaluated, ".-", color="C1", label="evaluation, 5 episodes" * first
        )
    axes.set(xlabel="timesteps", ylabel="return", ylim=(0, 520))
    axes.set_title(f"CRPN on CartPole-v1, default settings, {len(runs)} seed{'s'[: len(runs) - 1]}")
    axes.legend(loc="lower right")
    figure.savefig(picture, dpi=120)


if __name__ == "__main__":
    main()
