"""Train, save, load and ask for help with an installed package.

A script, not a test module: `PYTHON tests/wheel.py`, outside the source tree, with the interpreter
that the package is installed for.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import sb3_crpn
from sb3_crpn import ACRPN, CRPN
from sb3_crpn.zoo import config_file

with tempfile.TemporaryDirectory() as folder:
    for algorithm in (CRPN, ACRPN):
        model = algorithm("MlpPolicy", "CartPole-v1", n_episodes=2, seed=0, device="cpu").learn(50)
        path = Path(folder) / "model"
        model.save(path)
        loaded = algorithm.load(path, device="cpu")
        observation = np.zeros((1, 4), dtype=np.float32)
        action = model.predict(observation, deterministic=True)[0]
        assert loaded.predict(observation, deterministic=True)[0] == action
        assert (loaded.actor.vector == model.actor.vector).all()
assert config_file("crpn").is_file()
subprocess.run([sys.executable, "-m", "sb3_crpn", "--help"], check=True, capture_output=True)
print(f"{sb3_crpn.__file__}: trained, saved and loaded")
