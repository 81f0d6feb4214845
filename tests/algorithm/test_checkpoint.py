import zipfile

import pytest
import torch

from sb3_crpn import CRPN
from tests.envs import Drift
from tests.training import make, same, tensors


def test_a_failing_save_leaves_the_earlier_file(tmp_path, monkeypatch):
    model = make(CRPN)
    model.save(tmp_path / "model")
    saved = (tmp_path / "model.zip").read_bytes()
    model.learn(50)
    write = zipfile.ZipFile.writestr

    def fail(archive, name, data):
        write(archive, name, data)
        if name != "data":
            raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "writestr", fail)
        with pytest.raises(OSError, match="no space"):
            model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == saved
    assert model._saved_random_state is None
    expected = tensors(model)
    model.save(tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]
    assert same(CRPN.load(tmp_path / "model", device="cpu"), expected)


@pytest.mark.parametrize(
    ("name", "file"),
    [("model", "model.zip"), ("m.zip", "m.zip"), ("m.v1", "m.v1"), ("a.b/m", "a.b/m.zip")],
)
def test_names_are_those_of_sb3(name, file, tmp_path):
    model = make(CRPN)
    model.save(str(tmp_path / name))
    assert (tmp_path / file).is_file()
    with (tmp_path / "open").open("wb") as stream:
        model.save(stream)
    for source in (tmp_path / name, tmp_path / "open"):
        loaded = CRPN.load(source, Drift(), device="cpu")
        assert torch.equal(loaded.actor.vector, model.actor.vector)


def _goes_on(model, **arguments):
    return tensors(model.learn(60, reset_num_timesteps=False, **arguments))


def test_a_file_that_is_saved_again_goes_on_as_the_first(tmp_path):
    make(CRPN).learn(60).save(tmp_path / "first")
    expected = _goes_on(CRPN.load(tmp_path / "first", Drift(), device="cpu"))
    again = CRPN.load(tmp_path / "first", Drift(), device="cpu")
    torch.rand(3)
    again.save(tmp_path / "second")
    for model in (again, CRPN.load(tmp_path / "second", Drift(), device="cpu")):
        _goes_on(model)
        assert same(model, expected)


def test_a_start_that_fails_keeps_the_random_state(tmp_path):
    make(CRPN).learn(60).save(tmp_path / "model")
    expected = _goes_on(CRPN.load(tmp_path / "model", Drift(), device="cpu"))
    model = CRPN.load(tmp_path / "model", Drift(), device="cpu")
    with pytest.raises(AttributeError):
        _goes_on(model, callback=[5])
    _goes_on(model)
    assert same(model, expected)


@pytest.mark.parametrize("reseed", ["argument", "method"])
def test_another_seed_is_not_that_of_the_file(reseed, tmp_path):
    make(CRPN).learn(60).save(tmp_path / "model")
    restored = _goes_on(CRPN.load(tmp_path / "model", Drift(), device="cpu"))
    if reseed == "argument":
        model = CRPN.load(tmp_path / "model", Drift(), device="cpu", seed=7)
    else:
        model = CRPN.load(tmp_path / "model", Drift(), device="cpu")
        model.set_random_seed(7)
    _goes_on(model)
    assert not same(model, restored)
