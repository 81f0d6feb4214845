"""The constants of the convergence theory and the parameters of its theorems.

>>> from sb3_crpn.theory import Constants, expectation_recipe, softmax_linear
>>> constants = Constants(K=1.0, scores=softmax_linear(feature_norm=1.0), H=1, d=4)
>>> recipe = expectation_recipe(constants, epsilon=0.5)
>>> sorted(recipe.kwargs)
['alpha', 'gamma', 'horizon', 'n_episodes', 'n_hessian_episodes']

Symbols are those of Maniyar et al., AISTATS 2024. The docstrings derive their values, and tests
compare them with enumerated decision processes. The module `printed` has the values of the paper,
under names that begin with "printed". ``python -m sb3_crpn.theory`` compares both.
"""

from sb3_crpn.theory.constants import Constants
from sb3_crpn.theory.policies import ScoreBounds, gaussian_linear, softmax_linear
from sb3_crpn.theory.printed import (
    PrintedConstants,
    printed_approximate_complexity,
    printed_approximate_recipe,
    printed_expectation_recipe,
    printed_high_probability_recipe,
)
from sb3_crpn.theory.recipes import (
    Recipe,
    approximate_recipe,
    expectation_recipe,
    high_probability_recipe,
)

__all__ = [
    "Constants",
    "PrintedConstants",
    "Recipe",
    "ScoreBounds",
    "approximate_recipe",
    "expectation_recipe",
    "gaussian_linear",
    "high_probability_recipe",
    "printed_approximate_complexity",
    "printed_approximate_recipe",
    "printed_expectation_recipe",
    "printed_high_probability_recipe",
    "softmax_linear",
]
