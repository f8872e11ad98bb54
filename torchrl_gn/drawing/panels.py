"""Drawings of a scene's shapes as flat outlines; they need only Pillow, no display."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from torchrl_gn.drawing.canvas import GRID, INK, MUTED, PAPER, TRUTH, blend
from torchrl_gn.drawing.geometry import SceneGeometry, View, choose_view, follow
from torchrl_gn.scenes import Scene

_OUTLINE = np.linspace(0, 2 * np.pi, 56, endpoint=False)
_FAN = np.stack((np.cos(_OUTLINE), np.sin(_OUTLINE)), axis=-1)  # [K, 2] directions of the outline's corners
_SMOOTH = 2  # antialiasing: panels are drawn this much larger, then reduced


@dataclass(frozen=True, eq=False)
class Motion:
    """Outlines of one state sequence, in metres of the picture plane."""

    outlines: list[np.ndarray]  # [T, K, 2] of each shape
    order: np.ndarray  # [T, shapes] drawing order, far shapes first
    shadows: list[np.ndarray]  # [T, K, 2] on the floor, of each shape; empty without a visible floor
    joints: np.ndarray  # [T, J, 2] joint anchors
    valid: np.ndarray  # [T] True if the state is finite


class SceneDrawing:
    """Panels of a scene, ``size`` pixels wide; the camera follows only ``truth`` ``[T, N, 13]``."""

    def __init__(self, scene: Scene, truth: np.ndarray, size: int) -> None:
        self.geometry = SceneGeometry(scene)
        self.view: View = choose_view(scene)
        self.size = size
        self._moving = [bool(scene.predicted[self.geometry.geom_node[s.geom]]) for s in self.geometry.shapes]
        self._floor = self._find_floor(truth)
        self._follow = self.view.project(follow(scene, truth))
        self.truth = self.motion(truth)
        moving = [o for o, moves in zip(self.truth.outlines, self._moving, strict=True) if moves]
        points = np.concatenate(moving or [self.view.project(truth[:, :, :3])], axis=1) - self._follow[:, None]
        low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
        self._middle = (low + high) / 2
        self.extent = float(max((high - low).max(), 1e-6) * 1.16)
        if self.view.planar and self.view.up[2] and self._floor is not None:
            self._middle[1] = low[1] + 0.42 * self.extent  # leave little room below the lowest point

    def _find_floor(self, truth: np.ndarray) -> float | None:
        if self.geometry.floor is not None or self.view.planar:
            return self.geometry.floor
        positions, rotations = self.geometry.poses(truth[:1])
        lowest = [
            (positions[0, shape.geom, 2] + shape.points @ rotations[0, shape.geom, 2]).min() - shape.radius
            for shape, fixed in zip(self.geometry.shapes, self.geometry.fixed, strict=True)
            if fixed
        ]
        return float(min(lowest)) if lowest else None

    def motion(self, states: np.ndarray) -> Motion:
        """Compute outlines of states ``[T, N, 13]``; mark non-finite states invalid."""
        valid = np.asarray(np.isfinite(states).all(axis=(1, 2)))
        states = np.where(valid[:, None, None], states, 0.0)
        positions, rotations = self.geometry.poses(states)
        outlines, shadows, depths = [], [], []
        floor = self._floor if not self.view.planar else None
        for shape in self.geometry.shapes:
            points = positions[:, shape.geom, None] + np.einsum("tij,pj->tpi", rotations[:, shape.geom], shape.points)
            outlines.append(convex_outline(self.view.project(points), shape.radius))
            depths.append(points.mean(axis=1) @ self.view.toward)
            if floor is not None:
                flat = convex_outline(points[..., :2], shape.radius)
                shadows.append(self.view.project(np.concatenate((flat, np.full((*flat.shape[:-1], 1), floor)), -1)))
        order = np.argsort(np.stack(depths, axis=-1), axis=-1, kind="stable") if depths else np.zeros((len(states), 0))
        return Motion(outlines, order.astype(int), shadows, self.view.project(self.geometry.anchors(states)), valid)

    def panel(self, step: int, motion: Motion, color: str, *, ghost: bool = False) -> Image.Image:
        """Draw one panel at ``_SMOOTH`` times its size; ``ghost`` draws the truth pale behind the motion."""
        image = Image.new("RGB", (self.size * _SMOOTH, self.size * _SMOOTH), PAPER)
        draw = ImageDraw.Draw(image)
        self._ground(draw, step)
        if motion.valid[step]:
            for shadow, moves in zip(motion.shadows, self._moving, strict=False):
                if moves:
                    self._polygon(draw, step, shadow[step], _mix(MUTED, PAPER, 0.62), None)
        self._shapes(draw, step, self.truth, None)
        if ghost:
            self._shapes(draw, step, self.truth, _mix(TRUTH, PAPER, 0.72), edge=_mix(TRUTH, PAPER, 0.5))
        if motion.valid[step]:
            self._shapes(draw, step, motion, color)
            radius = self.size * _SMOOTH / 180
            # Draw no joints in spatial scenes, where bodies hide most of them.
            for x, y in self._pixels(step, motion.joints[step]).tolist() if self.view.planar else ():
                if abs(x) + abs(y) < 20 * self.size * _SMOOTH:
                    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill="white", outline=INK)
        else:
            middle = self.size * _SMOOTH / 2
            draw.text((middle, middle), "prediction diverged", INK, ImageFont.load_default(18 * _SMOOTH), "mm")
        return image

    def _pixels(self, step: int, points: np.ndarray) -> np.ndarray:
        offset = (points - self._follow[step] - self._middle) / self.extent
        return (offset * [1, -1] + 0.5) * self.size * _SMOOTH

    def _polygon(self, draw: ImageDraw.ImageDraw, step: int, points: np.ndarray, fill, edge, width: int = 0) -> None:
        pixels = self._pixels(step, points)
        # Skip polygons far outside: huge coordinates would overflow Pillow.
        if np.abs(pixels).max() > 20 * self.size * _SMOOTH:
            return
        corners = list(map(tuple, pixels.tolist()))
        draw.polygon(corners, fill=fill)
        if edge is not None:
            draw.line([*corners, *corners[:2]], fill=edge, width=width, joint="curve")

    def _shapes(self, draw: ImageDraw.ImageDraw, step: int, motion: Motion, color, edge=None) -> None:
        """Draw the moving shapes in ``color``; without ``color``, the fixed shapes in grey."""
        for index in motion.order[step]:
            if self._moving[index] == (color is None):
                continue
            if color is None:
                fill, rim = _mix(MUTED, PAPER, 0.6), _mix(MUTED, PAPER, 0.2)
            elif edge is not None:
                fill, rim = color, edge
            else:
                # Two tints tell neighbouring bodies apart.
                node = int(self.geometry.geom_node[self.geometry.shapes[index].geom])
                fill, rim = _mix(color, "#ffffff", 0.12 + 0.2 * (node % 2)), _mix(color, "#000000", 0.35)
            self._polygon(draw, step, motion.outlines[index][step], fill, rim, width=round(1.2 * _SMOOTH))

    def _ground(self, draw: ImageDraw.ImageDraw, step: int) -> None:
        spacing, side = nice_spacing(self.extent / 4), self.size * _SMOOTH
        center = self._follow[step] + self._middle
        low, high = center - self.extent / 2, center + self.extent / 2
        if self.view.planar:  # a grid fixed in the world; from the side, only its vertical lines and the floor
            above = self.view.up[2] == 0
            for axis in range(2 if above else 1):
                for value in _ticks(low[axis], high[axis], spacing):
                    at = self._pixels(step, np.full(2, value))[axis]
                    draw.line((at, 0, at, side) if axis == 0 else (0, at, side, at), fill=GRID, width=_SMOOTH)
            if self._floor is not None and not above:
                at = self._pixels(step, np.array([0.0, self._floor]))[1]
                if at < side:
                    draw.rectangle((0, at, side, side), fill=_mix(MUTED, PAPER, 0.75))
                    draw.line((0, at, side, at), fill=MUTED, width=2 * _SMOOTH)
        elif self._floor is not None:
            # Draw a patch of grid around the floor point behind the picture's centre.
            view, on_plane = self.view, center[0] * self.view.right + center[1] * self.view.up
            middle = on_plane + view.toward * (self._floor - on_plane[2]) / view.toward[2]
            reach = spacing * math.ceil(2.5 * self.extent / spacing)
            for axis in range(2):
                for value in _ticks(middle[axis] - reach, middle[axis] + reach, spacing):
                    ends = np.repeat(middle[None], 2, axis=0)
                    ends[:, axis] = value
                    ends[:, 1 - axis] += [-reach, reach]
                    pixels = self._pixels(step, view.project(ends))
                    draw.line(tuple(pixels.flatten().tolist()), fill=GRID, width=_SMOOTH)


def convex_outline(points: np.ndarray, radius: float) -> np.ndarray:
    """Return corners ``[T, K, 2]`` of the convex outline of points ``[T, P, 2]``, thickened by a radius."""
    farthest = (points @ _FAN.T).argmax(axis=1)  # [T, K]
    return np.take_along_axis(points, farthest[..., None], axis=1) + radius * _FAN


def _ticks(low: float, high: float, spacing: float) -> np.ndarray:
    return np.arange(math.ceil(low / spacing), math.floor(high / spacing) + 1) * spacing


def nice_spacing(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(factor for factor in (1, 2, 5) if factor * power <= value * (1 + 1e-9))


def _mix(color: str | tuple[int, int, int], other: str, part: float) -> tuple[int, int, int]:
    """Blend two colours, with a share ``part`` of ``other``."""
    a, b = (ImageColor.getrgb(c) if isinstance(c, str) else c for c in (color, other))
    return blend(a[:3], b[:3], part)
