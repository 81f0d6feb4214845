"""The algorithms in one file each, against the package on the same episodes."""

import math
from itertools import pairwise
from pathlib import Path

import acrpn_minimal
import crpn_minimal
import numpy as np
import pytest
import torch
from crpn_minimal import Episode, cost_to_go

from sb3_crpn import ACRPN, CRPN, PAPER
from sb3_crpn.cubic import cubic_finalsolver, cubic_subsolver, solve_dense
from tests.cubic.problems import FAMILY

N_EPISODES = 12


def one_update(algorithm, **arguments):
    """Return the episodes of one update on CartPole-v1, θ before it and the step."""
    model = algorithm(
        "MlpPolicy",
        "CartPole-v1",
        policy_kwargs={"net_arch": []},
        n_episodes=N_EPISODES,
        gamma=0.9,
        seed=0,
        device="cpu",
        **PAPER | arguments,
    )
    generator = torch.Generator().manual_seed(0)
    before = torch.randn(len(model.actor), dtype=torch.float64, generator=generator).float() / 4
    model.actor.assign(before.double())
    before = model.actor.vector
    model.learn(1)
    buffer = model.rollout_buffer
    starts = np.flatnonzero(buffer.episode_starts[: buffer.pos, 0])
    episodes = [
        Episode(
            torch.from_numpy(buffer.observations[start:stop, 0]).double(),
            torch.from_numpy(buffer.actions[start:stop, 0, 0]).long(),
            torch.from_numpy(buffer.rewards[start:stop, 0]).double(),
        )
        for start, stop in pairwise([*starts, buffer.pos][: N_EPISODES + 1])
    ]
    model.env.close()
    return episodes, before, model.actor.vector - before


def estimates(module, episodes, theta):
    return module.estimate(theta, episodes, [cost_to_go(e.rewards, 0.9) for e in episodes])


@pytest.mark.parametrize("alpha", [1.0, 300.0])
def test_an_update_of_algorithm_1_is_crpns(alpha):
    episodes, theta, step = one_update(CRPN, alpha=alpha)
    minimal = crpn_minimal.cubic_step(*estimates(crpn_minimal, episodes, theta), alpha)
    assert float(step.norm()) > 1e-3
    assert float((step - minimal).norm()) <= 1e-4 * float(step.norm())  # of single precision


def test_another_discount_makes_another_update():
    episodes, theta, step = one_update(CRPN, alpha=300.0)
    psi = [cost_to_go(episode.rewards, 1.0) for episode in episodes]
    other = crpn_minimal.cubic_step(*crpn_minimal.estimate(theta, episodes, psi), 300.0)
    assert float((step - other).norm()) > 0.1 * float(step.norm())


# ‖g‖ = 0.803 and ‖H‖ = 10.3 here; a tiny ε leaves no perturbation to speak of
BRANCHES = {
    "Cauchy": {"alpha": 100.0, "gradient_lipschitz": 1.0, "sosp_epsilon": 1e-9},
    "descent": {"alpha": 1.0, "gradient_lipschitz": 40.0, "sosp_epsilon": 1e-9},
}


@pytest.mark.parametrize("branch", BRANCHES)
def test_an_update_of_algorithm_2_is_acrpns(branch):
    settings, n_hat = BRANCHES[branch], 40
    episodes, theta, step = one_update(ACRPN, **settings, subsolver_steps=n_hat)
    g, H = estimates(acrpn_minimal, episodes, theta)
    rho, ell, epsilon = settings.values()
    assert (float(g.norm()) >= ell**2 / rho) == (branch == "Cauchy")
    zeta = torch.full_like(g, len(g) ** -0.5)
    minimal = acrpn_minimal.subsolver(g, H, rho, ell, epsilon, n_hat, zeta)
    enough = -math.sqrt(epsilon**3 / rho) / 100
    assert acrpn_minimal.decrease(g, H, rho, minimal) < enough
    assert float(step.norm()) > 1e-3
    assert float((step - minimal).norm()) <= 1e-4 * float(step.norm())


def test_products_are_those_of_the_matrix():
    episodes, theta, _ = one_update(CRPN, alpha=300.0)
    g, H = estimates(crpn_minimal, episodes, theta)
    gradient, product = estimates(acrpn_minimal, episodes, theta)
    torch.testing.assert_close(gradient, g)
    torch.testing.assert_close(torch.stack([product(v) for v in torch.eye(len(g)).double()]), H)


@pytest.mark.parametrize("problem", FAMILY, ids=lambda problem: problem.name)
def test_the_minimal_cubic_step_is_a_global_minimiser(problem):
    g, H = torch.from_numpy(problem.gradient), torch.from_numpy(problem.hessian)
    step = crpn_minimal.cubic_step(g, H, problem.alpha)
    length = step.norm()
    value = float(g @ step + step @ H @ step / 2 + problem.alpha / 6 * length**3)
    best = -solve_dense(problem.gradient, problem.hessian, problem.alpha).predicted_decrease
    assert value == pytest.approx(best, rel=1e-6)


def test_minimal_descents_are_those_of_the_package():
    rng = np.random.default_rng(0)
    A, g = rng.normal(size=(5, 5)), torch.from_numpy(rng.normal(size=5))
    matrix = torch.from_numpy(A + A.T)
    arguments = (g, lambda v: matrix @ v, 2.0)
    options = {"gradient_lipschitz": 10.0, "epsilon": 0.5}
    step = acrpn_minimal.finalsolver(*arguments, 10.0, 0.5)
    torch.testing.assert_close(step, cubic_finalsolver(*arguments, max_steps=9999, **options).step)
    zeta = torch.eye(5, dtype=torch.float64)[0]
    moved = acrpn_minimal.subsolver(*arguments, 10.0, 0.5, 30, zeta)
    unmoved = acrpn_minimal.subsolver(*arguments, 10.0, 0.5, 30, 0 * zeta)
    theirs = cubic_subsolver(*arguments, max_steps=30, **options).step
    assert 0 < float((moved - unmoved).norm()) < 1.0
    assert float((theirs - unmoved).norm()) <= 2 * float((moved - unmoved).norm())


@pytest.mark.parametrize("module", [crpn_minimal, acrpn_minimal])
def test_the_minimal_algorithms_learn(module, capsys):
    module.main(6)
    returns = [float(line.split("return ")[1]) for line in capsys.readouterr().out.splitlines()]
    assert 15 < returns[0] < 35  # the uniform policy's is 22
    assert returns[-1] > 1.8 * returns[0]


def test_algorithm_1_fits_on_two_pages():
    assert len(Path(crpn_minimal.__file__).read_text().splitlines()) <= 120
