"""Lengths and wrenches of slider-cranks and of actuators at sites, from body states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.float64_buffers import Float64Buffers
from torchrl_gn.maths.quaternion import turned_by
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes.lines import rotation
from torchrl_gn.scenes.scene import Scene
from torchrl_gn.scenes.topology import site_in_node, topology

_TINY = 1e-15  # m2: keeps a square root differentiable where the rod just reaches the slider's axis


class Cranks(Float64Buffers):
    """Slider-cranks: a rod joins the crank to a slider, whose position along its site's axis is the length."""

    nodes: Tensor
    places: Tensor
    axis: Tensor
    rod: Tensor

    def __init__(self, scene: Scene, actuators: Sequence[int]) -> None:
        super().__init__()
        model, graph = scene.model, topology(scene.model)
        cranks, sliders = (
            [site_in_node(model, graph, int(site)) for site in model.actuator_trnid[list(actuators), end]]
            for end in (0, 1)
        )
        self.ends = np.array([[slider[0], crank[0]] for slider, crank in zip(sliders, cranks, strict=True)])
        self.constants(
            {
                "nodes": self.ends.T.copy(),
                "places": np.array([[position for _, position, _ in some] for some in (sliders, cranks)]),
                "axis": np.array([rotation(quat)[:, 2] for _, _, quat in sliders]),
                "rod": model.actuator_cranklength[list(actuators)],
            }
        )

    def forward(self, state: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths ``[*B, S]`` and wrenches on the cranks ``[*B, S, 6]``, about the origin."""
        places, rod = self.places.to(state.dtype), self.rod.to(state.dtype)
        slider, crank = (
            state[..., node, :3] + turned_by(matrices[..., node, :, :], position)
            for node, position in zip(self.nodes, places, strict=True)
        )
        axis, away = turned_by(matrices[..., self.nodes[0], :, :], self.axis.to(state.dtype)), crank - slider
        along = (away * axis).sum(-1)
        square = along * along + rod * rod - away.square().sum(-1)
        reaches = square > _TINY
        root = torch.where(reaches, square, 1.0).sqrt()
        length = torch.where(reaches, along - root, along)
        force = torch.where(
            reaches.unsqueeze(-1), axis + (away - along.unsqueeze(-1) * axis) / root.unsqueeze(-1), axis
        )
        return length, torch.cat((force, torch.linalg.cross(crank, force)), dim=-1)


class SiteGears(Float64Buffers):
    """Actuators at sites, with a refsite fixed to the world or none: length along the gear, and the gear's wrench."""

    node: Tensor
    place: Tensor
    gear: Tensor
    origin: Tensor
    frame: Tensor
    turn: Tensor
    back: Tensor
    referred: Tensor

    def __init__(self, scene: Scene, actuators: Sequence[int]) -> None:
        super().__init__()
        model, graph, acting = scene.model, topology(scene.model), list(actuators)
        sites = [site_in_node(model, graph, int(site)) for site in model.actuator_trnid[acting, 0]]
        world = 0, np.zeros(3), np.array([1.0, 0, 0, 0])
        references = [
            world if site < 0 else site_in_node(model, graph, int(site)) for site in model.actuator_trnid[acting, 1]
        ]
        referred, gear = model.actuator_trnid[acting, 1] >= 0, model.actuator_gear[acting].reshape(-1, 2, 3)
        quats, back = (np.array([quat for _, _, quat in some]) for some in (sites, references))
        # A gear is given in the frame of the refsite, or of the site if there is no refsite.
        frames = np.array([rotation(quat) for quat in np.where(referred[:, None], back, quats)])
        self.ends = np.array([[0, node] for node, _, _ in sites])
        self.turns = bool((referred[:, None] & (gear[:, 1] != 0)).any())
        self.constants(
            {
                "node": self.ends[:, 1].copy(),
                "place": np.array([position for _, position, _ in sites]),
                "gear": gear @ frames.transpose(0, 2, 1),
                "origin": np.array([position for _, position, _ in references]),
                "frame": frames,
                "turn": quats,
                "back": back * [1, -1, -1, -1],
                "referred": referred,
            }
        )

    def forward(self, state: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return lengths ``[*B, S]``, 0 without refsite, and wrenches ``[*B, S, 6]`` on the sites' nodes.

        Wrenches are about the origin.
        """
        dtype, body = state.dtype, matrices[..., self.node, :, :]
        point = state[..., self.node, :3] + turned_by(body, self.place.to(dtype))
        gears, referred = self.gear.to(dtype), self.referred.unsqueeze(-1)
        force, torque = (torch.where(referred, gear, turned_by(body, gear)) for gear in gears.unbind(1))
        length = ((point - self.origin.to(dtype)) * gears[:, 0]).sum(-1)
        if self.turns:
            orientation = state[..., self.node, BODY_STATE.slices["orientation"]]
            turned = quaternion.product(orientation, self.turn.to(dtype).expand_as(orientation))
            turned = quaternion.product(self.back.to(dtype).expand_as(orientation), turned)
            moved = turned_by(self.frame.to(dtype), quaternion.log(turned))  # the gear is in the world's frame here
            length = length + (moved * gears[:, 1]).sum(-1)
        wrench = torch.cat((force, torch.linalg.cross(point, force) + torque), dim=-1)
        return torch.where(self.referred, length, 0.0), wrench
