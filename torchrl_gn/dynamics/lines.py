"""Lengths, rates and wrenches of spatial tendons, slider-cranks and actuators at sites, from body states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.dynamics.actuator_lines import Cranks, SiteGears
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.maths.wrapping import wrap
from torchrl_gn.scenes.lines import Piece, geom_in_node, site_in_node, tendon_pieces
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.topology import topology

_TINY = 1e-15  # metres: keeps lengths differentiable


class LineStates(NamedTuple):
    """Lengths and rates of lines, and their wrenches per unit of tension."""

    length: Tensor  # [*B, L] metres
    velocity: Tensor  # [*B, L] m/s
    wrench: Tensor  # [*B, S, 6] force and torque, about the origin, of each piece on its second node


class Lines(Float64Buffers):
    """Lines of a scene: its spatial ``tendons``, then slider-cranks and actuators at sites among ``actuators``.

    There must be at least one line. A line consists of pieces between two nodes, :attr:`ends` ``[S, 2]``: a piece's
    wrench acts on the second node and, reversed, on the first. :attr:`of_line` ``[S]`` is each piece's line.
    """

    ends: Tensor
    of_line: Tensor
    sums: Tensor
    rates: Tensor

    def __init__(self, scene: Scene, tendons: Sequence[int], actuators: Sequence[int] = ()) -> None:
        super().__init__()
        model, cranks, sites = scene.model, mujoco.mjtTrn.mjTRN_SLIDERCRANK, mujoco.mjtTrn.mjTRN_SITE
        pieces = [(line, piece) for line, tendon in enumerate(tendons) for piece in tendon_pieces(model, tendon)]
        straight, around = ([each for each in pieces if (each[1].geom >= 0) == wraps] for wraps in (False, True))
        acting = list(enumerate(actuators, start=len(tendons)))
        cranks, gears = (
            [each for each in acting if model.actuator_trntype[each[1]] == int(kind)] for kind in (cranks, sites)
        )
        kinds: list[_Straight | _Wrapping | Cranks | SiteGears] = []
        kinds += [_Straight(scene, [piece for _, piece in straight])] if straight else []
        kinds += [_Wrapping(scene, [piece for _, piece in around])] if around else []
        kinds += [Cranks(scene, [actuator for _, actuator in cranks])] if cranks else []
        kinds += [SiteGears(scene, [actuator for _, actuator in gears])] if gears else []
        self.kinds = nn.ModuleList(kinds)
        lengths = [line for some in (straight, around, cranks, gears) for line, _ in some]
        of_line = [line for some in (straight, around, around, cranks, gears) for line, _ in some]
        count = np.arange(len(tendons) + len(actuators))[:, None]
        values = {"of_line": np.array(of_line), "sums": (count == lengths).astype(float)}
        values |= {"rates": (count == of_line).astype(float), "ends": np.concatenate([kind.ends for kind in kinds])}
        self.constants(values)

    def forward(self, state: Tensor, matrices: Tensor) -> LineStates:
        """Compute the lines of states ``[*B, N, 13]`` with rotation matrices ``[*B, N, 3, 3]``."""
        at = BODY_STATE.slices
        lengths, wrenches = zip(*(kind(state, matrices) for kind in self.kinds), strict=True)
        wrench = torch.cat(wrenches, dim=-2)
        position, linear, angular = (
            state[..., at[name]] for name in ("position", "linear_velocity", "angular_velocity")
        )
        twist = torch.cat((linear - torch.linalg.cross(angular, position), angular), dim=-1)  # about the frame's origin
        velocity = (wrench * (twist[..., self.ends[:, 1], :] - twist[..., self.ends[:, 0], :])).sum(-1)
        sums, rates = self.sums.to(state.dtype), self.rates.to(state.dtype)
        return LineStates(torch.cat(lengths, dim=-1) @ sums.mT, velocity @ rates.mT, wrench)


class _Straight(Float64Buffers):
    """Straight pieces from site to site."""

    nodes: Tensor
    places: Tensor
    divisor: Tensor

    def __init__(self, scene: Scene, pieces: Sequence[Piece]) -> None:
        super().__init__()
        model, graph = scene.model, topology(scene.model)
        sites = [[site_in_node(model, graph, site)[:2] for site in (each.first, each.second)] for each in pieces]
        self.ends = np.array([[node for node, _ in both] for both in sites])
        self.constants(
            {
                "nodes": self.ends.T.copy(),
                "places": np.array([[position for _, position in both] for both in sites]).transpose(1, 0, 2).copy(),
                "divisor": np.array([each.divisor for each in pieces]),
            }
        )

    def points(self, state: Tensor, matrices: Tensor) -> list[Tensor]:
        """Return both ends, ``[*B, S, 3]`` each."""
        places = self.places.to(state.dtype)
        return [
            state[..., node, :3] + turned_by(matrices[..., node, :, :], position)
            for node, position in zip(self.nodes, places, strict=True)
        ]

    def forward(self, state: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        divisor = self.divisor.to(state.dtype)
        length, wrench = _length_and_wrench(*self.points(state, matrices))
        return length / divisor, wrench / divisor.unsqueeze(-1)


class _Wrapping(Float64Buffers):
    """Pieces around a sphere or cylinder: each has two straight parts, to the geom and onwards, and an arc between."""

    node: Tensor
    place: Tensor
    frame: Tensor
    side: Tensor
    has_side: Tensor
    radius: Tensor
    is_sphere: Tensor

    def __init__(self, scene: Scene, pieces: Sequence[Piece]) -> None:
        super().__init__()
        model, graph, which = scene.model, topology(scene.model), [piece.geom for piece in pieces]
        self.whole = _Straight(scene, pieces)
        node, position, frame = map(np.array, zip(*(geom_in_node(model, graph, geom) for geom in which), strict=True))
        sides = [
            site_in_node(model, graph, max(piece.side, 0))[1] if piece.side >= 0 else np.ones(3) for piece in pieces
        ]
        start, end = self.whole.ends.T
        self.ends = np.concatenate((np.stack((start, node), 1), np.stack((node, end), 1)))
        self.constants(
            {
                **{"node": node, "place": position, "frame": frame},
                "side": np.einsum("pji,pj->pi", frame, np.array(sides) - position),
                "has_side": np.array([piece.side >= 0 for piece in pieces]),
                "radius": model.geom_size[which, 0],
                "is_sphere": model.geom_type[which] == int(mujoco.mjtGeom.mjGEOM_SPHERE),
            }
        )

    def forward(self, state: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        dtype, body = state.dtype, matrices[..., self.node, :, :]
        divisor = self.whole.divisor.to(dtype)
        start, end = self.whole.points(state, matrices)
        frame, center = body @ self.frame.to(dtype), state[..., self.node, :3] + turned_by(body, self.place.to(dtype))
        first, second = (turned_by(frame.mT, point - center) for point in (start, end))
        side = self.side.to(dtype).expand_as(first)
        wrapped = wrap(first, second, side, self.has_side, self.radius.to(dtype), self.is_sphere)
        onto, off = (center + turned_by(frame, point) for point in (wrapped.first, wrapped.second))
        (before, one), (after, other) = _length_and_wrench(start, onto), _length_and_wrench(off, end)
        wrench = torch.cat((one / divisor.unsqueeze(-1), other / divisor.unsqueeze(-1)), dim=-2)
        return (before + wrapped.arc + after) / divisor, wrench


def _length_and_wrench(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance ``[...]`` between points ``[..., 3]``, and its wrench ``[..., 6]`` about the origin."""
    away = end - start
    length = (away.square().sum(-1) + _TINY * _TINY).sqrt()
    unit = away / length.unsqueeze(-1)
    return length, torch.cat((unit, torch.linalg.cross(start, unit)), dim=-1)
