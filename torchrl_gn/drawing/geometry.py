"""Poses of a scene's shapes for given node states, the camera, and kinetic energy."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_gn.maths import quaternion
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.topology import weld_roots

_Geom = mujoco.mjtGeom
_AZIMUTH, _ELEVATION = np.radians(-55.0), np.radians(18.0)


@dataclass(frozen=True, eq=False)
class Shape:
    """One visible geom: the convex hull of points, thickened by a radius."""

    geom: int  # MuJoCo id
    points: np.ndarray  # [P, 3] in the geom's frame, metres
    radius: float  # metres


class SceneGeometry:
    """Shapes of a scene, each at a fixed offset from its node, even if predictions pull joints apart."""

    def __init__(self, scene: Scene) -> None:
        model = scene.model
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        node_of_root = {int(body): node for node, body in enumerate(scene.body)}
        body_node = np.array([node_of_root[int(root)] for root in weld_roots(model)])
        self.geom_node = body_node[model.geom_bodyid]  # [G] node that carries each geom
        # The offsets do not depend on the configuration.
        roots = scene.body[self.geom_node]
        root_mat = data.xmat.reshape(-1, 3, 3)[roots]
        self.geom_pos = np.einsum("gji,gj->gi", root_mat, data.geom_xpos - data.xpos[roots])  # [G, 3] in its node
        self.geom_mat = np.einsum("gji,gjk->gik", root_mat, data.geom_xmat.reshape(-1, 3, 3))  # [G, 3, 3]
        self.shapes = [shape for geom in range(model.ngeom) if (shape := _shape(model, geom))]
        self.fixed = [self.geom_node[shape.geom] == 0 for shape in self.shapes]  # True if fixed to the world
        # Node, and anchor [3] in its frame, of each hinge and ball joint of bodies without slide or free joints.
        rotating = np.isin(model.jnt_type, [int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL)])
        joints = np.flatnonzero(~np.isin(model.jnt_bodyid, model.jnt_bodyid[~rotating]))
        self.joints = [(int(body_node[model.jnt_bodyid[joint]]), model.jnt_pos[joint].copy()) for joint in joints]
        planes = [g for g in range(model.ngeom) if model.geom_type[g] == _Geom.mjGEOM_PLANE]
        levels = [data.geom_xpos[g][2] for g in planes if data.geom_xmat[g].reshape(3, 3)[2, 2] > 0.99]
        self.floor = float(levels[0]) if levels else None

    def poses(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions ``[T, G, 3]`` and rotations ``[T, G, 3, 3]`` of all geoms for node states ``[T, N, 13]``."""
        position, rotation = node_frames(states)
        position, rotation = position[:, self.geom_node], rotation[:, self.geom_node]
        return position + np.einsum("tgij,gj->tgi", rotation, self.geom_pos), rotation @ self.geom_mat

    def anchors(self, states: np.ndarray) -> np.ndarray:
        """Return world positions ``[T, J, 3]`` of the joint anchors, fixed to the child nodes."""
        position, rotation = node_frames(states)
        if not self.joints:
            return np.zeros((len(states), 0, 3))
        nodes = [node for node, _ in self.joints]
        offsets = np.stack([offset for _, offset in self.joints])
        return position[:, nodes] + np.einsum("tjik,jk->tji", rotation[:, nodes], offsets)


def node_frames(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions ``[..., 3]`` and rotation matrices ``[..., 3, 3]`` of node states ``[..., 13]``."""
    turned = torch.as_tensor(states[..., BODY_STATE.slices["orientation"]], dtype=torch.float64, device="cpu")
    quat = quaternion.normalize(turned)
    matrix = quaternion.to_matrix(quat).numpy().reshape(*states.shape[:-1], 3, 3)
    return states[..., BODY_STATE.slices["position"]], matrix


def _shape(model: mujoco.MjModel, geom: int) -> Shape | None:
    kind, size, material = model.geom_type[geom], model.geom_size[geom], model.geom_matid[geom]
    alpha = model.geom_rgba[geom][3] * (1.0 if material < 0 else model.mat_rgba[material][3])
    # MuJoCo's viewers show groups 0 to 2; higher ones hold collision shapes.
    if model.geom_group[geom] > 2 or alpha <= 0:
        return None
    if kind == _Geom.mjGEOM_SPHERE:
        return Shape(geom, np.zeros((1, 3)), float(size[0]))
    if kind == _Geom.mjGEOM_CAPSULE:
        return Shape(geom, np.array([[0, 0, size[1]], [0, 0, -size[1]]]), float(size[0]))
    if kind == _Geom.mjGEOM_BOX:
        corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
        return Shape(geom, corners * size, 0.0)
    if kind == _Geom.mjGEOM_CYLINDER:
        angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        rim = np.stack((np.cos(angle) * size[0], np.sin(angle) * size[0], np.full_like(angle, size[1])), axis=-1)
        return Shape(geom, np.concatenate((rim, rim * [1, 1, -1])), 0.0)
    if kind == _Geom.mjGEOM_ELLIPSOID:
        return Shape(geom, _directions(200) * size, 0.0)
    if kind == _Geom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        start, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        vertices = model.mesh_vert[start : start + number].astype(float)
        # The vertices farthest along many directions are the convex hull's, except for small facets.
        extreme = np.unique((vertices @ _directions(400).T).argmax(axis=0))
        return Shape(geom, vertices[extreme], 0.0)
    return None


def _directions(number: int) -> np.ndarray:
    """Return evenly spread unit vectors ``[number, 3]`` (Fibonacci sphere)."""
    index = np.arange(number) + 0.5
    height, angle = 1 - 2 * index / number, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - height**2)
    return np.stack((radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)


@dataclass(frozen=True, eq=False)
class View:
    """A parallel projection."""

    right: np.ndarray  # [3] unit vector that points right in the picture
    up: np.ndarray  # [3] up
    toward: np.ndarray  # [3] towards the viewer
    planar: bool  # True if all motion is in the picture plane

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project world points ``[..., 3]`` to picture coordinates ``[..., 2]``, metres."""
        return points @ np.stack((self.right, self.up), axis=-1)


def choose_view(scene: Scene) -> View:
    """Look straight at the plane of motion if no node leaves it, else obliquely from above."""
    movable = np.asarray(scene.movable.any(axis=0))
    x, y, z = np.eye(3)
    # Look from above if z is the normal, else from the side with z up.
    for normal, (right, up) in ((1, (x, z)), (2, (x, y)), (0, (y, z))):
        others = [axis for axis in range(3) if axis != normal]
        if not movable[normal] and not movable[[3 + axis for axis in others]].any():
            return View(right, up, np.cross(right, up), True)
    flat = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH), 0.0])
    toward = np.cos(_ELEVATION) * flat + np.sin(_ELEVATION) * z
    right = np.cross(z, flat)
    return View(right, np.cross(toward, right), toward, False)


def follow(scene: Scene, states: np.ndarray) -> np.ndarray:
    """Return the camera's target ``[T, 3]``: mean of the moving nodes along translation-invariant axes, 0 elsewhere."""
    return np.where(scene.translation_invariant, states[:, scene.predicted, :3].mean(axis=1), 0.0)


def kinetic_energy(state: Tensor, scene: Scene) -> Tensor:
    """Return the kinetic energy ``[...]``, joules, of the moving bodies in states ``[..., N, 13]``; no armature."""
    names, values = scene.static.node_names, torch.as_tensor(scene.static.nodes).to(state)

    def feature(name: str, size: int) -> Tensor:
        return values[:, [names.index(f"{name}[{index}]") for index in range(size)]]

    mass, moves = values[:, names.index("mass")], torch.as_tensor(scene.predicted).to(state)
    orientation, linear, angular = state[..., 3:7], state[..., 7:10], state[..., 10:13]
    offset = quaternion.rotate(orientation, feature("ipos", 3))
    velocity = linear + torch.linalg.cross(angular, offset)
    principal = quaternion.product(orientation, feature("iquat", 4))
    spin = quaternion.rotate(quaternion.conjugate(principal), angular)
    energy = mass * velocity.square().sum(-1) + (feature("inertia", 3) * spin.square()).sum(-1)
    return 0.5 * (energy * moves).sum(-1)
