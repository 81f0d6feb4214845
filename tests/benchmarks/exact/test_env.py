import numpy as np
import torch
from gymnasium.utils.env_checker import check_env
from stable_baselines3 import PPO

from benchmarks.exact import (
    TabularEnv,
    TabularVectorEnv,
    actor_vector,
    assign_actor,
    coordination_mdp,
    random_mdp,
)
from sb3_crpn import CRPN, PAPER
from sb3_crpn.vec_env import GymnasiumVecEnv
from tests.mdp import differs

MDP = random_mdp(0, n_states=4, n_observations=3, horizon=4)
THETA = torch.randn(8, generator=torch.Generator().manual_seed(0)).double()


def model(mdp=MDP, n_envs=2000, algorithm=CRPN, **arguments):
    env = GymnasiumVecEnv(TabularVectorEnv(mdp, n_envs))
    settings = {"policy_kwargs": {"net_arch": []}, "gamma": mdp.gamma, "n_steps": mdp.horizon}
    return algorithm("MlpPolicy", env, seed=0, device="cpu", **settings, **arguments)


def test_gymnasium_accepts_it():
    check_env(TabularEnv(MDP), skip_render_check=True)


def test_mean_costs_are_exact_one_episode_at_a_time():
    env, rng, costs = TabularEnv(MDP), np.random.default_rng(0), []
    env.reset(seed=0)
    for _ in range(1000):
        env.reset()
        steps = [env.step(int(action)) for action in rng.integers(2, size=MDP.horizon)]
        assert [terminated for _, _, terminated, _, _ in steps] == [False, False, False, True]
        costs.append([-sum(MDP.gamma**h * reward for h, (_, reward, *_) in enumerate(steps))])
    exact = MDP.cost(torch.zeros(8, dtype=torch.float64)).item()
    assert not differs(costs, [exact])
    assert differs(costs, [exact + 0.3])


def test_terminal_observations_are_those_of_the_finished_episode():
    env = GymnasiumVecEnv(TabularVectorEnv(coordination_mdp(), 5))
    env.seed(0)
    assert (env.reset() == [1, 0]).all()
    observations, rewards, dones, _ = env.step(np.array([0, 1, 0, 1, 0]))
    assert (observations == [0, 1]).all()
    assert not rewards.any()
    assert not dones.any()
    observations, rewards, dones, infos = env.step(np.array([0, 0, 1, 1, 0]))
    assert (observations == [1, 0]).all()
    assert rewards.tolist() == [1, -1, -1, 1, 1]
    assert dones.all()
    assert [info["episode"]["r"] for info in infos] == [1, -1, -1, 1, 1]
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_estimates_in_the_environment_are_those_of_the_mdp():
    """The order of θ, its signs, and the powers of γ, all at once."""
    learner = model(**PAPER)
    assign_actor(learner.policy, THETA)
    estimates = [learner.estimate_curvature(2000) for _ in range(20)]
    gradients = torch.stack([estimate.gradient for estimate in estimates])
    hessians = torch.stack([estimate.hessian.to_dense() for estimate in estimates])
    theta = learner.actor.vector
    assert not differs(gradients, MDP.gradient(theta))
    assert not differs(hessians, MDP.hessian(theta))
    assert differs(gradients, MDP.gradient(-theta))
    assert differs(hessians, MDP.hessian(-theta))


def test_the_vector_of_any_sb3_policy():
    for learner in (model(n_envs=2), model(n_envs=2, algorithm=PPO, batch_size=8)):
        assign_actor(learner.policy, THETA)
        assert torch.equal(actor_vector(learner.policy), THETA)
        if isinstance(learner, CRPN):
            assert torch.equal(learner.actor.vector, THETA)
