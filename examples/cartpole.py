"""Train CRPN on CartPole-v1, evaluate it, and save the model and its learning curve."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import matplotlib
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.results_plotter import X_TIMESTEPS, plot_results

from sb3_crpn import CRPN

TIMESTEPS = 60_000


def main() -> None:
    """Run the whole example."""
    torch.set_num_threads(1)  # on so small a network threads cost more than they bring
    run = Path("runs") / f"CartPole-v1_{datetime.now():%Y%m%d-%H%M%S}"
    env = make_vec_env("CartPole-v1", n_envs=4, seed=0, monitor_dir=str(run / "monitor"))
    model = CRPN("MlpPolicy", env, n_steps=512, target_kl=0.01, seed=0, device="cpu")
    model.learn(TIMESTEPS, progress_bar=True)
    model.save(run / "model")

    mean, std = evaluate_policy(model, env, n_eval_episodes=20)
    matplotlib.use("Agg")
    plot_results([str(run / "monitor")], TIMESTEPS, X_TIMESTEPS, "CRPN on CartPole-v1")
    curve = run / "learning_curve.png"
    matplotlib.pyplot.savefig(curve, dpi=120)
    print(f"score: {mean:.1f} ± {std:.1f} over 20 episodes (solved: 475)")
    print(f"model: {run / 'model.zip'}")
    print(f"learning curve: {curve}")


if __name__ == "__main__":
    main()
