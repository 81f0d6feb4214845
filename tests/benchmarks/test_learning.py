"""The learning benchmark: curves, settings, storage, statistics, and one run from end to end."""

import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks.common.intervals import interval
from benchmarks.learning import comparison, equal, report, rollouts, store, tables
from benchmarks.learning.__main__ import main
from benchmarks.learning.run import N_BINS, Result, Run, learning_curve, make_run
from benchmarks.learning.settings import (
    ALGORITHMS,
    BUDGETS,
    TRPO_EQUAL,
    describe,
    find_entry,
    parse_setting,
    resolve,
    same_hyperparameters,
    setting_label,
    update_timesteps,
)
from benchmarks.learning.statistics import (
    improvement,
    interquartile_mean,
    mean_score,
    performance_profile,
    stratified_bootstrap,
)

needs_zoo = pytest.mark.skipif(find_spec("rl_zoo3") is None, reason="needs the zoo extra")


def test_each_step_counts_the_return_of_its_episode() -> None:
    # 25 steps of return 1, 50 of return 3; 5 steps of a cut episode, then 20 of return 10
    mean, curve = learning_curve([(25, 25, 1.0), (75, 50, 3.0), (100, 20, 10.0)], 1, 100)
    steps, values = np.array(curve).T
    assert mean == pytest.approx((25 * 1 + 50 * 3 + 20 * 10) / 95)
    np.testing.assert_array_equal(steps, np.arange(2, 101, 2))
    np.testing.assert_allclose(values[:12], 1)
    assert values[12] == pytest.approx(2)  # the bin (24, 26] has a step of either
    np.testing.assert_allclose(values[13:37], 3)
    assert np.isnan(values[38])  # (76, 78]: in the episode that was cut
    np.testing.assert_allclose(values[40:], 10)


def test_parallel_environments_share_the_steps() -> None:
    # each of two environments runs one episode over all 2 × 50 steps
    mean, curve = learning_curve([(100, 50, 0.0), (100, 50, 4.0)], 2, 100)
    assert mean == 2
    np.testing.assert_allclose([value for _, value in curve], 2)


def test_episode_beyond_the_budget_counts_up_to_it() -> None:
    mean, _ = learning_curve([(80, 80, 0.0), (120, 40, 1.0)], 1, 100)
    assert mean == pytest.approx(0.2)


def test_no_episode_no_mean() -> None:
    mean, curve = learning_curve([], 1, 100)
    assert np.isnan(mean)
    assert np.isnan([value for _, value in curve]).all()
    assert len(curve) == N_BINS


def test_setting_is_read_as_literals_or_text() -> None:
    text = "n_steps=512,metric=euclidean,learning_rate=lin_1e-3,policy_kwargs=dict(net_arch=[8, 8])"
    assert parse_setting(text) == {
        "n_steps": 512,
        "metric": "euclidean",
        "learning_rate": "lin_1e-3",
        "policy_kwargs": "dict(net_arch=[8, 8])",
    }
    assert parse_setting("") == {}


@pytest.mark.parametrize("setting", ["n_steps", "n_steps=", "**x", "a=1)+dict(b=2"])
def test_malformed_setting_is_named(setting: str) -> None:
    with pytest.raises(ValueError, match="is not allowed, must be key=value"):
        parse_setting(setting)


@pytest.mark.parametrize(
    ("name", "defaults"), [("ablation", True), ("ablation_halfcheetah", False)]
)
def test_ablations_are_complete(name: str, defaults: bool) -> None:
    folder = Path(store.__file__).parent / name
    option, *settings = (folder / "settings.txt").read_text().splitlines()
    assert option == "--set"
    labels = {setting_label(parse_setting(setting), defaults=defaults) for setting in settings}
    runs = store.read_runs(folder)
    runs = runs[runs.algo == "CRPN"]
    assert set(runs.setting) == labels
    assert set(runs.groupby(["env", "setting"]).size()) == {5}
    assert len(runs) == 5 * len(labels) * runs.env.nunique()


def test_entry_is_exact_then_another_version_then_the_nearest_then_the_default() -> None:
    entries = dict.fromkeys(["A-v1", "A-v4", "AB-v9", "B-v0", "default"])
    assert find_entry(entries, "A-v1", {}) == "A-v1"
    assert find_entry(entries, "A-v5", {"A-v5": "B-v0"}) == "A-v4"
    assert find_entry(entries, "C-v5", {"C-v5": "B-v0"}) == "B-v0"
    assert find_entry(entries, "C-v5", {}) == "default"
    assert find_entry({}, "C-v5", {}) is None


@needs_zoo
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_benchmark_task_has_an_entry_of_its_own(algo: str) -> None:
    for env in BUDGETS:
        entry, arguments = resolve(algo, env, {"gamma": 0.5})
        assert entry.split(": ")[1] != "default"
        assert "gamma=0.5" in describe(algo, arguments)


def test_reinforce_has_crpns_entry_without_what_only_newton_steps_use() -> None:
    crpn, reinforce = (resolve(algo, "CartPole-v1", {})[1] for algo in ("CRPN", "REINFORCE"))
    assert "target_kl" in crpn
    assert reinforce == {key: crpn[key] for key in crpn if key != "target_kl"}
    assert "actor_learning_rate=" in describe("REINFORCE", reinforce)


def test_trpo_at_equal_settings_has_crpns_entry_and_defaults() -> None:
    entry, arguments = resolve(TRPO_EQUAL, "CartPole-v1", {})
    assert entry == "crpn.yml: CartPole-v1"
    crpn = describe("CRPN", resolve("CRPN", "CartPole-v1", {})[1])
    trpo = describe(TRPO_EQUAL, arguments)
    assert same_hyperparameters(crpn, trpo)
    shared = ("n_envs", "n_steps", "gamma", "gae_lambda", "target_kl", "normalize", "batch_size",
              "n_critic_updates", "learning_rate", "policy_kwargs", "use_sde")  # fmt: skip
    assert all(f"{name}=" in crpn and f"{name}=" in trpo for name in shared)
    assert "krylov_dim" not in trpo
    # episodes of 1,000 steps: as many in an update of CRPN
    newton = resolve("CRPN", "HalfCheetah-v5", {})[1]
    assert update_timesteps("CRPN", newton) == 2 * 512  # the constructor's default
    assert resolve(TRPO_EQUAL, "HalfCheetah-v5", {})[1]["n_steps"] == 1000


def test_the_arms_at_equal_settings() -> None:
    runs = list(equal.wanted_runs(["CartPole-v1", "Walker2d-v5"]))
    arms = {(run.env, run.algo, run.setting) for run in runs}
    without = "hessian_shrinkage=0.0"
    cartpole = {("CRPN", ""), ("CRPN", without), ("ACRPN", ""), (TRPO_EQUAL, "")}
    # Walker2d's entry has no Hessian: the same run
    expected = {("CartPole-v1", *arm) for arm in cartpole}
    expected |= {("Walker2d-v5", *arm) for arm in cartpole - {("CRPN", without)}}
    assert arms == expected
    assert len(runs) == 4 * 10 + 3 * 5
    assert sorted(env for stage, _ in equal.STAGES for env in stage) == sorted(BUDGETS)


def test_the_report_at_equal_settings_has_the_seeds_that_all_arms_have(tmp_path: Path) -> None:
    peers, folder = tmp_path / "peers", tmp_path / "equal"
    for run in equal.wanted_runs(["CartPole-v1", "Walker2d-v5"], 1000):
        if run.seed < 3 - (run.algo == "ACRPN"):
            of_peers = run.algo == "ACRPN"  # rows without a number of updates
            level = {"ACRPN": 40.0, "CRPN": 60.0, TRPO_EQUAL: 50.0}[run.algo]
            result = _result(level + run.seed, np.array([1.0]))
            store.append(peers if of_peers else folder, run, result)
    other = make_run("CRPN", "CartPole-v1", 0, {"gamma": 0.5}, timesteps=1000)
    store.append(folder, other, _result(9.0, np.array([1.0])))
    for seed in range(4):
        random = make_run("Random", "CartPole-v1", seed, {}, timesteps=1000)
        store.append(peers, random, _result(0.0, np.array([])))
    found = equal.load((peers, folder), 1000, random=peers)
    assert found.complete_learners == found.learners
    task = "CartPole-v1 (1,000 steps)"
    arms = ["CRPN", "CRPN (hessian_shrinkage=0.0)", "ACRPN", TRPO_EQUAL]
    assert sorted(found.learners) == sorted(arms)
    for arm in arms:
        assert found.values(arm, task, "seed").tolist() == [0, 1]
    walker = "Walker2d-v5 (1,000 steps)"
    np.testing.assert_array_equal(found.values(arms[1], walker, "mean_return"), [60, 61])
    text = equal.report(found)
    assert "| CRPN | 1.20 [" in text  # 60.5 / 50.5
    assert "16 of 420 runs are there" in text
    assert f"| {task} | 33,333 | 33,333 | 33,333 | 33,333 |" in text


def test_rollouts_differ_in_nothing_else() -> None:
    runs = rollouts.wanted_runs()
    pairs = list(zip(runs[::2], runs[1::2], strict=True))
    assert len(set(runs)) == len(runs)
    for episodes, timesteps in pairs:
        same = ("env", "seed", "timesteps", "entry")
        assert all(getattr(episodes, name) == getattr(timesteps, name) for name in same)
        ours, theirs = episodes.hyperparameters, timesteps.hyperparameters
        assert ours.replace("rollout=episodes", "rollout=timesteps") == theirs != ours
    many = [run for run, _ in pairs if run.arguments.get("n_envs") == 16]
    assert {(run.env, run.arguments["n_steps"]) for run in many} == {
        ("CartPole-v1", 32),
        ("Pendulum-v1", 50),
        ("HalfCheetah-v5", 64),
        ("Hopper-v5", 128),
    }


def test_the_table_of_rollouts() -> None:
    runs = pd.DataFrame(
        {
            "env": "CartPole-v1",
            "timesteps": 100,
            "setting": ["", "", "n_envs=16,n_steps=32,rollout=timesteps"],
            "mean_return": [10.0, 30.0, 5.0],
            "final_return": [20.0, 20.0, 7.0],
            "episodes": [4, 6, 8],
            "cpu_seconds": [1.0, 3.0, 5.0],
        }
    )
    lines = rollouts.table(runs).splitlines()[2:]
    assert lines == [
        "| CartPole-v1 | 100 | 16 | timesteps | n_steps=32 | 1 | 5 | 7 | 8 | 5 |",
        "| CartPole-v1 | 100 | entry's | episodes |  | 2 | 20 [10, 30] | 20 [20, 20] | 5 | 2 |",
    ]


def test_the_differences_of_rollouts() -> None:
    settings = ["", "", "rollout=timesteps", "rollout=timesteps", "n_envs=16,rollout=timesteps"]
    returns = [10.0, 10.0, 30.0, 30.0, 5.0]
    runs = pd.DataFrame(
        {
            "env": "CartPole-v1",
            "timesteps": 100,
            "setting": settings,
            "mean_return": returns,
            "final_return": [-each for each in returns],
        }
    )
    assert rollouts.differences(runs).splitlines()[2:] == [
        "| CartPole-v1 | 100 | entry's | 2 | +20 [+20, +20] | -20 [-20, -20] |"
    ]


def test_a_new_argument_does_not_make_another_run_but_another_value_does() -> None:
    assert same_hyperparameters("a=1; b=2", "a=1; b=2; c=3")
    assert not same_hyperparameters("a=1; b=2", "a=1; b=3")
    assert same_hyperparameters("", "")


def _run(algo: str, seed: int, hyperparameters: str = "a=1", env: str = "CartPole-v1") -> Run:
    return Run(algo, env, "", 100_000, seed, hyperparameters, "entry", {})


def _result(mean: float, curve: np.ndarray) -> Result:
    row = {"mean_return": mean, "final_return": 2 * mean, "steps": 100_000, "episodes": 9,
           "updates": 3, "wall_seconds": 3.0, "cpu_seconds": 2.0, "versions": ""}  # fmt: skip
    steps = np.linspace(0, 100_000, len(curve) + 1)[1:]
    return Result(row, [(int(s), float(v)) for s, v in zip(steps, curve, strict=True)])


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """TRPO learns linearly to 100, CRPN twice as fast; random is 20. MountainCar is not learnt."""
    ramp = np.linspace(2, 100, 50)
    for seed in range(3):
        for algo, mean, curve in [
            ("Random", 20.0, np.array([])),
            ("TRPO", 50.0 + seed, ramp),
            ("CRPN", 75.0 + seed, np.minimum(2 * ramp, 100)),
        ]:
            store.append(tmp_path, _run(algo, seed), _result(mean, curve))
            flat = _result(-200.0, np.full(50, -200.0))
            store.append(tmp_path, _run(algo, seed, env="MountainCar-v0"), flat)
    return tmp_path


def test_a_repeated_run_replaces_the_first(results: Path) -> None:
    store.append(results, _run("CRPN", 0, "a=2"), _result(7.0, np.full(50, 7.0)))
    runs, curves = store.read_runs(results), store.read_curves(results)
    assert len(runs) == 18
    assert not runs.duplicated(list(store.KEYS)).any()
    is_repeated = (curves.algo == "CRPN") & (curves.seed == 0) & (curves.env == "CartPole-v1")
    assert (curves[is_repeated]["return"] == 7).all()
    assert is_repeated.sum() == 50


def test_runs_of_outdated_hyperparameters_are_left_out(results: Path) -> None:
    store.append(results, _run("CRPN", 0, "a=2"), _result(7.0, np.full(50, 7.0)))
    found = comparison.load(results, "TRPO")
    assert found.n_outdated == 2
    np.testing.assert_array_equal(found.values("CRPN", "CartPole-v1", "mean_return"), [7])
    assert list(found.learning_curves("CRPN", "CartPole-v1")) == [0]


def test_scores_are_zero_for_random_and_one_for_the_baseline(results: Path) -> None:
    found = comparison.load(results, "TRPO")
    labels = ["CRPN", "TRPO"]
    assert found.comparable_tasks(labels, "mean_return") == ["CartPole-v1"]
    scores = found.scores(labels, ["CartPole-v1"], "mean_return")
    assert np.mean(scores["TRPO"]) == pytest.approx(1)
    np.testing.assert_allclose(scores["CRPN"][0], (np.array([75, 76, 77]) - 20) / (51 - 20))


def test_steps_to_the_baselines_level(results: Path) -> None:
    found = comparison.load(results, "TRPO")
    assert found.level("CartPole-v1") == pytest.approx(96)  # the mean of 92, 94, …, 100
    # CRPN's curve is 4, 8, …, 100, 100, …: its mean over 5 bins is first ≥ 96 at bin 27
    np.testing.assert_array_equal(found.steps_to_level("CRPN", "CartPole-v1"), [54_000] * 3)
    np.testing.assert_array_equal(found.steps_to_level("TRPO", "CartPole-v1"), [100_000] * 3)
    frame = found.curves.copy()
    frame.loc[frame.label == "CRPN", "return"] = 95.0
    never = comparison.Comparison(found.runs, frame, "TRPO", 0)
    assert np.isinf(never.steps_to_level("CRPN", "CartPole-v1")).all()


def test_tables_say_what_the_rows_say(results: Path) -> None:
    text = tables.report(comparison.load(results, "TRPO"))
    assert "| CartPole-v1 | CRPN | 3 | 76.0 [75.0, 77.0] | 152 [150, 154] | 54,000" in text
    assert "| MountainCar-v0 | CRPN | 3 | -200 [-200, -200] | -400" in text
    assert "| CRPN | 1.81 " in text  # 56 / 31


def test_an_algorithm_of_fewer_environments_is_compared_apart(results: Path) -> None:
    complete = tables.report(comparison.load(results, "TRPO"))
    assert "Fewer environments" not in complete
    store.append(results, _run("PPO", 0), _result(30.0, np.full(50, 30.0)))
    found = comparison.load(results, "TRPO")
    assert found.complete_learners == ["CRPN", "TRPO"]
    assert found.learners == ["CRPN", "PPO", "TRPO"]
    all_environments, fewer = tables.report(found).split("Fewer environments")
    assert "| PPO | " not in all_environments
    assert "| PPO | 0.32 " in fewer  # 10 / 31


def test_interquartile_mean_is_scipys_for_equal_numbers_of_seeds() -> None:
    rng = np.random.default_rng(0)
    samples = list(rng.normal(size=(4, 6)))
    expected = stats.trim_mean(np.concatenate(samples), 0.25)
    assert interquartile_mean(samples) == pytest.approx(expected)
    # twice the seeds do not weigh an environment twice
    doubled = [np.repeat(samples[0], 2), *samples[1:]]
    assert interquartile_mean(doubled) == pytest.approx(expected)


def test_probability_of_improvement_is_mann_whitneys() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.integers(0, 5, (2, 8)).astype(float)
    expected = stats.mannwhitneyu(x, y).statistic / 64
    assert improvement([x], [y]).value == pytest.approx(expected)
    assert improvement([x], [x - 10]) == (1, 1, 1)


def test_performance_profile_is_a_fraction_of_runs() -> None:
    profile = performance_profile([np.array([0.0, 2.0]), np.array([1.0])], np.array([-1, 0.5, 3]))
    np.testing.assert_allclose(profile, [1, 0.75, 0])


def test_stratified_intervals_of_one_environment_are_plain_ones() -> None:
    values = np.random.default_rng(2).normal(size=400)
    found = stratified_bootstrap([values], lambda s: float(s[0].mean()))
    assert found == pytest.approx(interval(values), abs=0.01)


def test_one_seed_an_environment_has_no_interval() -> None:
    value, low, high = stratified_bootstrap([np.ones(1), np.zeros(1)], mean_score)
    assert value == 0.5
    assert np.isnan([low, high]).all()


def test_the_mean_score_weighs_environments_alike() -> None:
    assert mean_score([np.array([1.0, 3.0]), np.array([8.0])]) == 5.0


@pytest.mark.skipif(find_spec("rliable") is None, reason="needs the zoo extra")
def test_statistics_are_rliables() -> None:
    from rliable import library, metrics

    rng = np.random.default_rng(0)
    scores, others = rng.normal(size=(2, 10, 8)), rng.normal(0.3, 1, size=(10, 8))
    ours = list(scores[0].T)
    assert interquartile_mean(ours) == pytest.approx(metrics.aggregate_iqm(scores[0]))
    expected = metrics.probability_of_improvement(scores[0], others)
    assert improvement(ours, list(others.T)).value == pytest.approx(expected)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of how it calls its own bootstrap
        _, bounds = library.get_interval_estimates(
            {"a": scores[0]},
            lambda x: np.array([metrics.aggregate_iqm(x)]),
            reps=2000,
            random_state=np.random.RandomState(0),
        )
    _, low, high = stratified_bootstrap(ours, interquartile_mean)
    assert (low, high) == pytest.approx(tuple(bounds["a"].ravel()), abs=0.03)


@needs_zoo
def test_command_runs_resumes_and_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--results", str(tmp_path)]
    train = ["--algos", "CRPN", "TRPO", "Random", "--envs", "CartPole-v1", "--seeds", "1",
             "--timesteps", "1200", "--jobs", "1", *options]  # fmt: skip
    # the workers train, and they alone import rl_zoo3, which patches gymnasium
    monkeypatch.setattr(sys, "argv", ["benchmarks.learning", *train])
    imported = "rl_zoo3" in sys.modules
    main()
    assert ("rl_zoo3" in sys.modules) == imported
    assert "0 of 3 runs are done" in capsys.readouterr().out
    runs = store.read_runs(tmp_path).set_index("algo")
    assert runs.steps[["CRPN", "TRPO"]].eq(1200).all()
    assert runs.mean_return.between(9, 500).all()
    assert runs.updates["TRPO"] == 1  # of 2 × 512 steps
    assert runs.entry["TRPO"] == "trpo.yml: CartPole-v1"
    assert set(store.read_curves(tmp_path).algo) == {"CRPN", "TRPO"}

    main()
    assert "3 of 3 runs are done" in capsys.readouterr().out

    task = "CartPole-v1 (1,200 steps)"
    write = ["--write", str(tmp_path), "--curve-envs", task]
    monkeypatch.setattr(sys, "argv", ["report", *options, *write])
    report.main()
    assert f"| {task} | CRPN | 1 |" in (tmp_path / "BENCHMARK.md").read_text()
    for name in ("learning_curves.png", "aggregate.png"):
        assert (tmp_path / name).stat().st_size > 10_000


def test_curves_hold_missing_points_as_nan(tmp_path: Path) -> None:
    store.append(tmp_path, _run("CRPN", 0), _result(1.0, np.array([np.nan, 1.0])))
    assert store.read_curves(tmp_path)["return"].isna().tolist() == [True, False]
    assert isinstance(store.read_runs(tmp_path), pd.DataFrame)


def test_file_of_another_version_keeps_its_columns(tmp_path: Path) -> None:
    (tmp_path / "runs.csv").write_text(",".join([*store.KEYS, "entry", "hyperparameters"]) + "\n")
    store.append(tmp_path, _run("CRPN", 3), _result(1.0, np.array([1.0])))
    runs = store.read_runs(tmp_path)
    assert list(runs) == [*store.KEYS, "entry", "hyperparameters"]
    assert runs.seed.tolist() == [3]
    assert runs.hyperparameters.tolist() == ["a=1"]
