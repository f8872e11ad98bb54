"""Mocap actions: poses of the mocap bodies that lead moving bodies by constraints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from torchrl_gn.scenes.constraints import active_constraints, joins_bodies
from torchrl_gn.scenes.topology import named, weld_roots

COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")  # of a pose: position in metres, quaternion of any length above 0
REACH = 0.15  # metres: default bounds of positions, to either side of the reference
NEAR_TURN = 0.2  # bounds of drawn quaternion components, to either side of the model's
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class MocapActions:
    """Poses ``[K, 7]`` of mocap bodies at the end of a scene's actions."""

    body: np.ndarray  # [K] MuJoCo ids
    names: tuple[str, ...]  # [7 K] such as "hand.x"
    low: np.ndarray  # [7 K]
    high: np.ndarray  # [7 K]
    rest: np.ndarray  # [7 K] the poses of the model

    def __len__(self) -> int:
        """Return the number of actions, ``7 K``."""
        return len(self.names)

    @property
    def control_spec(self) -> int:
        """State components that :meth:`inputs` sets, for ``mujoco.rollout``."""
        parts = mujoco.mjtState
        poses = parts.mjSTATE_MOCAP_POS | parts.mjSTATE_MOCAP_QUAT
        return int(parts.mjSTATE_CTRL | poses if len(self) else parts.mjSTATE_CTRL)

    def inputs(self, model: mujoco.MjModel, actions: np.ndarray) -> np.ndarray:
        """Return ``rollout`` inputs for actions ``[*B, nu + 7 K]``: controls, mocap positions and quaternions."""
        if not len(self):
            return actions
        controls, mocap_poses = np.split(actions, [actions.shape[-1] - len(self)], axis=-1)
        mocap_poses = mocap_poses.clip(self.low, self.high).reshape(*actions.shape[:-1], len(self.body), 7)
        every = np.flatnonzero(model.body_mocapid >= 0)
        poses = np.empty((*actions.shape[:-1], model.nmocap, 7))
        poses[..., model.body_mocapid[every], :3] = model.body_pos[every]
        poses[..., model.body_mocapid[every], 3:] = model.body_quat[every]
        at, length = model.body_mocapid[self.body], np.linalg.norm(mocap_poses[..., 3:], axis=-1, keepdims=True)
        turn = np.where(length > _TINY, mocap_poses[..., 3:] / np.maximum(length, _TINY), [1.0, 0, 0, 0])
        poses[..., at, :] = np.concatenate((mocap_poses[..., :3], turn), axis=-1)
        flat = (poses[..., :3].reshape(*actions.shape[:-1], -1), poses[..., 3:].reshape(*actions.shape[:-1], -1))
        return np.concatenate((controls, *flat), axis=-1)


NO_MOCAP_ACTIONS = MocapActions(np.empty(0, dtype=np.int64), (), *np.empty((3, 0)))


def leading_mocaps(model: mujoco.MjModel) -> list[tuple[int, int, int]]:
    """List active connects and welds between a mocap body and a moving body: (constraint, mocap body, moving body)."""
    mocap_welds, fixed = [], weld_roots(model) == 0
    for equality in active_constraints(model):
        if not joins_bodies(model, equality):
            continue
        pair = np.array([model.eq_obj1id[equality], model.eq_obj2id[equality]])
        if model.eq_objtype[equality] == int(mujoco.mjtObj.mjOBJ_SITE):
            pair = model.site_bodyid[pair]
        root = model.body_rootid[pair]  # MuJoCo 3.3 counts mocap bodies as welded to the world
        leads = (model.body_mocapid[root] >= 0) & (model.body_weldid[pair] == model.body_weldid[root])
        for end in np.flatnonzero(leads & ~fixed[pair[::-1]]).tolist():
            mocap_welds.append((equality, int(root[end]), int(pair[1 - end])))
    return mocap_welds


def find_mocap_actions(
    model: mujoco.MjModel, chosen: Mapping[str, Sequence[float]] | Sequence[float] | None
) -> MocapActions:
    """Find the mocap bodies that lead others; bounds are ``chosen`` by name, or 0.15 m about the model's positions."""
    bodies = sorted({mocap for _, mocap, _ in leading_mocaps(model)})
    names = tuple(f"{named(model, mujoco.mjtObj.mjOBJ_BODY, body)}.{each}" for body in bodies for each in COLUMNS)
    rest_poses = np.concatenate((model.body_pos[bodies], model.body_quat[bodies]), axis=1).ravel()
    width = np.tile([REACH] * 3 + [np.inf] * 4, len(bodies))
    low, high = np.where(width < np.inf, rest_poses - width, -1.0), np.where(width < np.inf, rest_poses + width, 1.0)
    for index, name in enumerate(names):
        if isinstance(chosen, Mapping) and name in chosen:
            low[index], high[index] = map(float, chosen[name])
    return MocapActions(np.array(bodies, dtype=np.int64), names, low, high, rest_poses)
