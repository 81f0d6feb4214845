"""rl-zoo's scripts on CRPN and ACRPN: rl_zoo3 patches Gymnasium, so it runs in subprocesses."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml
from stable_baselines3.common.save_util import load_from_pkl

from sb3_crpn.zoo import ALGORITHMS, _config, config_file, main

ROOT = Path(__file__).parents[1]
# Episodes of 200 steps: two environments take 400 to the update
ENV = "Pendulum-v1"
SMALL = "-params n_envs:2 n_steps:200 normalize:True gamma:0.9"
# Runs several command lines with one import of rl_zoo3
CHAIN = """
import sys
import sb3_crpn.zoo

print(sb3_crpn.__file__)
for line in sys.argv[1:]:
    sb3_crpn.zoo.main(line.split())
"""
SHORT = (
    f"train --algo {{}} --env {ENV} -params n_steps:200 -n 400 --eval-freq 200 --eval-episodes 2"
)
# A configuration in Python: rl_zoo3 reads schedules from YAML for the learning rate alone
SCHEDULES = f"""
from stable_baselines3.common.utils import LinearSchedule

hyperparams = {{
    "{ENV}": {{
        "n_timesteps": 200,
        "policy": "MlpPolicy",
        "learning_rate": "lin_1e-3",
        "alpha": LinearSchedule(100.0, 10.0, 1.0),
        "n_episodes": LinearSchedule(1, 2, 1.0),
        "target_kl": None,
    }}
}}
"""
# An entry that asks for timesteps in place of episodes
TIMESTEPS = f"""
{ENV}:
  n_envs: 3
  n_timesteps: 300
  policy: MlpPolicy
  normalize: true
  gamma: 0.9
  rollout: timesteps
  n_steps: 50
"""


def run(command, folder, **environment):
    """Run ``command`` in ``folder``, away from the source tree, and return what it prints."""
    variables = {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg", **environment}
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout
    return done.stdout


def source_tree_lines(algo):
    """Training, going on, enjoying, plotting and a search, in the order of the runs' numbers."""
    train = f"train --algo {algo} --env {ENV}"
    enjoy = f"enjoy --algo {algo} --env {ENV} -f logs --no-render -n 200"
    curves = "-n 800 --eval-freq 400 --eval-episodes 2"
    search = "-optimize -n 200 --n-trials 1 --eval-episodes 1 --no-optim-plots"
    study = f"--storage {algo}.log --study-name study"
    return [
        f"{train} {SMALL} {curves} --save-freq 400 --tensorboard-log tensorboard_{algo}",
        f"{train} {SMALL} {curves} -i logs/{algo}/{ENV}_1/{ENV}.zip",
        f"{enjoy} --exp-id 1 --load-best",
        f"{enjoy} --exp-id 1 --load-checkpoint 400",
        f"plot_train -a {algo} -e {ENV} -f logs -w 2",
        f"all_plots -a {algo} -e {ENV} -f logs -o results_{algo} --no-display",
        f"plot_from_file -i results_{algo} -o figure_{algo} --format png",
        f"{train} {search} {study} --seed 1",
        f"{train} {search} {study} --seed 2",
        f"{train} {study} -n 200 --trial-id 1",
        f"{train} -n 200 --conf-file config.py",
        f"{enjoy} --stochastic",
        f"{train} --conf-file timesteps.yml --eval-freq -1 --device cpu",
    ]


def test_scripts_run_from_the_source_tree(tmp_path):
    # one test, so that one xdist worker makes the runs that the checks share, and two processes,
    # for importing rl_zoo3 and what it needs takes as long as these runs
    (tmp_path / "config.py").write_text(SCHEDULES)
    (tmp_path / "timesteps.yml").write_text(TIMESTEPS)
    first, *lines = [line for algo in ALGORITHMS for line in source_tree_lines(algo)]
    output = run([sys.executable, "-m", "sb3_crpn.zoo", *first.split()], tmp_path)
    output += run([sys.executable, "-c", CHAIN, *lines], tmp_path)
    for algo in ALGORITHMS:
        assert f"Loading hyperparameters from: {config_file(algo)}" in output
        runs = {number: tmp_path / "logs" / algo / f"{ENV}_{number}" for number in (1, 2, 5, 6, 7)}
        check_training(algo, runs[1])
        assert list(tmp_path.glob(f"tensorboard_{algo}/{ENV}/*/events.out.tfevents.*"))
        check_continuation(algo, runs[1], runs[2])
        check_enjoy(algo, output)
        assert (tmp_path / f"figure_{algo}").read_bytes().startswith(b"\x89PNG")
        check_search(algo, tmp_path / f"{algo}.log", runs[5])
        check_schedules(algo, runs[6])
        check_timesteps(algo, runs[7])


def load(algo, folder):
    return ALGORITHMS[algo].load(folder / f"{ENV}.zip", device="cpu")


def normalisation(folder):
    """The statistics that VecNormalize saved with a run."""
    return load_from_pkl(folder / ENV / "vecnormalize.pkl")


def check_training(algo, folder):
    """Models, checkpoints, statistics and learning curves of a run."""
    models = {path.name for path in folder.glob("*.zip")}
    checkpoints = {"rl_model_400_steps.zip", "rl_model_800_steps.zip"}
    assert models == {f"{ENV}.zip", "best_model.zip", *checkpoints}
    assert np.load(folder / "evaluations.npz")["timesteps"].tolist() == [400, 800]
    assert len(list(folder.glob("*.monitor.csv"))) == 2
    assert normalisation(folder).gamma == 0.9
    assert load(algo, folder)._n_updates == 2


def check_continuation(algo, first, second):
    """A run that went on from the first's policy and statistics, for as long again."""
    assert load(algo, second)._n_updates == 4
    counts = [normalisation(folder).obs_rms.count for folder in (first, second)]
    assert counts[1] == pytest.approx(2 * counts[0], rel=0.01)


def check_enjoy(algo, output):
    """The best model, a checkpoint and the last model, one episode each."""
    for model in (f"{ENV}_1/best_model", f"{ENV}_1/rl_model_400_steps", f"{ENV}_6/{ENV}"):
        assert f"Loading logs/{algo}/{model}.zip" in output
    assert output.count("Loading running average") == 2 * len(ALGORITHMS)
    assert output.count("1 Episodes") == 3 * len(ALGORITHMS)


def check_search(algo, log, folder):
    """Two trials, the second by a search that resumed the study, and a run of the second."""
    backend = optuna.storages.journal.JournalFileBackend(str(log))
    storage = optuna.storages.JournalStorage(backend)
    first, second = optuna.load_study(study_name="study", storage=storage).trials
    assert first.state == second.state == optuna.trial.TrialState.COMPLETE
    assert first.params != second.params
    used = yaml.load((folder / ENV / "config.yml").read_text(), Loader=yaml.UnsafeLoader)
    sampled = second.params | second.user_attrs
    assert {"n_steps", "gamma", "target_kl", "hessian_lambda"} <= used.keys() & sampled.keys()
    assert all(used[name] == sampled[name] for name in used.keys() & sampled.keys())
    assert ("subsolver_steps" in used) == (algo == "acrpn")


def check_schedules(algo, folder):
    """A run with the schedules of the configuration in Python."""
    model = load(algo, folder)
    assert (model.alpha(0.5), model.n_episodes(0.5)) == (55.0, 1.5)


def check_timesteps(algo, folder):
    """Two updates of 150 timesteps; no episode of 200 has ended in the first one."""
    model = load(algo, folder)
    assert model.rollout == "timesteps"
    assert model.num_timesteps == 300
    assert model._n_updates == 2


@pytest.fixture
def site(tmp_path):
    """The folder that a wheel, built from the source distribution, is installed in."""
    run([sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path)], ROOT)
    (source,) = tmp_path.glob("*.tar.gz")
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index"]
    run([*pip, "--no-build-isolation", "--target", str(tmp_path / "site"), str(source)], tmp_path)
    return tmp_path / "site"


def test_scripts_run_from_a_wheel(site, tmp_path):
    path = {"PYTHONPATH": str(site)}
    output = run(
        [str(site / "bin" / "sb3-crpn"), *SHORT.format("crpn").split(), "--vec-env", "subproc"],
        tmp_path,
        **path,
    )
    assert f"Loading hyperparameters from: {site}/sb3_crpn/zoo_configs/crpn.yml" in output
    search = "-optimize -n 200 --n-trials 1 --eval-episodes 1 --no-optim-plots"
    lines = [
        SHORT.format("acrpn"),
        *(f"enjoy --algo {algo} --env {ENV} -f logs --no-render -n 200" for algo in ALGORITHMS),
        f"train --algo acrpn --env {ENV} {search}",
        f"all_plots -a crpn acrpn -e {ENV} -f logs -o results --no-display",
    ]
    output = run([sys.executable, "-c", CHAIN, *lines], tmp_path, **path)
    assert output.startswith(f"{site}/sb3_crpn/__init__.py")
    assert f"Loading hyperparameters from: {site}/sb3_crpn/zoo_configs/acrpn.yml" in output
    assert (output.count("1 Episodes"), output.count("Best trial:")) == (2, 1)
    assert (tmp_path / "results.pkl").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("--algo crpn --env CartPole-v1", "crpn"),
        ("-n 5 --algo=acrpn", "acrpn"),
        ("--algo ppo", None),
        ("", None),
        ("--algo crpn --conf-file crpn_16_envs.yml", "crpn_16_envs"),
        ("--algo crpn -conf crpn_64_envs", "crpn_64_envs"),
        ("--algo crpn --conf-file mine.yml", None),
        (f"--algo crpn --conf-file {ROOT}/zoo_configs/crpn_64_envs.yml", None),
    ],
)
def test_our_algorithms_have_our_hyperparameters(options, name):
    expected = [] if name is None else ["--conf-file", str(ROOT / "zoo_configs" / f"{name}.yml")]
    assert _config(options.split()) == expected


def test_a_file_of_the_users_goes_before_ours_of_the_same_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("crpn_16_envs.yml").write_text("")
    assert _config(["--algo", "crpn", "--conf-file", "crpn_16_envs.yml"]) == []
    with pytest.raises(ValueError, match=r"'crpn_8_envs' is not allowed.*crpn_16_envs"):
        config_file("crpn_8_envs")


def test_without_rl_zoo3_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    with pytest.raises(SystemExit) as stop:
        main(["train", "--algo", "crpn"])
    assert 'pip install ".[zoo]"' in stop.value.code
    assert "\n" not in stop.value.code


def test_unknown_scripts_are_named(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["fly"])
    assert stop.value.code == 2
    assert "plot_from_file" in capsys.readouterr().err
