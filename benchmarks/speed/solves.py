"""Dense against Krylov solves of random cubic models over d."""

from __future__ import annotations

from collections.abc import Callable

import torch

from benchmarks.common.table import Row
from benchmarks.speed.timing import Task, compare, interleaved, median, slope
from sb3_crpn.cubic import solve_dense, solve_krylov

DENSE = (10, 30, 100, 300, 1000, 2000)
KRYLOV = (100, 1_000, 10_000, 100_000, 1_000_000)


def measure(
    repeats: int = 20, dense: tuple[int, ...] = DENSE, krylov: tuple[int, ...] = KRYLOV
) -> list[Row]:
    """Compare both solvers up to moderate d, and the Krylov solver up to large d."""
    rows = []
    for d in dense:
        g, product = random_model(d)
        H = torch.stack([product(row) for row in torch.eye(d, dtype=torch.float64)])
        H = 0.5 * (H + H.T)
        tasks = {
            "krylov": Task(lambda g=g, H=H: _drop(solve_krylov(g, lambda v: H @ v, 1.0))),
            "dense": Task(lambda g=g, H=H: _drop(solve_dense(g, H, 1.0))),
        }
        step = solve_krylov(g, lambda v, H=H: H @ v, 1.0)
        case = {"d": d, "products": step.products, "certified": step.certified}
        rows.append(compare(case, tasks, "krylov", repeats))
    return [*rows, _large(krylov, max(3, repeats // 2))]


def _large(sizes: tuple[int, ...], repeats: int) -> Row:
    problems = {d: random_model(d) for d in sizes}
    tasks = {str(d): Task(lambda p=p: _drop(solve_krylov(*p, 1.0))) for d, p in problems.items()}
    times = interleaved(tasks, repeats, warm_ups=1)
    seconds = [times[str(d)]["cpu"] for d in sizes]
    steps = [solve_krylov(*problem, 1.0) for problem in problems.values()]
    return {
        "sizes": list(sizes),
        "ms": [median([1e3 * s for s in turns]) for turns in seconds],
        "products": [step.products for step in steps],
        "certified": [step.certified for step in steps],
        "slope": slope(sizes, seconds),
    }


def random_model(d: int) -> tuple[torch.Tensor, Callable[[torch.Tensor], torch.Tensor]]:
    """Return a random gradient, and products with a Hessian of decaying random spectrum.

    H = QΛQᵀ, Q a reflection, so that a product costs O(d): the rest of the time is the solver's.
    """
    generator = torch.Generator().manual_seed(0)
    eigenvalues, g, u = torch.randn(3, d, dtype=torch.float64, generator=generator)
    eigenvalues = eigenvalues / torch.arange(1, d + 1) ** 0.5
    u = u / u.norm()

    def reflect(v: torch.Tensor) -> torch.Tensor:
        return v - 2.0 * (u @ v) * u

    return g / d**0.5, lambda v: reflect(eigenvalues * reflect(v))


def _drop(result: object) -> None:
    """Drop the result: a task's return value is its amount of work."""
