"""The benchmark's statistics against known answers, and every part at a tiny size."""

import itertools
import json
import math

import pytest
import torch

from benchmarks.common.parts import Parts
from benchmarks.speed import memory, products, timing, training, updates
from benchmarks.speed.__main__ import PARTS, RESULTS, main, run_part
from benchmarks.speed.problems import SHAPES, collect, noise, noise_model, width_for
from benchmarks.speed.products import product_tasks
from benchmarks.speed.tables import TITLES, report
from benchmarks.speed.timing import CLOCKS, Task, compare, interleaved, slope
from sb3_crpn import CRPN

TINY = {
    "products": {"repeats": 2, "n_steps": 40},
    "updates": {"repeats": 1, "n_steps": 64, "warm_ups": 0},
    "collection": {"repeats": 1, "n_steps": 64},
    "stepping": {"repeats": 1, "n_steps": 5},
    "many": {"repeats": 1, "n_steps": 128, "n_cases": 1},
    "training": {"repeats": 1, "timesteps": 1, "warm_ups": 0},
    "solves": {"repeats": 1, "dense": (5, 8), "krylov": (10, 20)},
    "scaling": {"repeats": 2, "timesteps": (20, 40), "parameters": (100, 200), "n_steps": 20},
    "memory": {"timesteps": (50, 100), "parameters": (100,), "updates": (60,)},
    "device": {"repeats": 1, "sizes": ((4, 40),), "episode": 10},
}


def test_the_slope_of_a_power_law_is_its_exponent():
    sizes = [10, 100, 1000]
    times = [[c * n**1.5 for c in (1.0, 2.0, 3.0)] for n in sizes]
    assert slope(sizes, times) == pytest.approx([1.5, 1.5, 1.5])
    assert slope([1, math.e], [[1.0, 1.0], [1.0, math.e]]) == pytest.approx([0.5, 0.0, 1.0])


@pytest.fixture
def clock(monkeypatch):
    """Stand in for both clocks; returns what lets time pass."""
    now = [0.0]
    monkeypatch.setattr(timing, "CLOCKS", dict.fromkeys(CLOCKS, lambda: now[0]))

    def wait(seconds):
        now[0] += seconds

    return wait


def test_tasks_take_turns_and_only_the_run_is_timed(clock):
    calls = []

    def task(name, seconds):
        return Task(lambda: clock(seconds) or calls.append(name), lambda: clock(100.0))

    threads = torch.get_num_threads()
    tasks = {"a": task("a", 1.0), "b": task("b", 2.0), "c": task("c", 3.0)}
    times = interleaved(tasks, repeats=5, warm_ups=3)
    assert torch.get_num_threads() == threads
    turns = [calls[i : i + 3] for i in range(0, 24, 3)]
    assert len(calls) == 24
    assert all(sorted(turn) == ["a", "b", "c"] for turn in turns)
    assert len({tuple(turn) for turn in turns}) > 1
    for name, seconds in {"a": 1.0, "b": 2.0, "c": 3.0}.items():
        assert times[name] == {which: [seconds] * 5 for which in CLOCKS}


def test_ratios_are_formed_turn_by_turn_and_of_equal_work(clock):
    speeds = itertools.count(1)  # a machine that gets slower from call to call

    def run(seconds, work):
        return Task(lambda: clock(seconds * next(speeds)) or work)

    tasks = {"unit": run(1.0, None), "same": run(3.0, 3.0)}
    row = compare({"case": 1}, tasks, "unit", repeats=2, warm_ups=0)
    assert row["case"] == 1
    assert set(row["ratio"]) == {"same"}
    # calls 1 to 4, two a turn
    neighbours = {1 / 2, 2 / 1, 3 / 4, 4 / 3}
    assert set(row["ratio"]["same"]["cpu"][1:]) <= neighbours
    assert row["ms"]["unit"]["wall"][0] in {1e3 * (a + b) / 2 for a in (1, 2) for b in (3, 4)}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("width", [1, 7, 64])
def test_the_width_for_a_number_of_parameters(shape, width):
    env = noise(shape, 1)
    model = CRPN("MlpPolicy", env, policy_kwargs={"net_arch": [width, width]}, device="cpu")
    assert width_for(len(model.actor), shape) == width


def test_the_timed_gradient_is_that_of_the_update():
    model = noise_model(CRPN, "HalfCheetah-v5", 40, width=4)
    batch = collect(model)
    assert (batch.n_episodes, batch.n_steps) == (2, 40)
    flattened = []
    flatten = model.actor.flatten
    model.actor.flatten = lambda tensors: flattened.append(flatten(tensors)) or flattened[-1]
    products.gradient_of(model, batch)()
    del model.actor.flatten
    expected = model._estimate_from(batch).gradient
    torch.testing.assert_close(flattened[-1] / 2, expected, rtol=1e-5, atol=1e-6)
    assert list(product_tasks(model, batch)) == list(memory.PRODUCTS)


def test_updates_are_compared_on_the_same_rollout_and_repeat_it():
    models = updates.prepare(lambda: noise("HalfCheetah-v5", 2), {"n_steps": 20, "horizon": 20})
    ours, theirs = models["CRPN"], models["TRPO"]
    for model in models.values():
        for name, tensor in model.policy.state_dict().items():
            assert torch.equal(tensor, ours.policy.state_dict()[name])
    for name in ("observations", "actions", "rewards", "values"):
        expected = torch.as_tensor(getattr(ours.rollout_buffer, name)[:20])
        assert torch.equal(torch.as_tensor(getattr(theirs.rollout_buffer, name)), expected)
    task = updates.update_task(ours, critic=False)
    results = []
    for _ in range(2):
        task.prepare()
        assert ours.n_critic_updates == 0
        task.run()
        results.append((ours.actor.vector, ours.kl_control.alpha, ours._n_updates))
    assert torch.equal(results[0][0], results[1][0])
    assert results[0][1:] == results[1][1:]
    assert ours._n_updates == updates.WARM_UP_ROLLOUTS + 1


def test_every_part_has_a_title_and_a_tiny_size():
    assert list(PARTS) == list(TITLES) == list(TINY)


@pytest.mark.parametrize("part", [part for part in PARTS if part not in ("training", "memory")])
def test_parts_write_their_results_and_tables_come_from_the_file(part, tmp_path, capsys):
    file = tmp_path / "speed.csv"
    for earlier in ("other", part):
        Parts(file).replace(earlier, [{"text": "earlier"}])
    run_part(part, file, **TINY[part])
    printed = capsys.readouterr().out.strip()
    results = Parts(file).read()
    assert results.pop("other") == [{"text": "earlier"}]
    assert report(results) == printed
    main(["--table", "--results", str(file)])
    assert capsys.readouterr().out.strip() == printed
    assert f"## {TITLES[part]}" in printed
    assert "Skipped" in printed or "| --- |" in printed


def test_training_is_timed_per_timestep(monkeypatch):
    monkeypatch.setattr(training, "ENVS", ("Pendulum-v1",))
    monkeypatch.setattr(training, "_multiple", lambda number, factor: factor)
    (row,) = training.measure(**TINY["training"])
    assert set(row["ratio"]) == {"TRPO", "CRPN", "ACRPN"}


def test_memory_is_the_median_growth_over_processes(monkeypatch, tmp_path, capsys):
    peaks = itertools.cycle([130.0, 110.0, 150.0])

    def in_a_process(task, **options):
        case = {"timesteps": 1, "width": 64, "max_batch_timesteps": None} | options
        return {"task": task, **case, "d": 7, "before": 100.0, "peak": next(peaks)}

    monkeypatch.setattr(memory, "in_a_process", in_a_process)
    run_part("memory", tmp_path / "speed.csv", repeats=3, **TINY["memory"])
    assert "| 50 | 7 | whole | 30 | 30 | 30 |  |  |  |" in capsys.readouterr().out


@pytest.mark.parametrize("task", memory.PRODUCTS + memory.UPDATES)
def test_what_a_process_runs(task, monkeypatch, capsys):
    options = [f"--task={task}", "--timesteps=40", "--width=5"]
    monkeypatch.setattr("sys.argv", ["memory", *options])
    memory.main()
    row = json.loads(capsys.readouterr().out)
    assert (row["task"], row["d"]) == (task, 18 * 5 + 6 * 5 + 6 * 6 + 6)  # weights, biases, std
    assert 0 < row["before"] <= row["peak"]


def test_only_parts_that_there_are(capsys):
    with pytest.raises(SystemExit):
        main(["prodcuts"])
    assert "prodcuts is no part" in capsys.readouterr().err


def test_the_committed_results_print():
    assert set(Parts(RESULTS).read()) == set(PARTS)
    assert report(Parts(RESULTS).read())
