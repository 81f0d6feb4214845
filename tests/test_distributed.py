import numpy as np
import torch

from sb3_crpn.distributed import (
    all_max,
    all_sum,
    broadcast,
    gather_counts,
    mean_and_variance,
    rank,
    rank_seed,
    share,
    world_size,
    zoo_options,
)


def test_one_process_is_left_alone(monkeypatch):
    tensor = torch.arange(3.0)
    assert (world_size(), rank()) == (1, 0)
    assert all_sum(tensor) is tensor
    assert broadcast(tensor) is tensor
    assert all_max(2.0) == 2.0
    assert share(7) == 7
    assert gather_counts(5) == [5]
    assert rank_seed(3) == 3
    values = np.random.default_rng(0).normal(5.0, 2.0, 1001)
    assert mean_and_variance(values) == (values.mean(), values.var())
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert zoo_options(["--env", "Pendulum-v1"]) == ["--env", "Pendulum-v1"]
    assert world_size() == 1
