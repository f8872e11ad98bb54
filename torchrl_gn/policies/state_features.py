"""Normalised features of a scene's states, for networks of policies, values and rewards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from numbers import Integral
from typing import Any, cast

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics import Canonicalizer
from torchrl_gn.dynamics.features.canonical_state import CanonicalState
from torchrl_gn.finite import require_real
from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.normalizer import Normalizer, unchanged_on_error
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.rewards.bodies import find_body
from torchrl_gn.scenes import PhysicalParameters, Scene, require_bodies, scene_from_description

_STATES = 16  # random states at which rewards are compared
FLOOR, LIMIT = 1e-6, 5.0  # rounding noise as standard deviation; limit on features, in standard deviations
_SMALLEST = 1e-3  # smallest size of a geom or site, metres


class StateFeatures(Float64Buffers):
    """Canonical states of all bodies, encoded as in the forward model, normalised and concatenated.

    Features are clipped at five standard deviations, because a planner may leave the data.

    Args:
        canonicalizer: the scene's invariances to build in, see :func:`task_invariances`. Default: none.
        target: True if episodes have a target, a position ``[*B, 3]``, metres, world frame; needs ``recenter=False``.
            Body positions are then relative to the target along the scene's translation-invariant axes; the target's
            other coordinates are features. Further features are the offset of every moving geom and site from the
            target, and the log of its distance. A network that had to add a hand's length to the hand's pose would err
            by more than the distances that decide rewards near a target.

    Raises:
        TypeError: the scene is a kinematic tree.
        ValueError: there is a target, and the canonicaliser recentres.
    """

    rest: Tensor
    pivot: Tensor
    shifted: Tensor
    nodes: Tensor
    offset: Tensor
    sized: Tensor

    def __init__(self, scene: Scene, canonicalizer: Canonicalizer | None = None, *, target: bool = False) -> None:
        super().__init__()
        require_bodies(scene, "A policy, value or reward")
        if target and canonicalizer is not None and canonicalizer.recenter:
            raise ValueError("Features with a target need recenter=False: positions relative to the target count.")
        self.target = target
        self.scene, self.options = scene, canonicalizer or Canonicalizer(recenter=False, yaw=False)
        self.canonicalizer = self.options.bind(scene, scene.layout)
        self.physical = PhysicalParameters.of(scene)
        self.constants({"rest": self.physical.rest, "pivot": self.physical.pivot})
        self.constants({"shifted": np.outer(scene.predicted, scene.translation_invariant)})  # [N, 3]
        self.size = scene.num_nodes * scene.layout.encoded_size()
        if target:
            self.constants(_places(scene))
            self.size += 3 + 4 * len(self.nodes)
        self.normalizer = Normalizer(self.size, floor=FLOOR, limit=LIMIT)

    @property
    def fitted(self) -> bool:
        """True if the normaliser has data; reading it synchronises with the device."""
        return self.normalizer.fitted

    @torch.no_grad()
    def fit(self, state: Tensor, target: Tensor | None = None) -> None:
        """Fit the normaliser to states ``[*B, N, 13]`` unless it is fitted; ValueError if one is not finite."""
        if not self.fitted:
            self.update(state, target)

    @torch.no_grad()
    @without_autocast
    def refit(self, state: Tensor, target: Tensor | None = None, dtype: torch.dtype | None = None) -> Tensor:
        """Refit the normaliser to states ``[*B, N, 13]`` only; return their features. ValueError for NaN or Inf."""
        encoded = self._encoded(state, target)
        with unchanged_on_error(self):
            self.normalizer.reset()
            self.normalizer.update(encoded)
        return self.normalizer(encoded, dtype)

    @torch.no_grad()
    @without_autocast
    def update(self, state: Tensor, target: Tensor | None = None) -> None:
        """Add states ``[*B, N, 13]`` to the normaliser; ValueError if one is not finite."""
        self.normalizer.update(self._encoded(state, target))

    @without_autocast
    def forward(self, state: Tensor, dtype: torch.dtype | None = None, target: Tensor | None = None) -> Tensor:
        """Return features ``[*B, F]`` of states ``[*B, N, 13]``; differentiable. ValueError if a target is missing."""
        return self.normalizer(self._encoded(state, target), dtype)

    def _encoded(self, state: Tensor, target: Tensor | None) -> Tensor:
        check_states(self.scene, state)
        if not self.target:
            return self._of(self._canonical(state))
        if target is None or target.shape != (*state.shape[:-2], 3):
            shape = None if target is None else list(target.shape)
            raise ValueError(f"States {list(state.shape)} need a target {[*state.shape[:-2], 3]}, got {shape}.")
        target, free = target.to(state.dtype), self.shifted.to(state.dtype)
        seen = self._canonical(state - pad(target.unsqueeze(-2) * free, (0, state.shape[-1] - 3)))
        fixed = target * (1 - free.amax(0))
        return torch.cat((self._of(seen), fixed, self._from(seen, fixed)), -1)

    def _canonical(self, state: Tensor) -> CanonicalState:
        return self.canonicalizer(state, self.physical._replace(rest=self.rest, pivot=self.pivot))

    def _of(self, seen: CanonicalState) -> Tensor:
        """Return the features of the bodies."""
        return self.scene.layout.encode(seen.state, "matrix", seen.matrices).flatten(-2)

    def _from(self, seen: CanonicalState, target: Tensor) -> Tensor:
        """Return offsets and log distances ``[*B, 4 P]`` of the moving geoms and sites from a target ``[*B, 3]``."""
        if seen.rotation is not None:
            pivot = self.pivot.to(target.dtype)
            target = ((target - pivot).unsqueeze(-2) @ seen.rotation.matrix).squeeze(-2) + pivot
        matrices = cast(Tensor, seen.matrices).index_select(-3, self.nodes)
        arm = (matrices @ self.offset.to(matrices.dtype).unsqueeze(-1)).squeeze(-1)
        away = seen.state[..., :3].index_select(-2, self.nodes) + arm - target.unsqueeze(-2)
        # Linear in the squared distance below the size of the geom or site, logarithmic above.
        far = (away.square().sum(-1) / self.sized.to(away.dtype).square()).log1p()
        return torch.cat((away.flatten(-2), far), -1)

    def description(self) -> dict[str, Any]:
        """Return JSON-able values for :meth:`arguments_from`."""
        target = {"target": True} if self.target else {}
        return {"scene": self.scene.description(), "canonicalizer": asdict(self.options), **target}

    @staticmethod
    def arguments_from(description: dict[str, Any]) -> dict[str, Any]:
        """Return ``scene``, ``canonicalizer`` and the other arguments of a network from its description.

        The description may hold the scene itself in place of the scene's description.
        """
        scene = description["scene"]
        if not isinstance(scene, Scene):
            scene = require_bodies(scene_from_description(scene), "A policy, value or reward")
        canonicalizer = description["canonicalizer"]
        return {**description, "scene": scene, "canonicalizer": Canonicalizer.from_description(canonicalizer)}


def _places(scene: Scene) -> dict[str, Any]:
    """Find the moving geoms and sites.

    Returns ``nodes`` ``[P]``, ``offset`` ``[P, 3]`` in the node's frame and ``sized`` ``[P]``, in metres.
    """
    model, sizes = scene.model, {}
    geoms = zip(model.geom_bodyid, model.geom_pos, model.geom_rbound, strict=True)
    sites = zip(model.site_bodyid, model.site_pos, model.site_size.max(1, initial=0.0), strict=True)
    for body, position, size in (*geoms, *sites):
        if body == 0:  # the world
            continue
        welded, turned = find_body(scene, model.body(int(body)).name), np.empty(3)
        if not scene.predicted[welded.node]:
            continue
        mujoco.mju_rotVecQuat(turned, position, welded.quat)
        offset = welded.pos + turned
        # Merge a site with the geom that it is centred on; the smaller of both sizes is more informative.
        key = (welded.node, *np.round(offset, 9).tolist())
        sizes[key] = min(max(float(size), _SMALLEST), sizes.get(key, np.inf))
    nodes, offset = np.array([key[0] for key in sizes], dtype=np.int64), [key[1:] for key in sizes]
    return {"nodes": nodes, "offset": np.reshape(offset, (-1, 3)), "sized": np.array(list(sizes.values()))}


def task_invariances(scene: Scene, reward: Callable[..., Tensor]) -> Canonicalizer:
    """Detect the invariances that a scene shares with a reward ``(state, action, next_state, task) -> [*B, 1]``.

    Compares rewards of random states before and after moving and rotating them.
    """
    generator = torch.Generator().manual_seed(0)
    state, next_state = torch.randn(2, _STATES, scene.num_nodes, scene.state_size, generator=generator).double()
    action = torch.randn(_STATES, scene.num_actions, generator=generator).double()
    for each in (state, next_state):
        where = each[..., BODY_STATE.slices["orientation"]]
        where.copy_(quaternion.normalize(where))
    inner = torch.as_tensor(scene.predicted).unsqueeze(-1)
    shift = torch.zeros(scene.state_size, dtype=torch.float64)
    shift[:3] = torch.as_tensor(scene.translation_invariant).double() * torch.tensor([0.7, -1.3, 0.4])
    before = reward(state, action, next_state, None)

    def keeps(moved: Callable[[Tensor], Tensor]) -> bool:
        moved_states = (torch.where(inner, moved(each), each) for each in (state, next_state))
        first, second = moved_states
        return bool(torch.allclose(reward(first, action, second, None), before, rtol=1e-9, atol=1e-9))

    def keeps_rotated(axes: tuple[int, ...]) -> bool:
        vector = torch.zeros(3, dtype=torch.float64)
        vector[list(axes)] = torch.tensor([0.7, -0.5, 1.1], dtype=torch.float64)[list(axes)]
        return keeps(lambda each: scene.layout.rotate(each, quaternion.exp(vector).expand(_STATES, 4)))

    frame = scene.yaw_frame
    full = frame is None or frame.axis is not None or keeps_rotated(frame.axes)
    yaw = frame is not None and keeps_rotated(frame.axes if full else (2,))
    return Canonicalizer(recenter=keeps(lambda each: each + shift), yaw=yaw, full_rotation=full)


def check_states(scene: Scene, state: Tensor) -> None:
    """Raise ValueError unless states are ``[*B, N, 13]`` of the scene, TypeError unless they are a tensor."""
    require_real(state, "The state", whole=False)
    if state.shape[-2:] != (shape := (scene.num_nodes, scene.state_size)):
        raise ValueError(f"States of {scene.name!r} must be {['*B', *shape]}, got {list(state.shape)}.")


def check_hidden(hidden: Sequence[int]) -> list[int]:
    """Return hidden sizes as a list; ValueError if there are none, or one is not a whole number of at least 1."""
    if not hidden or not all(isinstance(size, Integral) and not isinstance(size, bool) and size > 0 for size in hidden):
        raise ValueError(f"hidden={list(hidden)} must name hidden sizes of at least 1.")
    return [int(size) for size in hidden]
