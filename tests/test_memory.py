"""Peak memory, of fresh processes."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
TIMESTEPS = 30_000
# 3 GiB for a million timesteps, in MiB
LIMIT = 3072 * TIMESTEPS / 1_000_000


def growth(*options):
    """MiB that an update adds to what is there before the first rollout."""
    command = [sys.executable, "-m", "benchmarks.memory", f"--timesteps={TIMESTEPS}"]
    done = subprocess.run(
        [*command, "--krylov-dim=2", *options], cwd=ROOT, capture_output=True, text=True, check=True
    )
    before, peak = map(int, re.findall(r"peak memory.*: (\d+) MiB", done.stdout))
    return peak - before


def test_memory_is_bounded_where_batches_are_split():
    assert growth("--max-batch-timesteps=2000") < LIMIT < growth()
