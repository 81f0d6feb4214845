import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from sb3_crpn.distributed import all_sum, broadcast, world_size

N_RANKS = 2


def test_one_process_is_left_alone():
    tensor = torch.arange(3.0)
    assert world_size() == 1
    assert all_sum(tensor) is tensor
    assert broadcast(tensor) is tensor


def on_rank(rank, folder):
    dist.init_process_group(
        "gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=N_RANKS
    )
    tensor = torch.tensor([1.0, 10.0], dtype=torch.float64) / 3.0 ** (rank + 1)
    original = tensor.clone()
    results = [all_sum(tensor), broadcast(tensor), broadcast(tensor, source=1)]
    torch.save((world_size(), tensor, original, results), f"{folder}/{rank}.pt")
    dist.destroy_process_group()


def test_two_ranks_sum_and_broadcast(tmp_path):
    mp.spawn(on_rank, args=(str(tmp_path),), nprocs=N_RANKS)
    ranks = [torch.load(tmp_path / f"{rank}.pt") for rank in range(N_RANKS)]
    own = [original for _, _, original, _ in ranks]
    for size, tensor, original, results in ranks:
        assert size == N_RANKS
        assert torch.equal(tensor, original)
        for result, expected in zip(results, [own[0] + own[1], *own], strict=True):
            assert torch.equal(result, expected)
