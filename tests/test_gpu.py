"""Results on a GPU equal those on the CPU."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.distributed as dist

from sb3_crpn import CRPN, distributed
from sb3_crpn.algorithm.critic import fit_critic
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.cubic import solve_krylov
from sb3_crpn.curvature import (
    Causal,
    Constant,
    Euclidean,
    Fisher,
    FullModel,
    JamesStein,
    estimate_curvature,
    subspace_model,
)
from sb3_crpn.parameters import ActorParameters
from tests.envs import Drift
from tests.policies import ACTION_SPACES, frozen_episodes, log_probabilities, small_policy
from tests.ranks import run_ranks
from tests.training import TrainLog, all_finite, both, make, several

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
    pytest.mark.filterwarnings("ignore:You are trying to run .* on the GPU"),
]


def measured(kind, device):
    """All results of an update from fixed episodes, on the CPU."""
    policy, _ = small_policy(kind)
    batch = frozen_episodes(policy, lengths=(3, 1, 4, 2, 5))
    policy.to(device)
    batch = replace(
        batch, observations=batch.observations.to(device), actions=batch.actions.to(device)
    )
    actor = ActorParameters.reachable(policy, log_probabilities(policy, batch))
    results = {}
    for max_steps in (None, 5):
        estimate = estimate_curvature(policy, actor, batch, Causal(0.9), max_steps=max_steps)
        v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
        results |= {
            f"gradient {max_steps}": estimate.gradient,
            f"hessian {max_steps}": estimate.hessian @ v.to(device),
            f"fisher {max_steps}": estimate.fisher @ v,
            f"dense {max_steps}": estimate.hessian.to_dense(),
        }
        models = [
            subspace_model(estimate, Fisher(0.1), JamesStein(), 5),
            subspace_model(estimate, Euclidean(), Constant(0.5)),
            FullModel(estimate, 1.0),
        ]
        steps = [
            model.to_parameters(solve_krylov(model.gradient, model.product, 10.0).step)
            for model in models
        ]
        tester = CandidateEvaluator(policy, actor, batch, max_steps)
        for number, step in enumerate(steps):
            trial = tester.evaluate(step)
            effect = torch.tensor([trial.kl, trial.surrogate_change])
            results |= {f"step {number} {max_steps}": step, f"trial {number} {max_steps}": effect}
        tester.restore()
    options = {"n_minibatches": 8, "batch_size": 4, "rng": np.random.default_rng(0)}
    results["loss"] = torch.tensor(fit_critic(policy, actor, batch, **options))
    results["policy"] = torch.nn.utils.parameters_to_vector(policy.parameters()).detach()
    return {name: tensor.cpu() for name, tensor in results.items()}


@pytest.mark.parametrize("kind", ACTION_SPACES)
def test_frozen_episodes_give_what_they_give_on_the_cpu(kind):
    ours, expected = measured(kind, "cuda"), measured(kind, "cpu")
    for name, value in expected.items():
        torch.testing.assert_close(ours[name], value, rtol=1e-6, atol=1e-9, msg=name)


@both
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"metric": "euclidean", "target_kl": None, "hessian_shrinkage": None},
        {"metric": "euclidean", "krylov_dim": 4, "max_batch_timesteps": 20},
    ],
)
def test_training_saving_and_loading(algorithm, arguments, tmp_path):
    model = make(algorithm, Drift(dim=1), device="cuda", alpha=1e3, **arguments)
    log = TrainLog()
    model.learn(200, log)
    assert {p.device.type for p in model.policy.parameters()} == {"cuda"}
    assert all_finite(model)
    assert len(log.rows) > 2
    model.save(tmp_path / "model")
    for device in ("cpu", "cuda"):
        loaded = algorithm.load(tmp_path / "model", Drift(dim=1), device=device)
        assert torch.equal(loaded.actor.vector.cpu(), model.actor.vector.cpu())
        loaded.learn(100, reset_num_timesteps=False)
        assert all_finite(loaded)


def test_a_loaded_model_goes_on_with_the_noise_where_it_stopped(tmp_path):
    model = make(CRPN, device="cuda").learn(50)
    model.save(tmp_path / "model")
    state = torch.cuda.get_rng_state()
    loaded = CRPN.load(tmp_path / "model", Drift(), device="cuda")
    assert not torch.equal(torch.cuda.get_rng_state(), state)
    loaded.learn(0, reset_num_timesteps=False)
    assert torch.equal(torch.cuda.get_rng_state(), state)


def on_a_shared_gpu(folder):
    """The parameters of this rank after some updates."""
    assert dist.get_backend() == "gloo"  # two ranks of one GPU
    model = make(CRPN, several(2), device="cuda").learn(400)
    return model._n_updates, model.actor.vector.cpu(), model.num_timesteps


def nccl_messages(folder):
    """Reduce and broadcast over NCCL with a single rank."""
    torch.cuda.set_device(0)
    dist.init_process_group("cpu:gloo,cuda:nccl", rank=0, world_size=1)
    results = []
    for device, dtype in itertools.product(
        ("cpu", "cuda"), (torch.float32, torch.float64, torch.int64)
    ):
        sent = torch.arange(5, dtype=dtype, device=device)
        received = sent.clone()
        dist.broadcast(received, 0)
        results.append((sent, received, distributed._reduce(sent, dist.ReduceOp.SUM)))
    return [[tensor.cpu() for tensor in result] for result in results]


@pytest.mark.skipif(torch.cuda.device_count() > 1, reason="each rank would have a GPU of its own")
def test_ranks_that_share_a_gpu_take_the_same_steps(tmp_path):
    codes, [results] = run_ranks([on_a_shared_gpu], tmp_path)
    assert codes == [0, 0]
    assert results[0][0] >= 3
    assert torch.equal(results[0][1], results[1][1])
    assert results[0][::2] == results[1][::2]


def test_nccl_takes_every_message(tmp_path):
    codes, [[results]] = run_ranks([nccl_messages], tmp_path, n_ranks=1)
    assert codes == [0]
    for sent, *received in results:
        assert all(torch.equal(tensor, sent) for tensor in received)
