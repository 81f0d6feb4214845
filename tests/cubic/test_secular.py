import numpy as np
from hypothesis import given, settings

from sb3_crpn.cubic import secular
from tests.cubic.problems import each_problem, problems


@settings(max_examples=200, deadline=None, derandomize=True)
@given(problems())
def test_secular_equation_takes_few_iterations(problem):
    assert iterations(problem) <= 11


@each_problem
def test_secular_equation_takes_at_most_seven_iterations_on_the_family(problem):
    assert iterations(problem) <= 7


def iterations(problem):
    eigenvalues, V = np.linalg.eigh(problem.hessian)
    return secular.solve_secular(eigenvalues, V.T @ problem.gradient, problem.alpha).iterations
