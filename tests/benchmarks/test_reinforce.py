import pytest
import torch

from benchmarks.reinforce import REINFORCE
from tests.training import TrainLog, make


def test_the_step_is_the_gradient_times_the_rate():
    model = make(REINFORCE, actor_learning_rate=0.25, seed=3)
    before = model.actor.vector
    log = TrainLog()
    gradients = []
    estimate = model._estimate
    model._estimate = lambda data: gradients.append(estimate(data)) or gradients[-1]
    model.learn(1, callback=log)
    expected = before - 0.25 * gradients[0].gradient
    torch.testing.assert_close(model.actor.vector, expected, rtol=1e-6, atol=1e-6)
    assert log["step_norm"] == pytest.approx([0.25 * log["gradient_norm"][0]])


def test_the_rate_can_be_a_schedule_and_survives_saving(tmp_path):
    model = make(REINFORCE, actor_learning_rate=lambda progress: 0.1 * progress + 0.1)
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model")
    assert loaded.alpha_schedule(1.0) == pytest.approx(5.0)
    assert loaded.alpha_schedule(0.0) == pytest.approx(10.0)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), None])
def test_a_rate_that_is_no_positive_number_is_refused(rate):
    with pytest.raises(ValueError, match="actor_learning_rate"):
        make(REINFORCE, actor_learning_rate=rate)
