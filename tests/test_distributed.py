"""Two ranks against one process: the same sums, the same step, one run."""

import csv
import os
import signal
from collections import defaultdict

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_crpn.algorithm.algorithm
from sb3_crpn import ACRPN, CRPN
from sb3_crpn.algorithm.critic import fit_critic
from sb3_crpn.algorithm.evaluation import CandidateEvaluator
from sb3_crpn.cubic import solve_dense
from sb3_crpn.curvature import (
    Causal,
    Euclidean,
    Fisher,
    FullModel,
    JamesStein,
    estimate_curvature,
    subspace_model,
)
from sb3_crpn.distributed import (
    RankError,
    all_max,
    all_sum,
    broadcast,
    gather_counts,
    local_count,
    local_mode,
    mean_and_variance,
    rank,
    rank_seed,
    world_size,
)
from sb3_crpn.zoo import zoo_options
from tests.envs import Drift, Faulty
from tests.policies import frozen_episodes, small_policy
from tests.ranks import run_ranks
from tests.test_determinism import ON_RANKS, check
from tests.training import make, tensors

LENGTHS = (3, 1, 4, 2, 5, 3, 6)
# Rank 0's episodes of these, and max_steps
SPLITS = {"odd": (3, None), "even": (4, None), "in pieces": (3, 4), "idle": (7, None)}


def test_one_process_is_left_alone(monkeypatch):
    tensor = torch.arange(3.0)
    assert (world_size(), rank()) == (1, 0)
    assert all_sum(tensor) is tensor
    assert broadcast(tensor) is tensor
    assert all_max(2.0) == 2.0
    assert local_count(7) == 7
    assert gather_counts(5) == [5]
    assert rank_seed(3) == 3
    values = np.random.default_rng(0).normal(5.0, 2.0, 1001)
    assert mean_and_variance(values) == (values.mean(), values.var())
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert zoo_options(["--env", "Pendulum-v1"]) == ["--env", "Pendulum-v1"]
    assert world_size() == 1


def primitives():
    own = torch.tensor([1.0, 10.0], dtype=torch.float64) / 3.0 ** (rank() + 1)
    before = own.clone()
    reduced = all_sum(own), broadcast(own)
    assert torch.equal(own, before)
    with local_mode():
        assert all_sum(own) is own
        assert (world_size(), rank()) == (1, 0)
    moments = mean_and_variance(np.arange(10.0)[:3] if rank() else np.arange(10.0)[3:])
    seeds = rank_seed(7), rank_seed(7, 1)
    numbers = all_max(float(rank())), gather_counts(5 + rank()), local_count(7)
    return own, *reduced, numbers, moments, seeds


def measured(n_of_rank_0, max_steps=None):
    """What this rank makes of its part of frozen episodes: all that an update depends on."""
    policy, actor = small_policy("gaussian")
    union = frozen_episodes(policy, LENGTHS)
    bounds = (0, n_of_rank_0, len(LENGTHS)) if world_size() > 1 else (0, len(LENGTHS))
    own = np.arange(bounds[rank()], bounds[rank() + 1])
    batch, few = union.take(own), union.take(own[own != 1])
    causal = Causal(0.9)
    estimate = estimate_curvature(policy, actor, batch, causal, max_steps=max_steps)
    other = estimate_curvature(policy, actor, few, causal, hessian_batch=batch, max_steps=max_steps)
    v = torch.linspace(-1.0, 1.0, len(actor), dtype=torch.float64)
    results = {
        "gradient": estimate.gradient,
        "gradient noise": torch.tensor(estimate.gradient_noise),
        "hessian": estimate.hessian @ v,
        "fisher": estimate.fisher @ v,
        "dense hessian": estimate.hessian.to_dense(),
        "gradient of few": other.gradient,
        "fisher of few": other.fisher @ v,
    }
    tester = CandidateEvaluator(policy, actor, batch, max_steps)
    for name, model in {
        "fisher": subspace_model(estimate, Fisher(0.1), JamesStein(), 5),
        "newton": subspace_model(estimate, Euclidean(), JamesStein()),
    }.items():
        step = model.to_parameters(solve_dense(model.gradient, model.hessian, 10.0).step)
        trial = tester.evaluate(step)
        results[f"{name} step"] = step
        results[f"{name} trial"] = torch.tensor([trial.kl, trial.surrogate_change])
        results[f"{name} shrinkage"] = torch.tensor(model.shrinkage)
    tester.restore()
    results["product"] = FullModel(other, 0.5).product(v)
    # one minibatch a pass, for which nothing is drawn
    loss = fit_critic(
        policy, actor, batch, n_minibatches=3, batch_size=100, rng=np.random.default_rng(rank())
    )
    results["critic"] = torch.nn.utils.parameters_to_vector(policy.parameters()).detach()
    results["critic loss"] = torch.tensor(loss)
    return results


class Probe(BaseCallback):
    """Uses the model as a callback may, while the other ranks wait; stops in mid-rollout."""

    def __init__(self, n_updates):
        super().__init__()
        self.n_updates = n_updates

    def _on_step(self):
        return self.model._n_updates < self.n_updates or self.locals["n_steps"] < 2

    def _on_rollout_end(self):
        self.gradient = self.model.estimate_curvature(2, DummyVecEnv([Drift])).gradient


def normalized(n_envs=2):
    return VecNormalize(DummyVecEnv([lambda: Drift(dim=0)] * n_envs))


class Watch:
    """Keeps what a rank's running moments are updated with, and the policy after updates."""

    def __init__(self, monkeypatch, env):
        update, give = RunningMeanStd.update, sb3_crpn.algorithm.algorithm.share_policy
        self.seen, self.states = defaultdict(list), []

        def recorded(moments, array):
            for name, ours in (("obs", env.obs_rms), ("ret", env.ret_rms)):
                if moments is ours:
                    self.seen[name].append(np.array(array))
            update(moments, array)

        def compared(policy):
            if world_size() > 1:  # not in a callback
                self.states.append({k: v.clone() for k, v in policy.state_dict().items()})
            give(policy)

        monkeypatch.setattr(RunningMeanStd, "update", recorded)
        monkeypatch.setattr(sb3_crpn.algorithm.algorithm, "share_policy", compared)


def trained(folder, algorithm, n_updates, **arguments):
    """Train, and return what a rank has seen and what all must agree on."""
    env = normalized()
    model = make(algorithm, env, seed=7, **arguments)
    model.set_logger(configure(f"{folder}/log_{rank()}", ["csv"]))
    evaluation = EvalCallback(
        normalized(1), eval_freq=15, n_eval_episodes=1, log_path=f"{folder}/eval", verbose=0
    )
    checkpoints = CheckpointCallback(30, f"{folder}/checkpoints", save_vecnormalize=True)
    callbacks = [Probe(n_updates), evaluation, checkpoints]
    with pytest.MonkeyPatch.context() as monkeypatch:
        watch = Watch(monkeypatch, env)
        model.learn(100_000, callbacks)
    model.save(f"{folder}/saved_by_{rank()}")
    return {
        "states": watch.states,
        "seen": {name: np.concatenate(arrays) for name, arrays in watch.seen.items()},
        "moments": {"obs": env.obs_rms, "ret": env.ret_rms},
        "timesteps": model.num_timesteps,
        "alpha": model.kl_control.alpha,
        "length": model.rollouts.mean_episode_length,
        "actions": model.rollout_buffer.actions[:4].flatten().tolist(),
        "outputs": len(model.logger.output_formats),
        "calls": [callback.n_calls for callback in callbacks],
    }


def continued(folder, env):
    model = CRPN.load(f"{folder}/crpn/saved_by_0", env, device="cpu")
    before = model.num_timesteps, tensors(model)
    model.learn(300, reset_num_timesteps=False)
    return model, before


def on_both(folder):
    results = {"primitives": primitives()}
    for name, (n_of_rank_0, max_steps) in SPLITS.items():
        results[name] = measured(n_of_rank_0, max_steps)
    results["crpn"] = trained(f"{folder}/crpn", CRPN, 8, n_episodes=5)
    results["again"] = trained(f"{folder}/again", CRPN, 2, n_episodes=5)
    # one episode for g: rank 1 has none
    few = {"n_episodes": 1, "n_hessian_episodes": 3, "metric": "euclidean", "target_kl": None}
    results["acrpn"] = trained(
        f"{folder}/acrpn", ACRPN, 5, alpha=100.0, hessian_shrinkage=None, baseline=True, **few
    )
    model, _ = continued(folder, normalized())
    results["continued"] = tensors(model)
    # optimisers import this module, whose defaults are the group of that time
    results["kept"] = torch.distributed.nn.functional.all_reduce.__defaults__[-1] is not None
    results["options"] = zoo_options(["--env", "Pendulum-v1"])
    results["seeded"] = zoo_options(["--seed", "3"])
    with pytest.raises(ValueError, match="-optimize is not allowed with torchrun"):
        zoo_options(["-optimize"])
    return results


def killed(folder):
    def die(*outcome):
        os.kill(os.getpid(), signal.SIGKILL)

    env = Faulty(Drift(), at=60, fault=die) if rank() else Drift()
    model = make(CRPN, env, n_episodes=2)
    try:
        model.learn(100_000, CheckpointCallback(5, f"{folder}/killed"))
    except RankError as error:
        return str(error), model.num_timesteps
    return None


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two_ranks")
    functions = [on_both, *ON_RANKS.values(), killed]
    codes, (results, *recorded, after_death) = run_ranks(functions, folder)
    assert codes == [0, -signal.SIGKILL]
    return folder, results, after_death, recorded


def test_nothing_keeps_the_group_after_its_end(two):
    assert not any(result["kept"] for result in two[1])


def test_sums_and_broadcasts(two):
    ranks = [result["primitives"] for result in two[1]]
    own = [each[0] for each in ranks]
    for r, (_, total, first, numbers, moments, _) in enumerate(ranks):
        assert torch.equal(total, own[0] + own[1])
        assert torch.equal(first, own[0])
        assert numbers == (1.0, [5, 6], [4, 3][r])
        assert moments == pytest.approx((4.5, 8.25))
    seeds = [each[-1] for each in ranks]
    assert seeds[0] == (7, 7)
    assert len({7, *seeds[1]}) == 3
    assert all(0 <= seed < 2**32 for seed in seeds[1])


@pytest.mark.parametrize("split", SPLITS)
def test_frozen_episodes_give_the_step_of_one_process(two, split):
    expected = measured(len(LENGTHS))
    first, second = (result[split] for result in two[1])
    for name, value in expected.items():
        assert torch.equal(first[name], second[name]), name
        torch.testing.assert_close(first[name], value, rtol=1e-6, atol=1e-9, msg=name)


@pytest.mark.parametrize(("run", "n_updates"), [("crpn", 8), ("acrpn", 5)])
def test_every_rank_takes_the_same_step_bit_for_bit(two, run, n_updates):
    first, second = (result[run] for result in two[1])
    assert len(first["states"]) == len(second["states"]) == n_updates
    for ours, theirs in zip(first["states"], second["states"], strict=True):
        assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert not torch.equal(
        first["states"][0]["action_net.weight"], first["states"][-1]["action_net.weight"]
    )
    for name in ("timesteps", "alpha", "length"):
        assert first[name] == second[name]
    assert first["timesteps"] == sum(len(each["seen"]["ret"]) for each in (first, second))


def test_two_ranks_are_as_recorded(two):
    for identity, (own, other) in zip(ON_RANKS, two[-1], strict=True):
        assert np.array_equal(own, other)
        check(identity, own)


@pytest.mark.parametrize("name", ["obs", "ret"])
def test_normalisation_is_by_the_statistics_of_the_union(two, name):
    runs = [result["crpn"] for result in two[1]]
    ours, theirs = (run["moments"][name] for run in runs)
    union = RunningMeanStd(shape=np.shape(ours.mean))
    union.update(np.concatenate([run["seen"][name] for run in runs]).astype(float))
    for attribute in ("count", "mean", "var"):
        value = getattr(ours, attribute)
        assert np.array_equal(value, getattr(theirs, attribute))
        np.testing.assert_allclose(value, getattr(union, attribute), rtol=1e-6)


def test_seeds_are_distinct_and_runs_repeat_each_other(two):
    ours, theirs = (result["crpn"] for result in two[1])
    assert ours["actions"] != theirs["actions"]
    for result in two[1]:
        first, second = result["crpn"], result["again"]
        last = second["states"][-1]
        assert all(torch.equal(last[name], tensor) for name, tensor in first["states"][1].items())


def test_rank_0_alone_logs_evaluates_and_saves(two):
    folder, results, *_ = two
    ours, theirs = (result["crpn"] for result in results)
    assert (ours["outputs"], theirs["outputs"]) == (1, 0)
    assert theirs["calls"] == [0, 0, 0]
    assert min(ours["calls"]) > 0
    run = folder / "crpn"
    rows = csv.DictReader((run / "log_0" / "progress.csv").read_text().splitlines())
    assert sum(bool(row["time/iterations"]) for row in rows) == 8
    assert (run / "log_1" / "progress.csv").read_text() == ""
    assert len(np.load(run / "eval" / "evaluations.npz")["timesteps"]) > 0
    assert sorted(path.name for path in run.glob("saved_by_*")) == ["saved_by_0.zip"]
    assert len(list((run / "checkpoints").glob("*.zip"))) == ours["calls"][-1] // 30


def test_two_ranks_go_on_from_one_file_and_so_does_one(two):
    folder, results, *_ = two
    ours, theirs = (result["continued"] for result in results)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    model, (timesteps, before) = continued(folder, normalized(3))
    assert timesteps == results[0]["crpn"]["timesteps"]
    assert all(
        torch.equal(tensor, results[0]["crpn"]["states"][-1][name])
        for name, tensor in before.items()
    )
    assert model.num_timesteps >= timesteps + 300
    assert not torch.equal(model.policy.action_net.weight, before["action_net.weight"])


def test_zoo_runs_have_one_seed_and_one_folder(two):
    (ours, theirs), (seeded, also) = (
        [result[name] for result in two[1]] for name in ("options", "seeded")
    )
    assert ours[:3] == ["--env", "Pendulum-v1", "--seed"] == theirs[:3]
    assert ours[3] == theirs[3]
    assert len(ours) == 4
    assert theirs[4] == "--log-folder"
    assert theirs[6:] == ["--eval-freq", "-1", "--save-freq", "-1"]
    assert seeded[-1] == also[3] == "3"


def test_a_killed_rank_ends_the_run_and_leaves_the_checkpoints(two):
    folder, _, (result, nothing), _ = two
    message, timesteps = result
    assert nothing is None
    assert "rank 0 of 2 lost another rank" in message
    saved = sorted((folder / "killed").iterdir(), key=lambda path: path.stat().st_mtime)
    assert all(path.suffix == ".zip" for path in saved)
    model = CRPN.load(saved[-1], Drift(), device="cpu")
    assert 30 < model.num_timesteps <= timesteps
    model.learn(50, reset_num_timesteps=False)
