"""Batches and single observations, arrays or dicts of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_crpn.arrays import IntArray, Observations


def all_finite(value: Any) -> bool:
    """Tell whether an array, or each one of a dict, is free of NaN and infinity."""
    arrays = value.values() if isinstance(value, dict) else (value,)
    return all(
        np.isfinite(array).all() for array in arrays if np.issubdtype(array.dtype, np.floating)
    )


def as_observation(space: spaces.Space[Any], observation: Any) -> Any:
    """Return one observation as an array of the space's shape and dtype, or a dict of them.

    Environments may return Python numbers, lists, or dicts of such.
    """
    if isinstance(space, spaces.Dict):
        return {
            key: as_observation(subspace, observation[key])
            for key, subspace in space.spaces.items()
        }
    array, shape = np.asarray(observation, dtype=space.dtype), space.shape or ()
    if array.size != np.prod(shape):
        raise ValueError(f"the environment returned an observation of {array.shape}, not {shape}")
    return array.reshape(shape)


def as_arrays(observations: Any) -> Any:
    """Return a batch of observations as an array, or a dict of arrays."""
    if isinstance(observations, dict):
        return {key: np.asarray(array) for key, array in observations.items()}
    return np.asarray(observations)


def map_observations(
    observations: Observations, function: Callable[[torch.Tensor], torch.Tensor]
) -> Observations:
    """Apply ``function`` to the observation tensor, or to each one of a dict."""
    if isinstance(observations, dict):
        return {key: function(tensor) for key, tensor in observations.items()}
    return function(observations)


def take_rows(observations: Observations, rows: slice | IntArray | torch.Tensor) -> Observations:
    """Return the chosen ``rows`` of the observation tensor, or of each one of a dict."""
    return map_observations(observations, lambda tensor: tensor[rows])
