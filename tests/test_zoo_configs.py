"""The YAML files: complete, commented, and valid for the constructors."""

import inspect
import re

import gymnasium as gym
import pytest
import yaml
from torch import nn

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.zoo import ALGORITHMS, config_file

robotics = pytest.importorskip("gymnasium_robotics", reason="gymnasium-robotics is not installed")
gym.register_envs(robotics)

CLASSIC = ["CartPole-v1", "Acrobot-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1"]
BOX2D = ["LunarLander-v3", "LunarLanderContinuous-v3"]
MUJOCO = [
    "InvertedPendulum-v5",
    "InvertedDoublePendulum-v5",
    "Reacher-v5",
    "Swimmer-v5",
    "Hopper-v5",
    "HalfCheetah-v5",
    "Walker2d-v5",
    "Ant-v5",
    "Humanoid-v5",
]
ROBOTICS = ["FetchReachDense-v4", "PointMaze_UMaze-v3"]
PAPER_ENVS = {"CartPole-v1": [], "Reacher-v5": [32, 32], "Humanoid-v5": [64, 64]}
# Keys that rl_zoo3 takes for itself
RL_ZOO = {"n_timesteps", "n_envs", "normalize"}


def entries(name):
    return yaml.safe_load(config_file(name).read_text())


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_environment_has_an_entry(algo):
    assert list(entries(algo)) == ["default", *CLASSIC, *BOX2D, *MUJOCO, *ROBOTICS]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_entry_says_whether_it_was_tuned(algo):
    text = config_file(algo).read_text()
    commented = re.findall(r"^# (?:Tuned|To be tuned)\n(\S+):", text, re.MULTILINE)
    assert commented == list(entries(algo))[1:]


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_normalised_rewards_are_discounted_as_the_algorithm_does(algo):
    # rl_zoo3 passes gamma to VecNormalize only if the entry has it
    assert all("gamma" in entry for entry in entries(algo).values() if entry.get("normalize"))


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("name", ["{}", "{}_paper"])
def test_keys_are_arguments(algo, name):
    arguments = set(inspect.signature(ALGORITHMS[algo]).parameters)
    for env, entry in entries(name.format(algo)).items():
        assert set(entry) - arguments <= RL_ZOO, env


@pytest.mark.parametrize("n_envs", [16, 64])
def test_entries_for_many_environments_say_all_that_the_usual_ones_say(n_envs):
    many, usual = entries(f"crpn_{n_envs}_envs"), entries("crpn")
    assert list(many) == ["CartPole-v1", "Acrobot-v1", "Pendulum-v1", "Hopper-v5", "HalfCheetah-v5"]
    for env_id, entry in many.items():
        assert usual[env_id].keys() <= entry.keys()
        assert entry["n_envs"] == n_envs
        CRPN(env=env_id, **{key: entry[key] for key in entry.keys() - RL_ZOO - {"policy_kwargs"}})


@pytest.mark.parametrize("env_id", [*CLASSIC, *BOX2D, *MUJOCO, *ROBOTICS])
def test_entries_build_models(env_id):
    env = gym.make(env_id)
    for algo, algorithm in ALGORITHMS.items():
        entry = entries(algo)[env_id]
        arguments = {key: value for key, value in entry.items() if key not in RL_ZOO}
        if "policy_kwargs" in arguments:  # text, which rl-zoo evaluates
            arguments["policy_kwargs"] = eval(arguments["policy_kwargs"], {"nn": nn})
        algorithm(env=env, **arguments)
    env.close()


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_the_papers_experiments_have_its_settings(algo):
    paper = entries(f"{algo}_paper")
    assert list(paper) == list(PAPER_ENVS)
    for env_id, layers in PAPER_ENVS.items():
        entry = paper[env_id]
        assert {key: entry[key] for key in PAPER} == PAPER
        linear = env_id == "CartPole-v1"
        assert (entry["alpha"], entry["n_episodes"]) == ((1e3, 50) if linear else (1e4, 100))
        assert entry["gamma"] == 0.99
        assert eval(entry["policy_kwargs"], {"nn": nn})["net_arch"] == layers


def test_the_papers_linear_policy_is_linear():
    arguments = entries("crpn_paper")["CartPole-v1"]
    del arguments["n_timesteps"]
    arguments["policy_kwargs"] = eval(arguments["policy_kwargs"])
    for algorithm in (CRPN, ACRPN):
        assert len(algorithm(env="CartPole-v1", **arguments).actor) == 2 * (4 + 1)
