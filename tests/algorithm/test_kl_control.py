import math
from dataclasses import dataclass

import pytest

from sb3_crpn.algorithm.kl_control import KLControl, fit_alpha

TARGET = 0.02


@dataclass
class Trial:
    alpha: float
    kl: float


class Law:
    """α ↦ trial with a given KL(α). A second trial of the same α is an error."""

    def __init__(self, function):
        self.function = function
        self.tried = []

    @property
    def trials(self):
        return len(self.tried)

    def __call__(self, alpha):
        assert alpha not in self.tried
        self.tried.append(alpha)
        return Trial(alpha, self.function(alpha))


@pytest.mark.parametrize("start", [1e-6, 1e-2, 1.0, 1e2, 1e6])
@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_power_laws_are_met_in_a_few_trials(power, scale, start):
    law = Law(lambda alpha: (scale / alpha) ** power)
    trial = fit_alpha(law, start, TARGET)
    assert 0.9 * TARGET <= trial.kl <= TARGET
    assert law.trials <= 15


def test_a_start_that_meets_the_target_is_kept():
    law = Law(lambda alpha: 0.95 * TARGET / alpha)
    assert fit_alpha(law, 1.0, TARGET).alpha == 1.0
    assert law.trials == 1


@pytest.mark.parametrize("start", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("invalid", [math.inf, math.nan])
def test_steps_that_blow_up_count_as_too_long(invalid, start):
    law = Law(lambda alpha: 1.0 / alpha if alpha > 30.0 else invalid)
    trial = fit_alpha(law, start, TARGET)
    assert 0.9 * TARGET <= trial.kl <= TARGET
    assert law.trials <= 25


@pytest.mark.parametrize("start", [1e-3, 1.0, 1e4])
def test_saturating_law_that_reaches_the_target_is_met(start):
    law = Law(lambda alpha: 2.0 * TARGET / (1.0 + alpha))
    trial = fit_alpha(law, start, TARGET)
    assert 0.9 * TARGET <= trial.kl <= TARGET
    assert law.trials <= 15


@pytest.mark.parametrize("start", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("limit", [0.5, 1e-3])
def test_a_newton_step_within_the_target_is_taken_nearly_in_full(limit, start):
    law = Law(lambda alpha: limit * TARGET / (1.0 + alpha))
    trial = fit_alpha(law, start, TARGET)
    assert 0.95 * limit * TARGET <= trial.kl <= TARGET
    assert law.trials <= 25


def test_a_step_of_length_zero_leaves_alpha_alone():
    law = Law(lambda alpha: 0.0)
    assert fit_alpha(law, 2.0, TARGET).alpha == pytest.approx(2.0)
    assert law.trials <= 2


def test_alpha_stays_positive_where_the_divergence_creeps_up_to_no_end():
    law = Law(lambda alpha: 1e-9 * TARGET * 1.1**law.trials)
    assert fit_alpha(law, 1.0, TARGET).alpha == pytest.approx(1e-30)


@pytest.mark.parametrize("start", [1e-3, 1.0, 1e4])
def test_where_the_target_is_jumped_over_alpha_is_the_smallest_allowed(start):
    law = Law(lambda alpha: 5.0 * TARGET if alpha < 7.0 else 0.1 * TARGET * 7.0 / alpha)
    trial = fit_alpha(law, start, TARGET)
    assert trial.kl <= TARGET
    assert trial.alpha == pytest.approx(7.0, rel=1e-3)


def test_a_policy_that_never_survives_ends_the_search():
    law = Law(lambda alpha: math.nan)
    trial = fit_alpha(law, 1.0, TARGET)
    assert math.isnan(trial.kl)
    assert trial.alpha == law.tried[-1]
    assert law.trials <= 50


def test_the_target_falls_with_the_spread_of_the_returns():
    control = KLControl()

    def target(deviation):
        return control.scaled_target(TARGET, deviation)

    assert target(100.0) == TARGET
    assert target(0.2 * 99.1) == pytest.approx(TARGET)  # of a maximum that fades by 1 % an update
    assert target(2.0) == pytest.approx(TARGET * (2.0 / (0.2 * 100.0 * 0.99**2)) ** 2)
    assert target(1e-9) == pytest.approx(TARGET * 1e-4)
    assert target(math.nan) == target(math.inf) == TARGET
    assert control.return_scale == pytest.approx(100.0 * 0.99**3)
    assert target(1e9) == TARGET
    assert target(100.0) == pytest.approx(TARGET * 1e-4)
    for _ in range(2000):
        last = target(100.0)
    assert last == TARGET  # that outlier is forgotten


def test_returns_without_any_spread_leave_the_target():
    control = KLControl()
    assert control.scaled_target(TARGET, 0.0) == TARGET
    assert control.return_scale == 0.0


def test_the_search_begins_at_the_last_alpha():
    control = KLControl()
    assert control.first_alpha(3.0) == 3.0
    control.alpha = 5.0
    assert control.first_alpha(3.0) == 5.0
