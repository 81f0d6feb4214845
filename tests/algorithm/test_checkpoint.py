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
