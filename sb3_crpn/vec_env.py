"""Gymnasium's vector environments as Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv, VectorWrapper
from gymnasium.wrappers import vector as wrappers
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices as Indices
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from stable_baselines3.common.vec_env.util import dict_to_obs, obs_space_info

from sb3_crpn.arrays import Array

AnyVectorEnv: TypeAlias = VectorEnv[Any, Any, Any]
Info: TypeAlias = dict[str, Any]
Infos: TypeAlias = list[Info]
Leaves: TypeAlias = dict[Any, Array]

# Their reset treats a partial reset as a full one (or, NormalizeObservation, refuses it).
_DEAF_TO_RESET_MASK = (
    wrappers.NormalizeObservation,
    wrappers.NormalizeReward,
    wrappers.RecordEpisodeStatistics,
)


class GymnasiumVecEnv(VecEnv):
    """A ``gymnasium.vector.VectorEnv`` as SB3 ``VecEnv``, so that any SB3 algorithm can use it.

    SB3 expects of a finished episode that the observation returned with ``done`` is the first of
    the next episode, and ``info["terminal_observation"]`` the last of the finished one. Every
    transition returned is a true one in each autoreset mode:

    - ``SAME_STEP`` is SB3's own convention; the last observation is ``infos["final_obs"]``.
    - ``DISABLED``: finished environments are reset by ``reset(options={"reset_mask": done})``.
    - ``NEXT_STEP``: likewise, before gymnasium spends a step of theirs on the reset. This needs
      an environment that honours ``reset_mask``: ``SyncVectorEnv``, ``AsyncVectorEnv`` with shared
      memory, CartPole's vector entry point (taught to here), or any other for which
      ``reset_mask=True`` is passed. The rest have no exact adaptation and raise ``ValueError``.

    ``info["episode"]`` holds the return, length and time of the episode as seen here, as SB3's
    ``Monitor`` reports them; there is no need for a ``Monitor`` or ``VecMonitor``.

    Parameters
    ----------
    env
        The vector environment, possibly wrapped, with ``metadata["autoreset_mode"]``.
    reset_mask
        Whether a third-party environment in ``NEXT_STEP`` mode honours ``options["reset_mask"]``:
        it resets those environments alone, and takes a true step of all of them next.
    """

    def __init__(self, env: AnyVectorEnv, *, reset_mask: bool = False):
        self.env = env
        self._same_step = _check_autoreset(env, reset_mask) is AutoresetMode.SAME_STEP
        self._base: Any = env.unwrapped
        _, _, self._obs_dtypes = obs_space_info(env.single_observation_space)
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self.metadata = env.metadata
        self._actions = np.empty(0)
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, dtype=int)
        self._start_time = time.time()

    def reset(self) -> VecEnvObs:
        """Reset all environments, with the seeds and options set since the last reset.

        ``SyncVectorEnv`` and ``AsyncVectorEnv`` give environment i the seed ``seed + i``; a vector
        entry point has one generator for all environments and seeds it with ``seed``.
        """
        obs, infos = self.env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = self._split(infos)
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return self._observation(self._leaves(obs))

    def step_async(self, actions: Array) -> None:
        """Keep the actions for ``step_wait``."""
        self._actions = np.asarray(actions, dtype=self.env.action_space.dtype)

    def step_wait(self) -> VecEnvStepReturn:
        """Take one step in every environment; begin the next episode where one has ended."""
        obs, rewards, *ends, infos = self.env.step(self._actions)
        terminated, truncated = np.asarray(ends).astype(np.bool_)  # 0 and 1 are no masks
        leaves, env_infos = self._leaves(obs), self._split(infos)
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        ended = done.nonzero()[0]
        if ended.size:
            begin = self._take_final if self._same_step else self._reset_done
            self._record_episodes(ended, begin(ended, leaves, infos, env_infos), env_infos)
        for info, limit in zip(env_infos, (truncated & ~terminated).tolist(), strict=True):
            info["TimeLimit.truncated"] = limit
        return self._observation(leaves), rewards.astype(np.float32), done, env_infos

    def _take_final(self, ended: Array, leaves: Leaves, infos: Info, env_infos: Infos) -> list[Any]:
        """SAME_STEP: gymnasium has reset already; return the episodes' last observations."""
        if "final_obs" not in infos:
            raise ValueError(f"{self.env} is in mode SAME_STEP but gives no infos['final_obs']")
        final_obs, final_infos = infos["final_obs"], self._split(infos.get("final_info", {}))
        for i in ended:
            self.reset_infos[i], env_infos[i] = env_infos[i], final_infos[i]
        if isinstance(final_obs, np.ndarray) and final_obs.dtype == object:
            return [self._observation(self._leaves(obs)) for obs in final_obs[ended]]
        return self._rows(self._leaves(final_obs), ended)

    def _reset_done(self, ended: Array, leaves: Leaves, infos: Info, env_infos: Infos) -> list[Any]:
        """NEXT_STEP, DISABLED: the same, after putting first observations into ``leaves``."""
        terminal_obs = self._rows(leaves, ended)
        mask = np.zeros(self.num_envs, dtype=np.bool_)
        mask[ended] = True
        obs, infos = self.env.reset(options={"reset_mask": mask})
        for key, leaf in leaves.items():
            leaf[ended] = (obs if key is None else obs[key])[ended]
        reset_infos = self._split(infos)
        for i in ended:
            self.reset_infos[i] = reset_infos[i]
        return terminal_obs

    def _record_episodes(self, ended: Array, last_obs: list[Any], env_infos: Infos) -> None:
        elapsed = round(time.time() - self._start_time, 6)
        returns, lengths = self._returns[ended].tolist(), self._lengths[ended].tolist()
        for i, obs, r, length in zip(ended, last_obs, returns, lengths, strict=True):
            env_infos[i]["terminal_observation"] = obs
            env_infos[i]["episode"] = {"r": round(r, 6), "l": length, "t": elapsed}
        self._returns[ended] = 0.0
        self._lengths[ended] = 0

    def _leaves(self, obs: Any) -> Leaves:
        """Copy an observation into arrays of the space's dtypes: {key: array}, or {None: array}."""
        return {
            key: np.array(obs if key is None else obs[key], dtype=dtype)
            for key, dtype in self._obs_dtypes.items()
        }

    def _observation(self, leaves: Leaves) -> VecEnvObs:
        return leaves[None] if None in leaves else dict_to_obs(self.observation_space, leaves)

    def _rows(self, leaves: Leaves, indices: Array) -> list[Any]:
        """Return copies of single environments' observations."""
        chosen = {key: leaf[indices] for key, leaf in leaves.items()}
        rows = zip(*chosen.values(), strict=True)
        return [self._observation(dict(zip(chosen, row, strict=True))) for row in rows]

    def _split(self, infos: Info) -> Infos:
        """Turn gymnasium's dict of arrays, valid where ``_key`` is True, into a dict per env."""
        env_infos: Infos = [{} for _ in range(self.num_envs)]
        for key, values in infos.items():
            if key.startswith("_") or key in ("final_obs", "final_info"):
                continue
            if isinstance(values, dict):
                values = self._split(values)
            elif isinstance(values, np.ndarray) and values.ndim == 1:
                values = values.tolist()
            mask = infos.get(f"_{key}")
            for i in range(self.num_envs) if mask is None else np.flatnonzero(mask):
                env_infos[i][key] = values[i]
        return env_infos

    def set_options(self, options: list[Info] | Info | None = None) -> None:
        """Set the options of the next reset, the same for all environments."""
        if isinstance(options, list) and any(option != options[0] for option in options):
            raise ValueError(f"{self.env} takes one dict of options for all, got {options}")
        super().set_options(options)

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_images(self) -> Sequence[Array | None]:
        """Return one RGB image per environment when ``render_mode`` is ``"rgb_array"``."""
        frames: Any = self.env.render() if self.render_mode == "rgb_array" else None
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the sub-environments, or of a vector environment without any."""
        if isinstance(self._base, SyncVectorEnv | AsyncVectorEnv):
            # Asked first, since an exception would end the workers of an AsyncVectorEnv.
            if not all(self._base.call("has_wrapper_attr", attr_name)):
                raise AttributeError(f"{self.env}: no attribute {attr_name!r} in every environment")
            values = list(self._base.call("get_wrapper_attr", attr_name))
        else:
            values = [getattr(self._owner(attr_name), attr_name)] * self.num_envs
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the sub-environments, or of a vector environment without any."""
        if isinstance(self._base, SyncVectorEnv | AsyncVectorEnv):
            values = [value] * self.num_envs if indices is None else self.get_attr(attr_name)
            for i in self._get_indices(indices):
                values[i] = value
            self._base.set_attr(attr_name, values)
        elif set(self._get_indices(indices)) == set(range(self.num_envs)):
            setattr(self._owner(attr_name), attr_name, value)
        else:
            raise NotImplementedError(f"{self.env} shares {attr_name!r} among all environments")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the sub-environments; of an ``AsyncVectorEnv``, of all of them."""
        chosen = list(self._get_indices(indices))
        if isinstance(self._base, SyncVectorEnv):
            methods = [self._base.envs[i].get_wrapper_attr(method_name) for i in chosen]
            return [method(*method_args, **method_kwargs) for method in methods]
        is_async = isinstance(self._base, AsyncVectorEnv)
        if not is_async or sorted(chosen) != list(range(self.num_envs)):
            raise NotImplementedError(
                f"{self.env} cannot call {method_name!r} on environments {chosen}: "
                "SyncVectorEnv can, and AsyncVectorEnv on all environments at once"
            )
        results = self._base.call(method_name, *method_args, **method_kwargs)
        return [results[i] for i in chosen]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """Whether the environments are wrapped; ``Monitor``'s work is done here, hence True.

        Sub-environments are only within reach in a ``SyncVectorEnv``; False elsewhere.
        """
        chosen = list(self._get_indices(indices))
        if wrapper_class is Monitor:
            return [True] * len(chosen)
        if isinstance(self._base, SyncVectorEnv):
            return [is_wrapped(self._base.envs[i], wrapper_class) for i in chosen]
        return [False] * len(chosen)

    def _owner(self, attr_name: str) -> AnyVectorEnv:
        owners = (env for env in _layers(self.env) if hasattr(env, attr_name))
        return next(owners, self.env.unwrapped)


def _layers(env: AnyVectorEnv) -> Iterator[AnyVectorEnv]:
    """Yield the vector environment and what it wraps, outermost first."""
    while isinstance(env, VectorWrapper):
        yield env
        env = env.env
    yield env


def _check_autoreset(env: AnyVectorEnv, reset_mask: bool) -> AutoresetMode:
    """Return the autoreset mode; raise ValueError where the adaptation would not be exact."""
    mode = env.metadata.get("autoreset_mode") if isinstance(env, VectorEnv) else None
    if not isinstance(mode, AutoresetMode):
        raise ValueError(
            "env must be a gymnasium.vector.VectorEnv with metadata['autoreset_mode'] among "
            f"{list(AutoresetMode)}, got {env!r} with {mode!r}"
        )
    deaf = () if mode is AutoresetMode.SAME_STEP else _DEAF_TO_RESET_MASK
    for layer in _layers(env):
        if isinstance(layer, (wrappers.DictInfoToList, *deaf)):
            raise ValueError(
                f"{type(layer).__name__} cannot be adapted in mode {mode}: remove it (infos and "
                "episode statistics are dealt with here), or use SB3's VecNormalize in its place"
            )
    if mode is AutoresetMode.NEXT_STEP and not reset_mask:
        _require_reset_mask(env)
    return mode


def _require_reset_mask(env: AnyVectorEnv) -> None:
    base: Any = env.unwrapped
    # Without shared memory the workers of gymnasium 1.4 keep their autoreset flag over a reset.
    honoured = isinstance(base, SyncVectorEnv) or (
        isinstance(base, AsyncVectorEnv) and base.shared_memory
    )
    if type(env.unwrapped) is CartPoleVectorEnv:
        base.reset = partial(_reset_cartpole, base)  # innermost, so that wrappers see it too
    elif not honoured:
        raise ValueError(
            f"{env} is in mode NEXT_STEP and not known to honour options['reset_mask']: use "
            "gymnasium.make_vec(..., vectorization_mode='sync' or 'async', vector_kwargs="
            "{'autoreset_mode': AutoresetMode.SAME_STEP}), or an AsyncVectorEnv with "
            "shared_memory=True, or pass reset_mask=True if the environment does honour it"
        )


def _reset_cartpole(
    env: CartPoleVectorEnv, *, seed: int | None = None, options: Info | None = None
) -> tuple[Array, Info]:
    """``CartPoleVectorEnv.reset`` with ``reset_mask``, drawing states as its autoreset does."""
    if options is None or "reset_mask" not in options:
        return CartPoleVectorEnv.reset(env, seed=seed, options=options)
    state: Any = env.state
    mask = options["reset_mask"]
    state[:, mask] = env.np_random.uniform(env.low, env.high, size=(4, np.count_nonzero(mask)))
    env.steps[mask] = 0
    env.prev_done[mask] = False
    return state.T.astype(np.float32), {}
