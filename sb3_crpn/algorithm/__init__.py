"""The update that CRPN and ACRPN share: collect, estimate, solve, accept, fit the critic, log."""

from sb3_crpn.algorithm.algorithm import PolicyNewtonAlgorithm

__all__ = ["PolicyNewtonAlgorithm"]
