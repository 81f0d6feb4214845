"""The constants of J and of its estimates, from K, G, L_1, L_2, H and d."""

from __future__ import annotations

import math
from dataclasses import dataclass

from sb3_crpn.checks import COUNT, FRACTION, POSITIVE, requires
from sb3_crpn.theory.policies import ScoreBounds

_SCORES = requires("a ScoreBounds", lambda value: isinstance(value, ScoreBounds))


@dataclass(frozen=True)
class Constants:
    r"""Bounds on J(θ) = -E[Σ_{h<H} γ^h r_h] and on Theorem 1's estimates of ∇J and ∇²J.

    Notation: σ_i = ∇log π_i, n = h + 1 is the number of actions up to step h, and
    S_p = Σ_{h<H} γ^h n^p. For γ = 1, S_0 to S_2 are H, H(H+1)/2 and H(H+1)(2H+1)/6. For γ < 1 they
    are at most 1/(1-γ), 1/(1-γ)² and 2/(1-γ)³.

    **Bounds on J.** Let v be a unit vector, a = v·Σ_{i≤h} σ_i, and let b and c be the same sums of
    vᵀ∇²log π v and ∇³log π[v, v, v]. The derivatives of E[r_h] along v are E[r_h a],
    E[r_h(a² + b)] and E[r_h(a³ + 3ab + c)]. The scores of one episode are martingale differences,
    E[σ_i|s_i] = 0, whence E[a²] ≤ nG². Also |a| ≤ nG, |b| ≤ nL_1 and |c| ≤ nL_2. ``M_g``, ``M_H``
    and ``L_H`` follow. With |a| ≤ nG alone they would be larger by factors of √n to n. M_g and M_H
    are those of Yuan, Gower and Lazaric (AISTATS 2022) at finite H.

    **Bounds on one episode's estimates** Σ_i Ψ_i σ_i and
    sym[(Σ_i Ψ_i σ_i)(Σ_j σ_j)ᵀ] + Σ_i Ψ_i ∇²log π_i. They use Σ_i|Ψ_i| ≤ K Σ_i Σ_{h≥i} γ^h = K S_1.
    ``G_g`` and ``G_H`` bound the norms, and hence the standard deviations. ``M_1`` and ``M_2``
    bound the deviations from the mean.

    Parameters
    ----------
    K
        Bound on the absolute reward (cost) of a step, in units of reward.
    scores
        G, L_1 and L_2 of the policy.
    H
        Length of the longest episode in steps.
    d
        Number of the actor's parameters, ``len(model.actor)``.
    gamma
        γ in [0, 1]. The constants at γ = 1 hold for every γ.

    Raises
    ------
    ValueError
        A parameter is out of range.

    Notes
    -----
    For a Gaussian policy G holds with high probability only. The same is true of the bounds on
    estimates. M_g, M_H and L_H always hold if the failure probability is at most 1/2. Then
    G ≥ 1.66 ‖φ‖/std, and E|a|³ ≤ (2n)^{3/2} max_i E|v·σ_i|³ (Rio, J. Theoret. Probab. 22, 2009).
    """

    K: float
    scores: ScoreBounds
    H: int
    d: int
    gamma: float = 1.0

    def __post_init__(self) -> None:
        checks = {"K": POSITIVE, "scores": _SCORES, "H": COUNT, "d": COUNT, "gamma": FRACTION}
        for name, check in checks.items():
            object.__setattr__(self, name, check(f"Constants: {name}", getattr(self, name)))

    def _moment(self, power: float) -> float:
        """S_p = Σ_{h<H} γ^h (h + 1)^p."""
        return math.fsum(self.gamma**h * (h + 1) ** power for h in range(self.H))

    @property
    def cost_bound(self) -> float:
        """|J| ≤ K S_0."""
        return self.K * self._moment(0)

    @property
    def M_g(self) -> float:  # noqa: N802
        """‖∇J‖ ≤ K G S_{1/2}."""
        return self.K * self.scores.G * self._moment(0.5)

    @property
    def M_H(self) -> float:  # noqa: N802
        """‖∇²J‖ ≤ K (G² + L_1) S_1, the Lipschitz constant of ∇J."""
        return self.K * (self.scores.G**2 + self.scores.L_1) * self._moment(1)

    @property
    def L_H(self) -> float:  # noqa: N802
        """‖∇²J(θ) - ∇²J(θ')‖ ≤ K (G³ S_2 + 3 G L_1 S_{3/2} + L_2 S_1) ‖θ - θ'‖ (Proposition 1)."""
        G, L_1, L_2 = self.scores.G, self.scores.L_1, self.scores.L_2
        mixed = 3.0 * G * L_1 * self._moment(1.5)
        return self.K * (G**3 * self._moment(2) + mixed + L_2 * self._moment(1))

    @property
    def G_g(self) -> float:  # noqa: N802
        """‖Σ_i Ψ_i σ_i‖ ≤ K G S_1 for every episode."""
        return self.K * self.scores.G * self._moment(1)

    @property
    def G_H(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇²J‖ ≤ K (H G² + L_1) S_1.

        It holds for "trajectory" and for "causal" at κ = 1, whose bound K (G² S_2 + L_1 S_1) is
        not larger.
        """
        return self.K * (self.H * self.scores.G**2 + self.scores.L_1) * self._moment(1)

    @property
    def M_1(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇J - ∇J‖ ≤ G_g + M_g."""
        return self.G_g + self.M_g

    @property
    def M_2(self) -> float:  # noqa: N802
        """‖one episode's estimate of ∇²J - ∇²J‖ ≤ G_H + M_H."""
        return self.G_H + self.M_H

    def gradient_error(self, n_episodes: int) -> float:
        """Bound (E‖g - ∇J‖²)^½ of the mean of m episodes: G_g/√m."""
        n_episodes = COUNT("gradient_error: n_episodes", n_episodes)
        return self.G_g / math.sqrt(n_episodes)

    def hessian_error(self, n_episodes: int) -> float:
        r"""Bound (E‖H - ∇²J‖³)^⅓ of the mean of b episodes: M_2 √((3 + 2 log 2d)/b).

        With s² = M_2²/b the matrix Hoeffding inequality (Mackey, Jordan, Chen, Farrell and Tropp,
        Ann. Probab. 42, 2014, Corollary 4.2) is P(‖H - ∇²J‖ ≥ t) ≤ 2d exp(-t²/2s²). The bound is 1
        at t_0² = us², u = 2 log 2d. Its integral from t_0 gives
        E‖H - ∇²J‖³ ≤ s³(u^{3/2} + 3u^{1/2} + 3u^{-1/2}) ≤ s³(u + 3)^{3/2}.
        """
        n_episodes = COUNT("hessian_error: n_episodes", n_episodes)
        return self.M_2 * math.sqrt((3.0 + 2.0 * math.log(2.0 * self.d)) / n_episodes)
