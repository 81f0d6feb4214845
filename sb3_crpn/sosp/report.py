"""The report of a certificate: intervals, verdict, text and plot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from torch import Tensor

from sb3_crpn.sosp.inference import Interval
from sb3_crpn.sosp.spectrum import Spectrum
from sb3_crpn.sosp.thresholds import episodes_to_decide

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Verdict = Literal["sosp", "saddle", "not stationary", "undecided"]
IntervalMethod = Literal["bootstrap", "bernstein"]


@dataclass(frozen=True, eq=False)
class SospReport:
    """The certificate of one policy.

    Attributes
    ----------
    gradient_norm, lambda_min
        ‖∇J‖ and λ_min(∇²J) with their confidence intervals, which cover jointly with probability
        ``confidence``. The estimates ‖ĝ‖ and λ_min(Ĥ) belong to the mean gradient and Hessian.
        Noise makes the first too large and the second too small. The intervals account for that.
    epsilon, rho
        ε and ρ of ‖∇J‖ ≤ ε, λ_min(∇²J) ≥ -√(ρε).
    thresholds
        Origin of ε and ρ, as text.
    confidence, interval
        1 - δ, and the method of the intervals.
    n_episodes, n_steps
        Numbers of episodes and of steps in the estimates.
    debiased_gradient_norm
        Estimate of ‖∇J‖ without the bias of noise.
    gradient
        Estimate of ∇J, [d], in the order of those ``policy.parameters()`` that log π depends on.
    escape_direction
        Unit leftmost eigenvector v of Ĥ, [d], with v·ĝ ≤ 0.
    spectrum
        Leftmost eigenvalues and spectral density of Ĥ.
    """

    gradient_norm: Interval
    lambda_min: Interval
    epsilon: float
    rho: float
    thresholds: str
    confidence: float
    interval: IntervalMethod
    n_episodes: int
    n_steps: int
    debiased_gradient_norm: float
    gradient: Tensor
    escape_direction: Tensor
    spectrum: Spectrum

    @property
    def curvature_threshold(self) -> float:
        """-√(ρε)."""
        return -math.sqrt(self.rho * self.epsilon)

    @property
    def verdict(self) -> Verdict:
        """The conclusion from both intervals.

        "not stationary": ‖∇J‖ > ε. "sosp": ‖∇J‖ ≤ ε and λ_min ≥ -√(ρε). "saddle": ‖∇J‖ ≤ ε and
        λ_min < -√(ρε), which includes maxima of the cost. "undecided": a threshold lies inside its
        interval. A verdict is wrong with probability 1 - ``confidence`` at most. That holds for
        every choice of ε and ρ, since the intervals do not depend on them.
        """
        if self.gradient_norm.lower > self.epsilon:
            return "not stationary"
        if self.gradient_norm.upper <= self.epsilon:
            if self.lambda_min.lower >= self.curvature_threshold:
                return "sosp"
            if self.lambda_min.upper < self.curvature_threshold:
                return "saddle"
        return "undecided"

    @property
    def episodes_to_decide(self) -> int | None:
        """Approximate number of episodes that would decide; see :func:`episodes_to_decide`.

        ``None`` if the verdict is not "undecided", or if the intervals determine no number: an
        interval is unbounded, or an estimate lies on its threshold.
        """
        if self.verdict != "undecided":
            return None
        return episodes_to_decide(
            self.gradient_norm,
            self.lambda_min,
            self.debiased_gradient_norm,
            self.epsilon,
            self.curvature_threshold,
            self.n_episodes,
        )

    def __str__(self) -> str:
        """Return a summary of several lines."""
        leftmost = ", ".join(f"{value:.3g}" for value in self.spectrum.leftmost)
        lines = [
            f"{self.verdict}: ε = {self.epsilon:.3g}, ρ = {self.rho:.3g}, "
            f"{self.confidence:.0%} confidence ({self.interval})",
            f"  ‖∇J‖        {self.gradient_norm}, stationary: ≤ {self.epsilon:.3g}",
            f"  λ_min(∇²J)  {self.lambda_min}, "
            f"no escape: ≥ -√(ρε) = {self.curvature_threshold:.3g}",
            f"  thresholds  {self.thresholds}",
            f"  leftmost    {leftmost}",
            f"  {self.n_episodes} episodes, {self.n_steps} steps, d = {len(self.gradient)}",
        ]
        if self.verdict == "undecided":
            needed = self.episodes_to_decide
            number = "an unknown number of" if needed is None else f"about {needed:,}"
            lines.append(f"  {number} episodes would decide")
        return "\n".join(lines)

    def __repr__(self) -> str:
        """Return one line."""
        return (
            f"SospReport({self.verdict}: ‖∇J‖ = {self.gradient_norm}, λ_min = {self.lambda_min}, "
            f"ε = {self.epsilon:.3g}, -√(ρε) = {self.curvature_threshold:.3g}, "
            f"{self.n_episodes} episodes)"
        )

    def plot(self) -> Figure:
        """Draw both intervals with their thresholds, and the spectral density.

        Returns
        -------
        Figure
            Three axes: ‖∇J‖, λ_min(∇²J), density. Needs matplotlib.
        """
        from matplotlib.figure import Figure  # an optional dependency

        figure = Figure(figsize=(9.0, 3.4), layout="constrained")
        left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1, 3])
        _draw_interval(left, self.gradient_norm, self.epsilon, "‖∇J‖", "ε")
        _draw_interval(middle, self.lambda_min, self.curvature_threshold, "λ_min(∇²J)", "-√(ρε)")
        _draw_density(right, self.spectrum, self.curvature_threshold)
        figure.suptitle(f"{self.verdict} ({self.confidence:.0%} confidence)")
        return figure


def _draw_interval(
    axes: Axes, interval: Interval, threshold: float, title: str, threshold_name: str
) -> None:
    limits = [x for x in (interval.lower, interval.upper) if math.isfinite(x)]
    axes.plot([0] * len(limits), limits, "_-", color="C0", ms=12)
    axes.plot(0, interval.estimate, "o", color="C0")
    axes.axhline(threshold, color="C3", ls="--", lw=1)
    axes.set_xticks([])
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(f"{interval}\ndashed: {threshold_name} = {threshold:.3g}", fontsize=8)


def _draw_density(axes: Axes, spectrum: Spectrum, threshold: float) -> None:
    """Draw the density and the Ritz values. A stem's height is the Ritz value's peak density."""
    low, high = spectrum.values[0], spectrum.values[-1]
    if low - threshold <= max(high - low, 1e-12):  # a distant threshold would hide the spectrum
        low, high = min(low, threshold), max(high, threshold)
    else:
        axes.text(0.02, 0.9, "← -√(ρε)", color="C3", fontsize=8, transform=axes.transAxes)
    margin = 0.05 * max(high - low, 1e-12)
    width = 0.2 * margin
    points = np.linspace(low - margin, high + margin, 1000)
    density = spectrum.density(points, width=width)
    heights = spectrum.weights / (width * math.sqrt(2.0 * math.pi))
    top = max(density.max(), heights.max())
    # far below the share 1/d of one of a network's eigenvalues. Every stem is drawn above it
    bottom = 1e-7 * top
    leftmost = np.isin(spectrum.values, spectrum.leftmost)
    axes.semilogy(points, np.maximum(density, bottom), color="C0", lw=1)
    for chosen, colour, label in ((~leftmost, "C0", "Ritz values"), (leftmost, "C1", "leftmost")):
        values, ends = spectrum.values[chosen], np.maximum(heights[chosen], 3.0 * bottom)
        axes.vlines(values, bottom, ends, color=colour, lw=1)
        axes.plot(values, ends, "o", color=colour, ms=3, label=label)
    axes.axvline(threshold, color="C3", ls="--", lw=1)
    axes.locator_params(axis="x", nbins=6)
    axes.set_xlim(points[0], points[-1])
    axes.set_ylim(bottom, 3.0 * top)
    axes.legend(fontsize=8)
    axes.set_title("spectral density of ∇²J", fontsize=10)
    axes.set_xlabel("eigenvalue")
    axes.set_ylabel("share of eigenvalues per unit")
