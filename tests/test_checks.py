"""Checks of arguments: allowed values, conversions and messages."""

import numpy as np
import pytest
import torch

from sb3_crpn.checks import (
    COUNT,
    FLAG,
    FRACTION,
    NONE,
    POSITIVE,
    SCHEDULE,
    choice,
    integer,
    pair,
    real,
)

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("check", "value", "expected"),
    [
        (COUNT, 3, 3),
        (COUNT, np.int64(3), 3),
        (integer(0, 5), torch.tensor(5), 5),
        (POSITIVE, 2, 2.0),
        (POSITIVE, np.array(0.5), 0.5),
        (FRACTION, 0, 0.0),
        (FRACTION, np.float32(1.0), 1.0),
        (FLAG, np.bool_(True), True),
        (choice("a", "b"), np.str_("b"), "b"),
        (COUNT | NONE, None, None),
        (POSITIVE | choice("auto") | NONE, "auto", "auto"),
        (SCHEDULE, abs, abs),
        (pair(POSITIVE), [1, np.float64(2.0)], (1.0, 2.0)),
    ],
)
def test_allowed_values_become_pythons(check, value, expected):
    result = check("f: x", value)
    assert result == expected
    assert type(result) is type(expected)


@pytest.mark.parametrize(
    ("check", "values", "allowed"),
    [
        (COUNT, (0, 1.0, True, "1", None, NAN, np.ones(1)), "an integer >= 1"),
        (integer(0, 5), (-1, 6), "an integer in [0, 5]"),
        (POSITIVE, (0, -1.0, NAN, INF, True, "1", 1j, 10**400), "a finite number in (0, inf)"),
        (real(0.0, 1.0, open_high=True), (1.0, -0.1), "a finite number in [0, 1)"),
        (FRACTION, (1.1, -0.1), "a finite number in [0, 1]"),
        (FLAG, (1, 0.0, "yes", None), "True or False"),
        (choice("a", "b"), ("c", 1, np.array(["a"])), 'one of "a", "b"'),
        (FRACTION | NONE, ("x", 2), "a finite number in [0, 1] or None"),
        (pair(COUNT), ((1,), (1, 0), 5, "12"), "two of an integer >= 1"),
    ],
)
def test_other_values_are_refused_in_one_form(check, values, allowed):
    for value in values:
        with pytest.raises(ValueError, match="not allowed") as error:
            check("Name: x", value)
        assert str(error.value) == f"Name: x={value!r} is not allowed, must be {allowed}"
