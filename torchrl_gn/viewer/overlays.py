"""Overlays of a scene: tendons, the graph, contact points, an ensemble's spread, paths of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from torchrl_gn.drawing.canvas import RGB
from torchrl_gn.drawing.geometry import node_frames
from torchrl_gn.scenes import Scene
from torchrl_gn.scenes.tendons import is_fixed
from torchrl_gn.scenes.topology import weld_roots
from torchrl_gn.viewer.meshes import sphere
from torchrl_gn.viewer.stage import ROOT

if TYPE_CHECKING:
    from viser import LineSegmentsHandle, SceneApi

_MOST_CONTACTS = 64
_JOINT, _OTHER, _NODE = (45, 55, 72), (138, 95, 191), (46, 139, 87)
_CONTACT = (194, 59, 75)
_PULLEY = -2  # in MjData.wrap_obj
_ACTIVE = (214, 40, 40)  # a fully activated muscle


class Spheres:
    """Spheres whose positions and sizes change; their number does not."""

    def __init__(self, api: SceneApi, name: str, count: int, color: RGB, *, opacity: float | None = None) -> None:
        vertices, faces = sphere(np.ones(3))
        unturned = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        self._count = count
        self._handle = api.add_batched_meshes_simple(
            f"{ROOT}/{name}",
            vertices,
            faces,
            unturned,
            np.zeros((count, 3)),
            batched_scales=np.zeros(count),
            batched_colors=color,
            opacity=opacity,
            cast_shadow=False,
            receive_shadow=False,
            lod="off",
            visible=False,
        )

    def show(self, positions: np.ndarray | None, radii: np.ndarray | float = 0.0) -> None:
        """Place the first spheres at ``[n, 3]`` with radii ``[n]``, metres, and hide the others; None hides all."""
        self._handle.visible = positions is not None and len(positions) > 0
        if positions is None:
            return
        count = min(len(positions), self._count)
        places, scales = np.zeros((self._count, 3), np.float32), np.zeros(self._count, np.float32)
        places[:count] = positions[:count]
        scales[:count] = np.broadcast_to(radii, len(positions))[:count]
        self._handle.batched_positions, self._handle.batched_scales = places, scales


class TendonOverlay:
    """MuJoCo's spatial tendons; a muscle's turns red with its activation."""

    def __init__(self, api: SceneApi, scene: Scene, size: float) -> None:
        self.scene, self._data, self._lines = scene, mujoco.MjData(scene.model), None
        if has_spatial_tendons(scene.model):
            self._lines = hidden_lines(api, "tendons", 0.25 * size)

    def show(self, physics: np.ndarray | None) -> None:
        """Draw the tendons of a full MuJoCo state ``[S]``; None hides them."""
        if self._lines is None:
            return
        segments, colors = (None, None) if physics is None else tendons(self.scene, self._data, physics)
        self._lines.visible = segments is not None and len(segments) > 0
        if segments is not None and colors is not None and len(segments):
            self._lines.points = segments.astype(np.float32)
            self._lines.colors = np.repeat(colors[:, None], 2, axis=1)


class GraphOverlay:
    """The scene as the network sees it: nodes at their centres of mass, edges of joints, actuators and constraints."""

    def __init__(self, api: SceneApi, scene: Scene, size: float) -> None:
        self.scene, self.size, self._centers = scene, size, centers_of_mass(scene)
        self._nodes = Spheres(api, "graph_nodes", scene.num_nodes, _NODE)
        colors = [_JOINT if pair.element == "joint" else _OTHER for pair in scene.pairs]
        self._edges = api.add_line_segments(
            f"{ROOT}/graph_edges",
            np.zeros((max(len(colors), 1), 2, 3), np.float32),
            np.repeat(np.array(colors or [_JOINT], np.uint8)[:, None], 2, axis=1),
            thickness=0.3 * size,
            thickness_units="world",
            visible=False,
        )

    def show(self, state: np.ndarray | None, below: np.ndarray) -> None:
        """Draw the graph in node states ``[N, C]``, with the world's node at ``below`` ``[3]``; None hides it."""
        self._edges.visible = state is not None and len(self.scene.pairs) > 0
        if state is None:
            return self._nodes.show(None)
        position, rotation = node_frames(state[None])
        places = position[0] + np.einsum("nij,nj->ni", rotation[0], self._centers)
        places[0] = below
        self._nodes.show(places, self.size)
        ends = np.array([(pair.first, pair.second) for pair in self.scene.pairs]).reshape(-1, 2)
        if len(ends):
            self._edges.points = places[ends].astype(np.float32)


class ContactOverlay:
    """MuJoCo's contact points, and their forces as arrows."""

    def __init__(self, api: SceneApi, scene: Scene, size: float) -> None:
        self.scene, self.size, self._data = scene, size, mujoco.MjData(scene.model)
        self._weight = float(scene.model.body_mass.sum()) * max(float(np.linalg.norm(scene.model.opt.gravity)), 1.0)
        self._points = Spheres(api, "contacts", _MOST_CONTACTS, _CONTACT)
        self._forces = api.add_arrows(
            f"{ROOT}/contact_forces",
            np.zeros((1, 2, 3), np.float32),
            _CONTACT,
            shaft_radius=0.25 * size,
            head_radius=0.6 * size,
            head_length=1.2 * size,
            visible=False,
        )

    def show(self, physics: np.ndarray | None, action: np.ndarray | None) -> None:
        """Draw the contacts of a full MuJoCo state ``[S]`` under an action ``[A]``; None hides them."""
        points, forces = (None, None) if physics is None else contacts(self.scene, self._data, physics, action)
        self._points.show(points, 0.5 * self.size)
        self._forces.visible = forces is not None and len(forces) > 0
        if points is not None and forces is not None and len(forces):
            arrows = 12 * self.size * forces / self._weight
            length = np.linalg.norm(arrows, axis=-1, keepdims=True)
            arrows *= np.minimum(1.0, 20 * self.size / np.maximum(length, 1e-12))
            self._forces.points = np.stack((points, points + arrows), axis=1).astype(np.float32)


class PathOverlay:
    """Lines of a plan: where each outermost body is planned to go."""

    def __init__(self, api: SceneApi, scene: Scene, color: RGB, size: float) -> None:
        self._tips, self._centers = outermost(scene), centers_of_mass(scene)
        self._color = np.array(color)
        self._lines = hidden_lines(api, "plan_paths", 0.35 * size)

    def show(self, states: np.ndarray | None) -> None:
        """Draw planned states ``[H + 1, N, C]``, paler with time; None hides them."""
        good = states is not None and len(states) > 1 and bool(np.isfinite(states).all())
        self._lines.visible = good and len(self._tips) > 0
        if states is None or not self._lines.visible:
            return
        position, rotation = node_frames(states)
        path = (position + np.einsum("tnij,nj->tni", rotation, self._centers))[:, self._tips]
        segments = np.stack((path[:-1], path[1:]), axis=2)  # [H, tips, 2, 3]
        pale = np.linspace(0, 0.75, len(segments))[:, None]
        colors = (self._color * (1 - pale) + 255 * pale).astype(np.uint8)
        colors = np.repeat(colors[:, None, None], segments.shape[1], axis=1).repeat(2, axis=2)
        self._lines.points = segments.reshape(-1, 2, 3).astype(np.float32)
        self._lines.colors = colors.reshape(-1, 2, 3)


def hidden_lines(api: SceneApi, name: str, thickness: float) -> LineSegmentsHandle:
    """Add hidden lines, ``thickness`` metres thick, that get their points and colours later."""
    return api.add_line_segments(
        f"{ROOT}/{name}",
        np.zeros((1, 2, 3), np.float32),
        np.zeros((1, 2, 3), np.uint8),
        thickness=thickness,
        thickness_units="world",
        visible=False,
    )


def centers_of_mass(scene: Scene) -> np.ndarray:
    """Return the centre of mass ``[N, 3]`` of each node's bodies in the node's frame, metres; the world's is 0."""
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    centers, roots = np.zeros((scene.num_nodes, 3)), weld_roots(model)
    for node in range(1, scene.num_nodes):
        body = scene.body[node]
        bodies = np.flatnonzero(roots == body)
        mass = model.body_mass[bodies]
        if mass.sum() > 0:
            center = mass @ data.xipos[bodies] / mass.sum()
            centers[node] = data.xmat[body].reshape(3, 3).T @ (center - data.xpos[body])
    return centers


def outermost(scene: Scene) -> list[int]:
    """Return the moving nodes that are not a parent."""
    parents = set(scene.parent.tolist())
    return [node for node in range(1, scene.num_nodes) if node not in parents and scene.predicted[node]]


def has_spatial_tendons(model: mujoco.MjModel) -> bool:
    """Return True if a tendon has a path through sites."""
    return not all(is_fixed(model, tendon) for tendon in range(model.ntendon))


def tendons(scene: Scene, data: mujoco.MjData, physics: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the straight pieces ``[n, 2, 3]`` of the spatial tendons, metres, and their colours ``[n, 3]``, 0 to 255.

    A tendon that wraps around a geom has a piece through it. The colour is the file's, and turns red with the
    activation of a muscle.
    """
    model = scene.model
    mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_tendon(model, data)
    points, objects = data.wrap_xpos.reshape(-1, 3), data.wrap_obj.reshape(-1)
    active = _activations(model, data)
    segments, colors = [], []
    for tendon in range(model.ntendon):
        first, count = data.ten_wrapadr[tendon], data.ten_wrapnum[tendon]
        color = 255 * model.tendon_rgba[tendon, :3]
        color += active[tendon] * (np.array(_ACTIVE) - color)
        for at in range(first, first + count - 1):
            if _PULLEY not in objects[at : at + 2]:  # a pulley ends one branch and begins another
                segments.append(points[at : at + 2])
                colors.append(color)
    return np.reshape(segments, (-1, 2, 3)), np.reshape(colors, (-1, 3)).astype(np.uint8)


def _activations(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return each tendon's share of activation ``[ntendon]``, of the most active muscle that pulls it, 0 to 1."""
    active = np.zeros(model.ntendon)
    muscle = model.actuator_gaintype == mujoco.mjtGain.mjGAIN_MUSCLE
    muscle &= (model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON) & (model.actuator_actadr >= 0)
    for actuator in np.flatnonzero(muscle):
        value = data.act[model.actuator_actadr[actuator] + model.actuator_actnum[actuator] - 1]
        tendon = model.actuator_trnid[actuator, 0]
        active[tendon] = max(active[tendon], min(max(value, 0.0), 1.0))
    return active


def contacts(
    scene: Scene, data: mujoco.MjData, physics: np.ndarray, action: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return points ``[n, 3]``, metres, and forces ``[n, 3]``, newtons, of MuJoCo's contacts in the world frame.

    Each force acts on the body of the contact's second geom.
    """
    model = scene.model
    mujoco.mj_setState(model, data, physics, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    if action is not None:
        data.ctrl[:] = action[: model.nu]
    mujoco.mj_forward(model, data)
    points, forces, wrench = [], [], np.zeros(6)
    for number in range(min(data.ncon, _MOST_CONTACTS)):
        contact = data.contact[number]
        if contact.exclude:
            continue
        mujoco.mj_contactForce(model, data, number, wrench)
        points.append(contact.pos.copy())
        forces.append(contact.frame.reshape(3, 3).T @ wrench[:3])
    return np.reshape(points, (-1, 3)), np.reshape(forces, (-1, 3))
