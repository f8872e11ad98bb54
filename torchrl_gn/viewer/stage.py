"""Robots, ground and camera in viser's scene; meshes are sent once, then only poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_gn.drawing.canvas import RGB, blend
from torchrl_gn.drawing.geometry import View, choose_view, node_frames
from torchrl_gn.maths.state_layout import BODY_STATE
from torchrl_gn.scenes import Scene
from torchrl_gn.viewer.meshes import Part

if TYPE_CHECKING:
    from viser import SceneApi

ROOT = "/world"  # the frame below which everything is drawn; it moves against a robot that the camera follows
_FIELD_OF_VIEW = np.radians(40.0)
_GROUND, _SKY = (226, 230, 236), (246, 248, 250)


def rgb(color: str) -> RGB:
    """Convert ``"#rrggbb"`` to numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


class Robot:
    """One drawing of the moving parts of a scene.

    Args:
        name: name of its nodes in viser's scene.
        tint: colour to blend with the colours of the parts.
        share: share of ``tint``, 0 to 1; at 1, it replaces the colours of the parts.
        opacity: 0 to 1; default: the opacity of each part.
        shadow: whether it casts a shadow.
        size: factor on the size of the parts; slightly below 1, another drawing in the same pose covers this one.
    """

    def __init__(
        self,
        api: SceneApi,
        name: str,
        parts: Sequence[Part],
        *,
        tint: RGB | None = None,
        share: float = 1.0,
        opacity: float | None = None,
        shadow: bool = True,
        size: float = 1.0,
    ) -> None:
        self._opacities = [part.rgba[3] if opacity is None else opacity for part in parts]
        self.root = api.add_frame(f"{ROOT}/{name}", show_axes=False)
        self._frames: dict[int, Any] = {}
        self._meshes = []
        for number, (part, alpha) in enumerate(zip(parts, self._opacities, strict=True)):
            if part.node not in self._frames:
                frame = api.add_frame(f"{ROOT}/{name}/{part.node}", show_axes=False)
                self._frames[part.node] = frame
            color = blend(_to_bytes(part.rgba), tint, share) if tint else _to_bytes(part.rgba)
            middle = (part.vertices.min(0) + part.vertices.max(0)) / 2
            options: dict[str, Any] = {"cast_shadow": shadow, "receive_shadow": shadow, "side": "double"}
            mesh = api.add_mesh_simple(
                f"{ROOT}/{name}/{part.node}/{number}",
                middle + size * (part.vertices - middle),
                part.faces,
                color=color,
                opacity=None if alpha >= 1 else alpha,
                **options,
            )
            self._meshes.append(mesh)

    def pose(self, state: np.ndarray | None) -> None:
        """Place the robot at node states ``[N, C]``; hide it for None, or if they are not finite."""
        good = state is not None and bool(np.isfinite(state).all())
        self.root.visible = good
        if state is None or not good:
            return
        for node, frame in self._frames.items():
            frame.position = state[node, BODY_STATE.slices["position"]]
            frame.wxyz = state[node, BODY_STATE.slices["orientation"]]

    def fade(self, factor: float) -> None:
        """Multiply the opacity of all parts by a factor."""
        for mesh, alpha in zip(self._meshes, self._opacities, strict=True):
            opacity = None if factor * alpha >= 1 else factor * alpha
            if mesh.opacity != opacity:
                mesh.opacity = opacity

    def show_axes(self, shown: bool, length: float) -> None:
        """Show the axes of every node's frame, ``length`` metres long."""
        for frame in self._frames.values():
            frame.axes_length, frame.axes_radius, frame.origin_radius = length, 0.04 * length, 0.08 * length
            frame.show_axes = shown


class Stage:
    """Parts of the picture that stand still: fixed parts, ground, light; and the camera's start.

    Args:
        parts: parts of the scene's node 0, the world.
        low, high: ``[3]`` corners of the box in which the robot moves, metres.
        floor: height of the ground, or None.
    """

    def __init__(
        self, api: SceneApi, scene: Scene, parts: Sequence[Part], low: np.ndarray, high: np.ndarray, floor: float | None
    ) -> None:
        self.api, self.view = api, choose_view(scene)
        self.center, self.radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        api.set_up_direction("+z")
        api.configure_environment_map("studio", environment_intensity=0.1)
        api.add_light_ambient("/light", intensity=0.8)
        api.configure_fog(12 * self.radius, 40 * self.radius, color=_SKY)
        self._shadows: bool | None = None
        self.lights(True)
        self.root = api.add_frame(ROOT, show_axes=False)
        self.fixed = Robot(api, "fixed", parts)
        cell, self.level = nice(self.radius / 3), floor if floor is not None else float(low[2]) - 0.02 * self.radius
        below = self.level - 2e-3 * self.radius
        lower = below - 1e-3 * self.radius
        self._plane = None
        if floor is not None:  # it stands still below a robot that is followed; only the lines move
            corners = 100 * self.radius * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
            faces = np.array([[0, 1, 2], [0, 2, 3]])
            self._plane = api.add_mesh_simple(
                "/plane", corners, faces, color=_GROUND, cast_shadow=False, position=(0.0, 0.0, lower)
            )
        self._grid = api.add_grid(
            f"{ROOT}/grid",
            infinite_grid=True,
            cell_size=cell,
            section_size=5 * cell,
            cell_color=(214, 219, 226),
            section_color=(190, 197, 207),
            shadow_opacity=0.0,
            fade_distance=40 * self.radius,
            position=(0.0, 0.0, below),
        )

    def ground(self, shown: bool) -> None:
        """Show the ground, or hide it."""
        self._grid.visible = shown
        if self._plane is not None:
            self._plane.visible = shown

    def lights(self, shadows: bool) -> None:
        """Light the stage, with or without shadows."""
        if shadows == self._shadows:
            return
        self._shadows = shadows
        self.api.configure_default_lights(enabled=True, cast_shadow=shadows)

    def camera(self, aspect: float = 1.6) -> tuple[np.ndarray, np.ndarray, float]:
        """Return position, target ``[3]`` and field of view [rad] of a camera of ``aspect`` width by height.

        On a page that is higher than wide, the robot stands in the upper half, as controls cover the lower one.
        """
        narrow, toward = aspect < 1, direction(self.view)
        slope = np.tan(_FIELD_OF_VIEW / 2)
        distance = max(1.1 * self.radius, 1e-3) / np.sin(np.arctan(slope * min(aspect, 1.0)))
        up = np.eye(3)[2] - toward[2] * toward
        at = self.center - narrow * 0.5 * slope * distance * up / np.linalg.norm(up)
        return at + distance * toward, at, _FIELD_OF_VIEW

    def apart(self) -> np.ndarray:
        """Return the offset ``[3]`` from a robot to another beside it, metres."""
        return 1.7 * self.radius * self.view.right


def direction(view: View) -> np.ndarray:
    """Return the unit vector ``[3]`` to the camera: obliquely at the plane of motion, or from the view's side."""
    if not view.planar:
        return view.toward
    lift = 0.25 if view.up[2] else -0.9  # motion on the ground: look from the side nearest to the reader, too
    toward = view.toward + (lift * np.eye(3)[2] if view.up[2] else lift * view.up) - 0.3 * view.right
    return toward / np.linalg.norm(toward)


def nice(size: float) -> float:
    """Round a size to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(size, 1e-9)))
    return float(power * (1 if size / power < 1.5 else 2 if size / power < 3.5 else 5))


def reach(parts: Sequence[Part], states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners ``[3]`` of the box that holds the parts in all states ``[T, N, C]``, metres."""
    position, rotation = node_frames(states)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for part in parts:
        points = np.einsum("tij,vj->tvi", rotation[:, part.node], part.vertices) + position[:, None, part.node]
        low, high = np.minimum(low, points.min((0, 1))), np.maximum(high, points.max((0, 1)))
    if not len(parts):
        low, high = position.min((0, 1)) - 0.1, position.max((0, 1)) + 0.1
    return low, high


def _to_bytes(rgba: tuple[float, ...]) -> RGB:
    red, green, blue = (int(round(255 * min(max(value, 0.0), 1.0))) for value in rgba[:3])
    return red, green, blue
