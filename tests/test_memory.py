"""Peak memory, of fresh processes."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
TIMESTEPS = 30_000
# 3 GiB for a million timesteps, in MiB
LIMIT = 3072 * TIMESTEPS / 1_000_000


def growth(*options):
    """MiB that an update adds to what is there before the first rollout."""
    command = [sys.executable, "-m", "benchmarks.speed.memory", f"--timesteps={TIMESTEPS}"]
    done = subprocess.run(
        [*command, "--krylov-dim=2", *options], cwd=ROOT, capture_output=True, text=True, check=True
    )
    row = json.loads(done.stdout)
    return row["peak"] - row["before"]


def test_memory_is_bounded_where_batches_are_split():
    assert growth("--max-batch-timesteps=2000") < LIMIT < growth()
