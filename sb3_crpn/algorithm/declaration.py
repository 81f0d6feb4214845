"""Constructor arguments as dataclass fields: type, default, check and documentation in one place.

A class that ``@configured`` decorates has a constructor of its own fields and of those that it
inherits, as dataclasses do: ``help``, ``inspect.signature`` and type checkers see every argument.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import inspect
import re
import textwrap
from typing import Any, TypeVar

from typing_extensions import dataclass_transform

from sb3_crpn.checks import Check

Value = TypeVar("Value")
Class = TypeVar("Class", bound=type)


def setting(check: Check, doc: str, default: Value) -> Value:
    """Declare a constructor argument: what it may be, what it is for, and its default."""
    field: Any = dataclasses.field(default=default, metadata=described(check, doc))
    value: Value = field  # dataclasses make it the attribute's value
    return value


def described(check: Check, doc: str) -> dict[str, Any]:
    """Return the metadata of an argument's field; one without default needs no more."""
    return {"check": check, "doc": doc}


@dataclass_transform(kw_only_default=True)
def configured(cls: Class) -> Class:
    """Give the class its constructor, and its docstring the section that ``{parameters}`` marks.

    The constructor sets the attributes and calls ``__post_init__``. A TypeError names the class
    that is made, a subclass too, and what to use in place of other algorithms' arguments
    (``replacements``, a dict of the class).
    """
    dataclasses.dataclass(eq=False, repr=False, kw_only=True)(cls)
    init = cls.__init__  # type: ignore[misc]
    parameters = list(inspect.signature(init).parameters.values())
    names = {parameter.name for parameter in parameters}
    positional = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]

    @functools.wraps(init)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:  # noqa: N807
        name = type(self).__name__
        if len(args) >= len(positional):  # of which self is one
            raise TypeError(f"{name}: arguments after {positional[-1]} must be given by name")
        unknown = [key for key in kwargs if key not in names]
        if unknown:
            advice = "; ".join(f"{key}: {_advice(cls, key, names)}" for key in unknown)
            raise TypeError(f"{name} has no argument {advice}")
        init(self, *args, **kwargs)

    __init__.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [_as_argument(parameter) for parameter in parameters]
    )
    cls.__init__ = __init__  # type: ignore[misc]
    if cls.__doc__:  # absent under python -OO
        cls.__doc__ = inspect.cleandoc(cls.__doc__).format(parameters=_documentation(cls))
    return cls


def check_settings(model: Any) -> None:
    """Check the attributes that the fields of ``model`` declare, and make them Python's objects.

    Raises
    ------
    ValueError
        Naming the class, the argument, its value and what is allowed.
    """
    for field in dataclasses.fields(model):
        value = check_setting(model, field.name, getattr(model, field.name))
        setattr(model, field.name, value)


def check_setting(model: Any, name: str, value: object) -> Any:
    """Return the value of one argument, which need be no attribute, checked and converted."""
    check = _metadata(type(model), name)["check"]
    return check(f"{type(model).__name__}: {name}", value)


def _metadata(cls: type, name: str) -> Any:
    # dataclasses.fields leaves out the arguments that are no attributes
    return cls.__dataclass_fields__[name].metadata  # type: ignore[attr-defined]


def _as_argument(parameter: inspect.Parameter) -> inspect.Parameter:
    """Return the parameter with T where its annotation is InitVar[T]."""
    match = re.fullmatch(r"InitVar\[(.*)\]", str(parameter.annotation))
    return parameter.replace(annotation=match[1]) if match else parameter


def _documentation(cls: type) -> str:
    """Return the section "Parameters" of a docstring."""
    lines = ["Parameters", "----------"]
    for name in list(inspect.signature(cls).parameters):
        text = _metadata(cls, name)["doc"]
        lines += [name, textwrap.fill(text, 96, initial_indent="    ", subsequent_indent="    ")]
    return "\n".join(lines)


def _advice(cls: Any, unknown: str, names: set[str]) -> str:
    """Return what to use in place of an argument that does not exist."""
    if unknown in cls.replacements:
        return str(cls.replacements[unknown])
    close = difflib.get_close_matches(unknown, names, n=1)
    return f"did you mean {close[0]}?" if close else f"help({cls.__name__}) lists them"
