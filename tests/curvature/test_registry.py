from typing import Protocol, runtime_checkable

import pytest

from sb3_crpn.curvature import Registry


@runtime_checkable
class Animal(Protocol):
    def sound(self): ...


class Dog:
    def __init__(self, volume=0):
        self.volume = volume

    def sound(self):
        return "woof"


class Settings:
    volume = 3


def test_names_are_made_from_the_arguments_and_objects_are_themselves():
    animals, own = Registry(Animal, {"dog": lambda algorithm: Dog(algorithm.volume)}), Dog()
    assert animals.resolve("dog", Settings()).volume == 3
    assert animals.resolve(own, Settings()) is own
    animals["puppy"] = lambda _: Dog(1)
    for value in ("dog", "puppy", own):
        animals.check("pet", value)


@pytest.mark.parametrize("value", ["cat", 5, None, float("nan"), Dog, ["dog"]])
def test_what_is_neither_is_refused(value):
    animals = Registry(Animal, {"dog": lambda _: Dog()})
    check = animals.check  # as in a class that is defined before the name is
    animals["puppy"] = lambda _: Dog()
    allowed = "must be one of 'dog', 'puppy' or an object of Animal, with sound"
    with pytest.raises(ValueError, match=f"is not allowed, {allowed}") as e:
        check("pet", value)
    assert f"pet={value!r}" in str(e.value)
