"""The actor's parameters as one vector θ of ℝᵈ: select, flatten, assign, restore."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import nn


class ActorParameters:
    """The tensors that the actor's output depends on, seen as one vector θ.

    Parameters
    ----------
    tensors
        The parameters, in the order in which θ lists them.
    """

    def __init__(self, tensors: Iterable[nn.Parameter]) -> None:
        self.tensors = tuple(tensors)
        if not self.tensors:
            raise ValueError(
                "the policy's log-probabilities depend on no trainable parameter: "
                "at least one parameter of the actor needs requires_grad=True"
            )
        self._sizes = [tensor.numel() for tensor in self.tensors]

    @classmethod
    def reachable(cls, module: nn.Module, output: torch.Tensor) -> ActorParameters:
        """Select the parameters of ``module`` that the gradient of ``output`` reaches.

        Names say nothing about a custom policy; reachability holds for every one, shared feature
        extractors included. The order is that of ``module.named_parameters()``.
        """
        candidates = [p for p in module.parameters() if p.requires_grad]
        if not output.requires_grad:
            return cls([])
        gradients = torch.autograd.grad(output.sum(), candidates, allow_unused=True)
        return cls(p for p, g in zip(candidates, gradients, strict=True) if g is not None)

    def __len__(self) -> int:
        """Return d, the number of scalar parameters."""
        return sum(self._sizes)

    @property
    def device(self) -> torch.device:
        """The device of θ."""
        return self.tensors[0].device

    @property
    def vector(self) -> torch.Tensor:
        """A copy of θ, float64 of shape [d]: exact for float32 networks."""
        return self.flatten(tensor.detach() for tensor in self.tensors)

    def flatten(self, tensors: Iterable[torch.Tensor]) -> torch.Tensor:
        """Concatenate one tensor per parameter into a float64 vector [d]."""
        return torch.cat([tensor.reshape(-1).to(torch.float64) for tensor in tensors])

    def unflatten(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """Cut a vector [d] into tensors of the parameters' shapes, dtypes and devices."""
        pieces = torch.split(vector, self._sizes)
        return [
            piece.to(like.device, like.dtype).reshape(like.shape)
            for piece, like in zip(pieces, self.tensors, strict=True)
        ]

    def assign(self, vector: torch.Tensor) -> None:
        """Set θ to ``vector`` [d], rounded to the parameters' own precision.

        Raises
        ------
        ValueError
            If the shape is not [d], or an entry is or becomes non-finite; θ is then unchanged.
        """
        vector = torch.as_tensor(vector)
        if vector.shape != (len(self),):
            raise ValueError(f"vector has shape {tuple(vector.shape)}, must be ({len(self)},)")
        tensors = self.unflatten(vector)
        if not all(torch.isfinite(tensor).all() for tensor in tensors):
            raise ValueError(
                "vector has non-finite entries, must be finite in the parameters' precision"
            )
        self.load(tensors)

    def snapshot(self) -> list[torch.Tensor]:
        """Return copies of the tensors, for :meth:`load`."""
        return [tensor.detach().clone() for tensor in self.tensors]

    def load(self, tensors: Sequence[torch.Tensor]) -> None:
        """Copy ``tensors`` back into the parameters, bit for bit."""
        with torch.no_grad():
            for parameter, tensor in zip(self.tensors, tensors, strict=True):
                parameter.copy_(tensor)
