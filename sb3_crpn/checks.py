"""Checks of arguments: a :class:`Check` converts a value, or says what is allowed instead."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


class _RefusedError(Exception):
    """The value is not allowed."""


def not_allowed(name: str, value: object, allowed: str) -> ValueError:
    """Return the error for an argument, in the one form that messages have.

    Parameters
    ----------
    name
        "Name of the class or function: name of the argument".
    value
        What was given.
    allowed
        What it must be.
    """
    return ValueError(f"{name}={value!r} is not allowed, must be {allowed}")


@dataclass(frozen=True)
class Check:
    """A rule for an argument. ``a | b`` allows what a or b allows.

    Attributes
    ----------
    allowed
        What the rule allows, for people; a function where that grows with a registry.
    convert
        Returns the value as a plain Python object, or raises ``_RefusedError``.
    """

    allowed: str | Callable[[], str]
    convert: Callable[[Any], Any]

    def __str__(self) -> str:
        """Return what the rule allows."""
        return self.allowed if isinstance(self.allowed, str) else self.allowed()

    def __call__(self, name: str, value: object) -> Any:
        """Return the converted value.

        Scalars of NumPy and PyTorch and arrays of no dimension become Python's numbers.

        Raises
        ------
        ValueError
            The value is not allowed; see :func:`not_allowed`.
        """
        try:
            return self.convert(_plain(value))
        except _RefusedError:
            raise not_allowed(name, value, str(self)) from None

    def __or__(self, other: Check) -> Check:
        def convert(value: Any) -> Any:
            try:
                return self.convert(value)
            except _RefusedError:
                return other.convert(value)

        return Check(lambda: f"{self} or {other}", convert)


def _plain(value: Any) -> Any:
    """Return the Python object in a scalar of NumPy or PyTorch; other values as they are."""
    return value.item() if getattr(value, "ndim", None) == 0 and hasattr(value, "item") else value


def requires(allowed: str | Callable[[], str], condition: Callable[[Any], object]) -> Check:
    """Return the check that lets values pass as they are if they meet ``condition``."""

    def convert(value: Any) -> Any:
        if condition(value):
            return value
        raise _RefusedError

    return Check(allowed, convert)


def real(
    low: float, high: float = math.inf, *, open_low: bool = False, open_high: bool = False
) -> Check:
    """Allow finite numbers in [low, high], without the ends that are open."""
    left, right = "(" if open_low else "[", ")" if open_high or math.isinf(high) else "]"

    def convert(value: Any) -> float:
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise _RefusedError
        try:
            number = float(value)
        except OverflowError:
            raise _RefusedError from None
        outside = (number <= low if open_low else number < low) or (
            number >= high if open_high else number > high
        )
        if outside or not math.isfinite(number):
            raise _RefusedError
        return number

    return Check(f"a finite number in {left}{low:g}, {high:g}{right}", convert)


def integer(low: int, high: int | None = None) -> Check:
    """Allow whole numbers of at least ``low``, and at most ``high``."""
    allowed = f"an integer >= {low}" if high is None else f"an integer in [{low}, {high}]"
    return requires(
        allowed,
        lambda value: (
            isinstance(value, int)
            and not isinstance(value, bool)
            and low <= value
            and (high is None or value <= high)
        ),
    )


def choice(*options: str) -> Check:
    """Allow one of some words."""
    words = ", ".join(f'"{option}"' for option in options)
    return requires(
        f"one of {words}" if len(options) > 1 else words,
        lambda value: isinstance(value, str) and value in options,
    )


def pair(check: Check) -> Check:
    """Allow a tuple, list or array of two values that pass ``check``."""

    def convert(value: Any) -> tuple[Any, Any]:
        try:
            first, second = value
        except (TypeError, ValueError):
            raise _RefusedError from None
        return check.convert(_plain(first)), check.convert(_plain(second))

    return Check(lambda: f"two of {check}", convert)


POSITIVE = real(0.0, open_low=True)
FRACTION = real(0.0, 1.0)
COUNT = integer(1)
# NumPy's legacy generator, which SB3 seeds, takes 32 bits
SEED = integer(0, 2**32 - 1)
VERBOSE = integer(0, 2)
FLAG = requires("True or False", lambda value: isinstance(value, bool))
NONE = requires("None", lambda value: value is None)
DICT = requires("a dict", lambda value: isinstance(value, dict))
PATH = requires("a path", lambda value: isinstance(value, str | os.PathLike))
CALLABLE = requires("callable", callable)
SCHEDULE = requires("a schedule", callable)
