"""Expectations of the estimates from segments, by enumeration of all paths.

Every path of N steps of a small MDP that goes on for ever is an environment of one rollout, and
counts with its probability: estimates of g and H, which are linear in the cost advantages, are
then their own expectations. The exact values solve linear equations. DESIGN section 2.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.autograd.functional import hessian, jacobian

from sb3_crpn.curvature import Causal, estimate_curvature
from sb3_crpn.episodes import EpisodeRolloutBuffer, RolloutSize, TimestepTracker
from sb3_crpn.parameters import ActorParameters

GAMMA = 0.8
N_TIMES = 60  # episodes that take longer have probability below 1e-9
S, A = 2, 2


@dataclass(frozen=True, eq=False)
class Endless:
    """Two states, two actions. An episode ends with probability ``stop``. Then another begins."""

    initial: torch.Tensor
    transition: torch.Tensor
    reward: torch.Tensor
    stop: torch.Tensor

    def probabilities(self, theta):
        """π(a|s), for θ = the weight [A, S] and bias [A] of SB3's action_net."""
        weight, bias = theta.split([A * S, A])
        return torch.softmax(weight.view(A, S).T + bias, dim=1)

    def values(self, theta):
        """V(s), [S], the solution of Bellman's equation."""
        policy = self.probabilities(theta)
        onward = (policy * (1 - self.stop))[:, :, None] * self.transition
        return torch.linalg.solve(
            torch.eye(S, dtype=torch.float64) - GAMMA * onward.sum(1), (policy * self.reward).sum(1)
        )

    def advantages(self, theta):
        """Q(s, a) - V(s), [S, A]."""
        values = self.values(theta)
        after = GAMMA * (1 - self.stop) * (self.transition @ values)
        return self.reward + after - values[:, None]

    def visited(self, theta, times):
        """The distribution of state and time one step after ``times``, [N_TIMES, S]."""
        policy = self.probabilities(theta)
        goes_on = torch.einsum("ts,sa,sau->tu", times, policy * (1 - self.stop), self.transition)
        ended = torch.einsum("ts,sa->", times, policy * self.stop)
        return torch.cat([(ended * self.initial)[None], goes_on[:-1]])

    def stationary(self, theta):
        """The stationary distribution of state and time, and the mean length of an episode."""
        flow = torch.zeros(N_TIMES, S, dtype=torch.float64)
        flow[0] = self.initial
        policy = self.probabilities(theta)
        for time in range(N_TIMES - 1):
            flow[time + 1] = torch.einsum(
                "s,sa,sau->u", flow[time], policy * (1 - self.stop), self.transition
            )
        return flow / flow.sum(), flow.sum()


def random_endless(seed=3):
    rng = np.random.default_rng(seed)
    return Endless(
        initial=torch.from_numpy(rng.dirichlet(np.ones(S))),
        transition=torch.from_numpy(rng.dirichlet(np.ones(S), (S, A))),
        reward=torch.from_numpy(rng.uniform(-1.0, 2.0, (S, A))),
        stop=torch.from_numpy(rng.uniform(0.3, 0.6, (S, A))),
    )


MDP = random_endless()
THETA = torch.tensor([0.7, -1.1, 0.4, 0.9, -0.3, 0.2], dtype=torch.float64)


def exact_policy():
    """SB3's policy at θ whose critic is V."""
    policy = ActorCriticPolicy(spaces.Discrete(S), spaces.Discrete(A), lambda _: 0.0, net_arch=[])
    policy.set_training_mode(False)
    distribution = policy.get_distribution(torch.zeros(1, dtype=torch.long))
    actor = ActorParameters.reachable(policy, distribution.log_prob(torch.zeros(1)))
    actor.assign(THETA)
    with torch.no_grad():
        policy.value_net.weight.copy_(MDP.values(THETA)[None])
        policy.value_net.bias.zero_()
    return policy, actor


def paths(start, n_steps):
    """All paths from the states and times of ``start`` [N_TIMES, S].

    Their first times [P], probabilities [P], and states [n + 1, P], actions and ends [n, P].
    """
    policy = MDP.probabilities(THETA)
    rows = []
    branches = list(itertools.product(range(A), (False, True), range(S)))
    for time, state in torch.nonzero(start > 0).tolist():
        for path in itertools.product(branches, repeat=n_steps):
            probability, now, states = start[time, state].item(), state, [state]
            for action, ends, after in path:
                stop = MDP.stop[now, action]
                arrives = stop * MDP.initial[after] if ends else 0.0
                if not ends:
                    arrives = (1 - stop) * MDP.transition[now, action, after]
                probability *= float(policy[now, action] * arrives)
                now = after
                states.append(now)
            rows.append((time, probability, states, [b[0] for b in path], [b[1] for b in path]))
    times, weights, states, actions, dones = map(np.array, zip(*rows, strict=True))
    return times, weights, states.T, actions.T, dones.T


def expected(start, n_steps, *, kappa=0.0, gae_lambda=0.95, discount_visitation=True):
    """E[g] and E[H], [d] and [d, d], of ``n_steps`` from the initial distribution ``start``."""
    times, weights, states, actions, dones = paths(start, n_steps)
    assert weights.sum() == pytest.approx(1.0, abs=1e-9)
    policy, actor = exact_policy()
    n_paths, unknown = len(times), torch.zeros(len(times))
    buffer = EpisodeRolloutBuffer(
        n_steps,
        policy.observation_space,
        policy.action_space,
        "cpu",
        gae_lambda,
        GAMMA,
        n_envs=n_paths,
    )
    tracker = TimestepTracker()
    tracker.begin(RolloutSize(n_steps, 1), times)
    for h in range(n_steps):
        rewards = MDP.reward.numpy()[states[h], actions[h]]
        buffer.add(states[h], actions[h], rewards, np.zeros(n_paths), unknown, unknown)
        for segment in tracker.advance(dones[h]):
            buffer.close(segment, states[h + 1, segment.env] if segment.cut else None)
    buffer.finish(policy, states[-1])
    batch = buffer.episode_batch(
        baseline=True, normalize_advantage=False, discount_visitation=discount_visitation
    )
    weights = np.repeat(n_paths * weights[batch.trajectories % n_paths], batch.lengths)
    weighted = replace(batch, cost_advantages=weights * batch.cost_advantages, unit="n_steps")
    estimate = estimate_curvature(policy, actor, weighted, Causal(kappa))
    return estimate.gradient, estimate.hessian.to_dense()


def surrogate(theta, weights):
    """-Σ_s weights_s Σ_a π(a|s; θ) (Q - V)(s, a) with Q and V of π at ``THETA``."""
    return -(weights @ (MDP.probabilities(theta) * MDP.advantages(THETA)).sum(1))


def discounted(visits, discount_visitation=True):
    """Σ_t c^t visits [N_TIMES, S], c = γ or 1, [S]."""
    factor = GAMMA if discount_visitation else 1.0
    return factor ** torch.arange(N_TIMES, dtype=torch.float64) @ visits


def starts():
    """Three initial distributions: after a reset, arbitrary, and stationary."""
    anywhere = torch.zeros(N_TIMES, S, dtype=torch.float64)
    anywhere[0, 0], anywhere[2, 1], anywhere[3, 0] = 0.2, 0.3, 0.5
    reset = torch.zeros_like(anywhere)
    reset[0] = MDP.initial
    return {"reset": reset, "anywhere": anywhere, "stationary": MDP.stationary(THETA)[0]}


def close(estimate, exact, atol=3e-6):
    torch.testing.assert_close(estimate, exact, rtol=1e-5, atol=atol)  # float32 networks


@pytest.mark.parametrize("discount_visitation", [True, False])
@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("start", ["reset", "anywhere"])
def test_g_and_h_are_unbiased_for_the_visitation_of_the_rollout(
    start, gae_lambda, discount_visitation
):
    n_steps, visits = 3, starts()[start]
    options = {"gae_lambda": gae_lambda, "discount_visitation": discount_visitation}
    gradient, matrix = expected(visits, n_steps, **options)
    weights = torch.zeros(S, dtype=torch.float64)
    for _ in range(n_steps):
        weights = weights + discounted(visits, discount_visitation) / n_steps
        visits = MDP.visited(THETA, visits)
    close(gradient, jacobian(lambda theta: surrogate(theta, weights), THETA))
    close(matrix, hessian(lambda theta: surrogate(theta, weights), THETA))
    assert gradient.norm() > 0.05
    assert matrix.norm() > 0.01


def test_in_the_long_run_g_is_the_gradient_of_j_divided_by_the_mean_length():
    visits, mean_length = MDP.stationary(THETA)
    close(MDP.visited(THETA, visits), visits, atol=1e-9)
    gradient, _ = expected(visits[:20] / visits[:20].sum(), 1)  # times up to 19: 1e-5 is left
    cost = jacobian(lambda theta: -MDP.initial @ MDP.values(theta), THETA)
    torch.testing.assert_close(gradient, cost / mean_length, rtol=1e-3, atol=1e-5)


def pair_terms(kappa, n_lags):
    """C_k, [n_lags, d, d]: the contribution per step of pairs of steps at distance k.

    States have the long run's distribution, γ^i is dropped. C_0 is H's term of single steps.
    """

    def log_policy(theta):
        return MDP.probabilities(theta).log()

    policy = MDP.probabilities(THETA)
    scores = jacobian(log_policy, THETA)  # [S, A, d]
    gain = -policy * MDP.advantages(THETA)
    reached = MDP.stationary(THETA)[0].sum(0)
    terms = [hessian(lambda theta: surrogate(theta, reached), THETA)]
    onward = (policy * (1 - MDP.stop))[:, :, None] * MDP.transition
    past = torch.einsum("s,sat,sai->ti", reached, onward, scores)  # E[σ_i 1{s_i+k = t}]
    for lag in range(1, n_lags):
        crossed = kappa**lag * past.T @ torch.einsum("sa,sai->si", gain, scores)
        terms.append(crossed + crossed.T)
        past = onward.sum(1).T @ past
    return torch.stack(terms)


@pytest.mark.parametrize("kappa", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("n_steps", [1, 2, 3])
def test_a_cut_takes_the_pairs_across_it_and_no_others(n_steps, kappa):
    """E[H] = C_0 + Σ_k (1 - k/N)₊ C_k; the bias is bounded by the share of pairs removed."""
    stationary = MDP.stationary(THETA)[0].sum(0)
    start = torch.zeros(N_TIMES, S, dtype=torch.float64)
    start[0] = stationary  # without γ^i times do not matter
    _, matrix = expected(start, n_steps, kappa=kappa, discount_visitation=False)
    terms = pair_terms(kappa, N_TIMES)
    lags = torch.arange(N_TIMES, dtype=torch.float64)
    kept = (1 - lags / n_steps).clamp(min=0.0)
    close(matrix, torch.einsum("k,kij->ij", kept, terms))
    bias = matrix - terms.sum(0)
    removed = 1 - kept
    largest = torch.linalg.matrix_norm(terms, 2)
    assert torch.linalg.matrix_norm(bias, 2) <= removed @ largest + 1e-6
    if kappa == 0.0:
        assert bias.norm() < 1e-6
    else:
        assert bias.norm() > 1e-4


def test_the_bias_of_the_pairs_falls_as_one_over_the_length_of_segments():
    """‖bias‖ ≤ κ/(1-κ)² c/N, c = 2 max|A| max‖σ‖²: κ = 0.9 limits the distance of pairs."""
    policy = MDP.probabilities(THETA)
    scores = jacobian(lambda theta: MDP.probabilities(theta).log(), THETA)
    kappa = 0.9
    terms = pair_terms(kappa, N_TIMES)
    lags = torch.arange(N_TIMES, dtype=torch.float64)
    c = 2 * MDP.advantages(THETA).abs().max() * (scores**2).sum(2).max()
    biases = []
    for n_steps in (50, 100):
        removed = (lags / n_steps).clamp(max=1.0)
        bias = torch.linalg.matrix_norm(torch.einsum("k,kij->ij", removed, terms), 2)
        assert bias <= kappa / (1 - kappa) ** 2 * c / n_steps
        biases.append(bias.item())
    assert policy.min() > 0.05
    assert biases[1] == pytest.approx(biases[0] / 2, rel=1e-3)
