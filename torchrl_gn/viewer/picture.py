"""All drawings of a world: truth, prediction, plan and overlays, as the switches of the page say."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from torchrl_gn.drawing.canvas import AXES, PREDICTION, TRUTH
from torchrl_gn.drawing.geometry import SceneGeometry, follow
from torchrl_gn.scenes import Scene
from torchrl_gn.viewer.meshes import scene_parts
from torchrl_gn.viewer.overlays import ContactOverlay, GraphOverlay, PathOverlay, Spheres, TendonOverlay
from torchrl_gn.viewer.panel import Switches
from torchrl_gn.viewer.stage import Robot, Stage, reach, rgb
from torchrl_gn.viewer.world import Moment

if TYPE_CHECKING:
    from viser import SceneApi

_GHOSTS = (0.25, 0.5, 0.75, 1.0)  # of the horizon, where the plan's poses are drawn
_SIZE = 0.035  # of a node of the graph, as a share of the stage's radius
_BLUE = 0.75  # share of blue in the truth's colours
_FADED = 0.3  # opacity of the robot around its graph


class Picture:
    """Drawings of a scene in viser's scene; the meshes are sent once, here.

    Args:
        states: ``[T, N, C]`` states that show how far the robot reaches, for the camera.
        predicts: draw a prediction, too.
        plans: draw plans, too.
    """

    def __init__(self, api: SceneApi, scene: Scene, states: np.ndarray, *, predicts: bool, plans: bool) -> None:
        self.scene, parts = scene, scene_parts(scene)
        moving = [part for part in parts if part.node]
        centered = states.copy()
        centered[..., :3] -= follow(scene, states)[:, None]
        fixed = [part for part in parts if not part.node]
        self.stage = Stage(api, scene, fixed, *reach(moving, centered), SceneGeometry(scene).floor)
        size, orange, purple = _SIZE * self.stage.radius, rgb(PREDICTION), rgb(AXES[3])
        # Many robots are orange or brown: beside a prediction, or plans, the truth turns blue, as in all figures.
        self._truth = Robot(api, "truth", moving, tint=rgb(TRUTH) if predicts or plans else None, share=_BLUE)
        self._prediction = self._band = None
        if predicts:
            self._prediction = Robot(api, "prediction", moving, tint=orange, opacity=0.65, shadow=False, size=0.98)
            self._band = Spheres(api, "band", scene.num_nodes, orange, opacity=0.25)
        fading = np.linspace(0.34, 0.13, len(_GHOSTS)) if plans else []
        self._ghosts = [
            Robot(api, f"plan{number}", moving, tint=purple, opacity=float(opacity), shadow=False)
            for number, opacity in enumerate(fading)
        ]
        self._paths = PathOverlay(api, scene, purple, size)
        self._target = Spheres(api, "target", 1, rgb(AXES[1]))
        self._tendons = TendonOverlay(api, scene, size)
        self._graph = GraphOverlay(api, scene, size)
        self._contacts = ContactOverlay(api, scene, size)

    def draw(
        self, moment: Moment, switches: Switches, *, plan: np.ndarray | None = None, target: Tensor | None = None
    ) -> None:
        """Draw a moment, with planned states ``[H + 1, N, C]`` and a target position ``[3]`` if given."""
        stage, state = self.stage, moment.state.numpy()
        center = follow(self.scene, state[None])[0] if switches.follow else np.zeros(3)
        shift = stage.apart() if switches.prediction and switches.beside else np.zeros(3)
        stage.root.position = -center - shift / 2
        stage.ground(switches.ground)
        stage.lights(switches.shadows)
        self._truth.pose(state)
        self._truth.fade(_FADED if switches.graph else 1.0)
        self._truth.show_axes(switches.frames, 0.14 * stage.radius)
        self._tendons.show(moment.physics)
        self._draw_prediction(moment, switches, shift)
        for ghost, share in zip(self._ghosts, _GHOSTS, strict=False):
            ghost.pose(None if plan is None else plan[round(share * (len(plan) - 1))])
        self._paths.show(plan)
        place = target if target is not None and target.ndim == 1 else None
        self._target.show(None if place is None else place.numpy()[None], 0.05 * stage.radius)
        self._graph.show(state if switches.graph else None, np.array([*center[:2], stage.level]))
        self._contacts.show(moment.physics if switches.contacts else None, moment.action)

    def _draw_prediction(self, moment: Moment, switches: Switches, shift: np.ndarray) -> None:
        if self._prediction is None or self._band is None:
            return
        predicted = moment.prediction.numpy() if switches.prediction and moment.prediction is not None else None
        self._prediction.pose(predicted)
        self._prediction.root.position = shift
        self._prediction.fade(_FADED if switches.graph else 1.0)
        if predicted is None or moment.std is None or not switches.band:
            return self._band.show(None)
        moving = self.scene.predicted
        self._band.show(predicted[moving, :3] + shift, 2 * moment.std.numpy()[moving])
