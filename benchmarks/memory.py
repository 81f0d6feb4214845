"""Peak memory of one update: 64×64 MLP, 17-dimensional observations, actions of 6 components.

python -m benchmarks.memory --timesteps 1000000 --max-batch-timesteps 50000
"""

from __future__ import annotations

import argparse
import re
import resource
import sys
import time
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sb3_crpn import CRPN
from sb3_crpn.vec_env import GymnasiumVecEnv

EPISODE = 1000


class Noise(VectorEnv[Any, Any, Any]):
    """Random observations and rewards, of HalfCheetah-v5's shapes; episodes do not end."""

    metadata: ClassVar[dict[str, Any]] = {"autoreset_mode": AutoresetMode.DISABLED}

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (17,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng(0)

    def _observe(self) -> np.ndarray[Any, Any]:
        return self._rng.normal(size=(self.num_envs, 17)).astype(np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        """Observe."""
        return self._observe(), {}

    def step(self, actions: Any) -> Any:
        """Observe, with a random reward."""
        no = np.zeros(self.num_envs, dtype=bool)
        return self._observe(), self._rng.normal(size=self.num_envs), no, no, {}


def peak_memory() -> int:
    """Return the largest resident set of this process so far, in bytes.

    From Linux's ``VmHWM`` where there is one: ``ru_maxrss`` does not fall below what the process
    that started this one had.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s+(\d+) kB", status.read_text())):
        return 1024 * int(found[1])
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    """Train for one update and print the peak memory before and after it."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--timesteps", type=int, default=1_000_000)
    parser.add_argument("--max-batch-timesteps", type=int)
    parser.add_argument("--krylov-dim", type=int)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = CRPN(
        "MlpPolicy",
        GymnasiumVecEnv(Noise(arguments.timesteps // EPISODE)),
        n_steps=EPISODE,
        horizon=EPISODE,
        krylov_dim=arguments.krylov_dim,
        n_critic_updates=1,
        max_batch_timesteps=arguments.max_batch_timesteps,
        seed=0,
        device="cpu",
    )
    start, seconds = peak_memory(), time.perf_counter()
    model.learn(1)
    print(f"timesteps: {model.num_timesteps}")
    print(f"peak memory before the rollout: {start / 2**20:.0f} MiB")
    print(f"peak memory: {peak_memory() / 2**20:.0f} MiB")
    print(f"seconds: {time.perf_counter() - seconds:.0f}")


if __name__ == "__main__":
    main()
