"""Names that users may write in place of objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from sb3_crpn.checks import Check, requires

T = TypeVar("T")


class Registry(dict[str, Callable[[Any], T]], Generic[T]):
    """The named values of one protocol: ``registry["name"] = factory`` adds a name.

    A factory takes the algorithm, whose arguments it may read. Each update calls it anew: what it
    makes has no memory. An object with state is handed over as an object, and is saved with the
    model.

    Parameters
    ----------
    protocol
        A ``runtime_checkable`` protocol that objects in place of names must satisfy.
    factories
        The names to begin with.
    """

    def __init__(self, protocol: Any, factories: Mapping[str, Callable[[Any], T]]) -> None:
        super().__init__(factories)
        self._protocol = protocol

    @property
    def check(self) -> Check:
        """The check of an argument: a registered name, or an object of the protocol."""
        methods = " and ".join(name for name in vars(self._protocol) if not name.startswith("_"))
        protocol = f"an object of {self._protocol.__name__}, with {methods}"
        return requires(
            lambda: f"one of {', '.join(map(repr, self))} or {protocol}",
            lambda value: (
                value in self
                if isinstance(value, str)
                else isinstance(value, self._protocol) and not isinstance(value, type)
            ),
        )

    def resolve(self, value: T | str, algorithm: object) -> T:
        """Return the object that ``value`` is, or is the name of."""
        return self[value](algorithm) if isinstance(value, str) else value
