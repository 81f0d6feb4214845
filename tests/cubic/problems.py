"""Adversarial cubic problems, an independent judge of their solutions, and a slow oracle."""

from dataclasses import dataclass
from decimal import Decimal, localcontext

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import strategies as st

from sb3_crpn.cubic import CubicStep

EPS = np.finfo(np.float64).eps


@dataclass(frozen=True, eq=False)
class Problem:
    """m(s) = g·s + ½ sᵀHs + (α/6)‖s‖³."""

    name: str
    gradient: np.ndarray
    hessian: np.ndarray
    alpha: float = 1.0

    @property
    def dim(self):
        return len(self.gradient)

    def hvp(self):
        return Counter(torch.from_numpy(self.hessian))


class Counter:
    """v ↦ Hv that records its arguments."""

    def __init__(self, hessian):
        self.hessian = hessian
        self.calls = []

    def __call__(self, vector):
        self.calls.append(vector.clone())
        return self.hessian @ vector


def rotation(dim, seed):
    return np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, dim)))[0]


def spectral(name, eigenvalues, gamma, alpha=1.0, seed=None):
    """H and g with these eigenvalues and coordinates, rotated unless seed is None."""
    eigenvalues, gamma = np.asarray(eigenvalues, float), np.asarray(gamma, float)
    if seed is None:
        return Problem(name, gamma, np.diag(eigenvalues), alpha)
    Q = rotation(len(gamma), seed)
    H = (Q * eigenvalues) @ Q.T
    return Problem(name, Q @ gamma, (H + H.T) / 2, alpha)


def scaled(problem, factor_g, factor_h):
    name = f"{problem.name}, g {factor_g:g}, H {factor_h:g}"
    return Problem(name, factor_g * problem.gradient, factor_h * problem.hessian, problem.alpha)


def _family():
    rng = np.random.default_rng(0)
    n = 12
    ones, zeros = np.ones(n), np.zeros(n)
    spread = np.linspace(-1, 2, n)
    gamma = rng.standard_normal(n)
    hidden = np.r_[0, gamma[1:] * 0.1]
    problems = [
        spectral("convex", np.linspace(1, 3, n), gamma, seed=1),
        spectral("indefinite", spread, gamma, seed=2),
        spectral("hard, diagonal", spread, hidden),
        spectral("hard, rotated", spread, hidden, seed=3),
        spectral("hard, long rest", spread, np.r_[0, 5 * ones[1:]], seed=3),
        spectral("hard, multiple", np.r_[-1, -1, -1, spread[3:]], np.r_[0, 0, 0, hidden[3:]]),
        spectral("hard, singular psd", np.r_[0, 0, np.arange(1, n - 1)], np.r_[0, 0, ones[2:]]),
        spectral("clusters", np.repeat([-1, -1 + 1e-9, 0, 2], 3), gamma, seed=4),
        spectral("hidden cluster", np.repeat([-1, -1 + 1e-9, 0, 2], 3), np.r_[0, gamma[1:]]),
        spectral("cond 1e8", np.logspace(-8, 0, n), gamma, seed=5),
        spectral("cond 1e8, indefinite", np.logspace(-8, 0, n) * (-1.0) ** np.arange(n), gamma),
        spectral("g = 0, indefinite", spread, zeros, seed=6),
        spectral("g = 0, convex", spread + 2, zeros, seed=6),
        spectral("g nearly 0", spread, 1e-14 * gamma, seed=6),
        spectral("g subnormal", spread, 1e-310 * ones),
        spectral("H = 0", zeros, gamma),
        spectral("H = 0, g = 0", zeros, zeros),
        spectral("H = -I", -ones, gamma),
        spectral("H = -I, g = 0", -ones, zeros),
        spectral("H = I", ones, gamma),
        spectral("d = 1, convex", [2.0], [1.0]),
        spectral("d = 1, concave", [-2.0], [1e-3]),
        spectral("d = 1, concave, g = 0", [-2.0], [0.0]),
        spectral("d = 1, g only", [0.0], [-3.0]),
        spectral("d = 2, saddle", [-1.0, 1.0], [0.0, 0.5]),
    ]
    for k in [*range(17), 100, 300]:
        gamma_k = np.r_[10.0**-k, hidden[1:]]
        problems.append(spectral(f"near-hard 1e-{k}", spread, gamma_k))
        problems.append(spectral(f"near-hard 1e-{k}, rotated", spread, gamma_k, seed=k))
    for alpha in 10.0 ** np.arange(-4, 7):
        problems.append(spectral(f"alpha {alpha:g}", spread, gamma, alpha, seed=7))
        problems.append(spectral(f"alpha {alpha:g}, hard", spread, hidden / alpha, alpha, seed=7))
    for factor_g in (1e-12, 1.0, 1e12):
        for factor_h in (1e-12, 1.0, 1e12):
            problems.append(scaled(problems[1], factor_g, factor_h))
            problems.append(scaled(problems[3], factor_g, factor_h))
    return problems


FAMILY = _family()
each_problem = pytest.mark.parametrize("problem", FAMILY, ids=lambda p: p.name)


@st.composite
def problems(draw, max_dim=8):
    """Generated problems: spectra with ties and zeros, coordinates over 16 decades or 0."""
    dim = draw(st.integers(1, max_dim))
    sign = st.sampled_from([-1.0, 1.0])
    value = st.sampled_from([0.0, 1.0, 1.0 + 1e-9, 1e-8, 0.5]) | st.floats(1e-8, 1)
    exponent = st.floats(-16, 1) | st.just(-np.inf)
    eigenvalues = [draw(sign) * draw(value) for _ in range(dim)]
    gamma = [draw(sign) * 10.0 ** draw(exponent) for _ in range(dim)]
    alpha = 10.0 ** draw(st.floats(-4, 6))
    seed = draw(st.none() | st.integers(0, 100))
    problem = spectral("generated", eigenvalues, gamma, alpha, seed)
    scale = st.sampled_from([1e-12, 1.0, 1e12])
    return scaled(problem, draw(scale), draw(scale))


def model(problem, s, metric=None):
    s = np.asarray(s)
    norm = np.sqrt(s @ s if metric is None else s @ metric @ s)
    return problem.gradient @ s + s @ problem.hessian @ s / 2 + problem.alpha / 6 * norm**3


def assert_global_minimiser(problem, result: CubicStep, metric=None, tol=1e-8):
    """Judge a step by the two optimality conditions, from H and g alone."""
    assert result.certified, result.status
    s = result.step.numpy()
    assert s.dtype == np.float64
    assert np.isfinite(s).all()
    H, g = problem.hessian, problem.gradient
    M = np.eye(problem.dim) if metric is None else metric

    norm = np.sqrt(s @ M @ s)
    lam = result.multiplier
    rounding = EPS * np.linalg.cond(M)  # of ‖s‖_M
    assert lam == pytest.approx(problem.alpha * norm / 2, rel=1e-12 + rounding)
    eigenvalues = scipy.linalg.eigvalsh(H, M)
    curvature = np.abs(eigenvalues).max() + lam
    assert eigenvalues[0] + lam >= -100 * EPS * curvature
    residual = np.linalg.norm(H @ s + lam * M @ s + g)
    floor = 100 * EPS * (np.linalg.norm(H, 2) + lam * np.linalg.norm(M, 2)) * np.linalg.norm(s)
    assert residual <= max(tol * np.linalg.norm(g), floor)

    decrease = result.predicted_decrease
    noise = floor * np.linalg.norm(s)
    assert decrease >= 0
    assert decrease == pytest.approx(-model(problem, s, metric), rel=1e-9, abs=noise + 1e-300)


def is_rejected(problem, result):
    try:
        assert_global_minimiser(problem, result)
    except AssertionError:
        return True
    return False


def step_of(problem, s):
    """A solver's claim that s is the global minimiser."""
    s = np.asarray(s, float)
    return CubicStep(
        step=torch.from_numpy(s),
        multiplier=problem.alpha / 2 * float(np.linalg.norm(s)),
        predicted_decrease=float(-model(problem, s)),
        products=0,
        residual=0.0,
        certified=True,
        status="claimed",
    )


def oracle_decrease(eigenvalues, gamma, alpha):
    """m(0) - m* of a diagonal problem: the secular equation bisected in 100 decimal digits."""
    with localcontext() as context:
        context.prec = 100
        ev = [Decimal(float(x)) for x in eigenvalues]
        c = [Decimal(float(x)) for x in gamma]
        rho = Decimal(float(alpha)) / 2
        shift = max(Decimal(0), -min(ev))

        def squares(lam, power):
            pairs = [(x, e + lam) for x, e in zip(c, ev, strict=True) if x != 0]
            return sum((x**2 / e**power for x, e in pairs), Decimal(0))

        low, high = Decimal(0), max(map(abs, ev)) + 1 + sum(map(abs, c)) * (1 + rho)
        for _ in range(700):
            middle = (low + high) / 2
            if middle == 0 or squares(shift + middle, 2) * rho**2 > (shift + middle) ** 2:
                low = middle
            else:
                high = middle
        lam = shift + high
        # m(s) = -½ Σγ²/(λ_i + λ) - (1/12)α‖s‖³, also in the hard case, with ‖s‖ = λ/ρ
        return float(squares(lam, 1) / 2 + rho / 6 * (lam / rho) ** 3)


def large(dim=300, seed=0, eigenvalues=None, hide=0, alpha=1.0, size=1.0):
    """A rotated problem, ‖g‖ ≈ size, whose ``hide`` leftmost eigenvectors are orthogonal to g."""
    rng = np.random.default_rng(seed)
    if eigenvalues is None:
        eigenvalues = np.sort(rng.standard_normal(dim))
    gamma = rng.standard_normal(dim) * size / np.sqrt(dim)
    gamma[:hide] = 0
    return spectral(f"large {seed}", eigenvalues, gamma, alpha, seed)


SPECTRA = {
    "decaying": np.r_[-0.5, np.logspace(0, -8, 299)],
    "outlier": np.r_[-10.0, np.linspace(-1, 1, 299)],
    "barely lower": np.r_[-1.001, np.linspace(-1, 1, 299)],
    "clusters": np.repeat([-1.0, -0.5, 3.0], 100),
    "low rank": np.r_[-2.0, np.zeros(290), np.arange(1.0, 10)],
}
