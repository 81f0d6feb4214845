import numpy as np
import pytest

from sb3_crpn.sosp import certify_sosp
from tests.sosp.problems import saddle


def test_the_report_reads_and_draws():
    report = certify_sosp(saddle(n_envs=20), 400, epsilon=0.5, rho=1.0, seed=0)
    text = str(report)
    assert text.startswith("saddle: ε = 0.5")
    assert "95% confidence (bootstrap)" in text
    assert f"{report.lambda_min.estimate:.3g}" in text
    assert "thresholds  ε given, ρ given" in text
    assert "\n" not in repr(report)
    assert repr(report).startswith("SospReport(saddle: ‖∇J‖ = ")
    assert repr(report.lambda_min) == f"Interval({report.lambda_min})"
    figure = report.plot()
    assert len(figure.axes) == 3
    figure.canvas.draw()


@pytest.mark.parametrize("rho", [1.0, 1e6], ids=["near", "far"])
def test_the_density_shows_every_ritz_value_within_limits(rho):
    report = certify_sosp(saddle(), 8, epsilon=0.5, rho=rho, seed=0)
    axes = report.plot().axes[2]
    assert axes.get_ylabel()
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    values = report.spectrum.values
    assert left < values[0] < values[-1] < right < left + 3.0 * (values[-1] - values[0]) + 2.0
    ends = np.concatenate([line.get_xydata() for line in axes.lines if line.get_marker() == "o"])
    assert sorted(ends[:, 0]) == pytest.approx(sorted(values))
    assert np.all((bottom < ends[:, 1]) & (ends[:, 1] < top))
