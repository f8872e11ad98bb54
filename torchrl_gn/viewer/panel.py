"""The page's controls: buttons, sliders, switches and readings."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from torchrl_gn.drawing.canvas import PREDICTION, TRUTH
from torchrl_gn.scenes import Scene

if TYPE_CHECKING:
    from viser import GuiApi

RANDOM, SLIDERS, PLANNER, POLICY = "random", "sliders", "planner", "policy"
_SPEEDS = ("0.1", "0.25", "0.5", "1", "2", "4")
_PLOTTED = 240  # steps of the plot of errors


class Switches(NamedTuple):
    """Visible parts of a picture."""

    prediction: bool  # the predicted robot
    beside: bool  # the prediction beside the truth, not over it
    band: bool  # an ensemble's two standard deviations
    contacts: bool
    graph: bool
    frames: bool
    shadows: bool
    ground: bool
    follow: bool  # keep the robot in the middle


class Panel:
    """Controls of a page; the loop reads their values, and takes button presses from :attr:`asked`.

    Args:
        model: kind of the predictor: ``"model"``, ``"ensemble"``, or None.
        tasks: tasks of the planner; empty without a planner.
        acts: source of the controls at first: ``"random"``, ``"planner"`` or ``"policy"``.
        policy: True if a policy can choose the controls.
        parts: number of trajectories by name, for a recording; None for a simulation.
    """

    def __init__(
        self,
        gui: GuiApi,
        scene: Scene,
        *,
        model: str | None,
        tasks: Sequence[str] = (),
        acts: str = RANDOM,
        policy: bool = False,
        parts: dict[str, int] | None = None,
        contacts: bool = True,
    ) -> None:
        self.asked: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.running, self.live, self.contacts = True, parts is None, None
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(59, 110, 165))
        gui.set_panel_label(f"torchrl_gn · {scene.name}")
        self._reading = gui.add_html("")
        buttons = gui.add_button_group("", ("Play", "Pause", "Step", "Reset" if self.live else "Restart"))
        buttons.on_click(self._ask)
        self._speed = gui.add_dropdown("Speed", _SPEEDS, initial_value="1", hint="1 is real time")
        self.sliders: list[Any] = []
        self.source: Any = None
        if self.live:
            self._add_controls(gui, scene, tasks, acts, policy)
        else:
            self._add_trajectories(gui, parts or {})
        self.predicted: Any = None
        if model is not None:
            self._add_prediction(gui, model)
        with gui.add_folder("Show", expand_by_default=False):
            names = "x red, y green, z blue"
            self.contacts = _switch(gui, "Contacts", False, "MuJoCo's contact points and forces") if contacts else None
            self.graph = _switch(gui, "Graph", False, "nodes and edges of the graph network")
            self.frames = _switch(gui, "Frames", False, f"axes of every node: {names}")
            self.shadows = _switch(gui, "Shadows", True, "of the true robot")
            self.ground = _switch(gui, "Ground", True, "plane and grid")
            self.follow = _switch(gui, "Follow", True, "keep the robot in the middle")

    async def _ask(self, event: Any) -> None:
        """Queue the pressed button. It is async, as viser runs other functions in threads, which may miss a press."""
        self.asked.put(event.target.value)

    def _add_controls(self, gui: GuiApi, scene: Scene, tasks: Sequence[str], acts: str, policy: bool) -> None:
        if not scene.num_actions:
            return
        with gui.add_folder("Controls", expand_by_default=scene.num_actions <= 8):
            sources = (RANDOM, SLIDERS, *([PLANNER] if tasks else []), *([POLICY] if policy else []))
            self.source = gui.add_dropdown("From", sources, initial_value=acts)
            self.task = gui.add_dropdown("Task", tuple(tasks), visible=acts == PLANNER) if tasks else None
            bounds = (np.nan_to_num(bound, posinf=1.0, neginf=-1.0) for bound in scene.random_action_bounds)
            rest = scene.rest_action
            for name, low, high, middle in zip(scene.action_names, *bounds, rest, strict=True):
                low, high = float(low), max(float(high), float(low) + 1e-6)
                value = float(np.clip(middle, low, high))
                label, step = name.rpartition("/")[2], (high - low) / 200
                slider = gui.add_slider(label, min=low, max=high, step=step, initial_value=value)
                slider.on_update(self._slid)
                self.sliders.append(slider)

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # a visitor moved it, not the loop
            self.source.value = SLIDERS

    def _add_trajectories(self, gui: GuiApi, parts: dict[str, int]) -> None:
        self._counts = parts
        with gui.add_folder("Recording"):
            names = tuple(parts)
            self.part = gui.add_dropdown("Part", names, visible=len(names) > 1)
            most = max(parts.values()) - 1
            self.number = gui.add_slider(
                "Trajectory", min=0, max=max(most, 1), step=1, initial_value=0, disabled=most == 0
            )
            self.time = gui.add_slider("Step", min=0, max=1, step=1, initial_value=0)
            self.time.on_update(self._sought)

    def _sought(self, event: Any) -> None:
        if event.client is not None:
            self.asked.put("seek")

    def _add_prediction(self, gui: GuiApi, model: str) -> None:
        from viser import uplot

        with gui.add_folder("Prediction"):
            self.predicted = _switch(gui, "Show", True, "the model's prediction, orange")
            self.beside = _switch(gui, "Side by side", False, "the prediction beside the truth, not over it")
            most: dict[str, Any] = {"min": 0, "max": 100_000, "step": 1, "hint": "steps; 0: never"}
            self.every = gui.add_number("Resynchronise every", initial_value=100, **most)
            self.band = _switch(gui, "Band", True, "two standard deviations") if model == "ensemble" else None
            self._error = gui.add_html("")
            series = [uplot.Series(label="t"), uplot.Series(label="error", stroke=PREDICTION, width=2)]
            if model == "ensemble":
                series.append(uplot.Series(label="std", stroke=TRUTH, width=1))
            empty = (np.zeros(1),) * len(series)
            axes = (uplot.Axis(label="time, s"), uplot.Axis(label="error, m", size=62))
            look: dict[str, Any] = {"legend": uplot.Legend(show=False), "height": 150}
            look["scales"] = {"x": uplot.Scale(time=False), "y": uplot.Scale(auto=True)}
            self._plot = gui.add_uplot(empty, tuple(series), axes=axes, **look)
        self._points: list[tuple[float, float, float]] = []

    @property
    def speed(self) -> float:
        """Speed relative to real time."""
        return float(self._speed.value)

    @property
    def switches(self) -> Switches:
        """Visible parts of the picture."""

        def on(switch: Any) -> bool:
            return switch is not None and bool(switch.value)

        return Switches(
            prediction=on(self.predicted),
            beside=self.predicted is not None and on(self.beside),
            band=self.predicted is not None and on(self.band),
            contacts=on(self.contacts),
            graph=on(self.graph),
            frames=on(self.frames),
            shadows=on(self.shadows),
            ground=on(self.ground),
            follow=on(self.follow),
        )

    def length(self, steps: int) -> None:
        """Set the number of steps of the trajectory shown."""
        self.time.max = max(steps, 1)
        self.time.value = 0

    def read(self, text: str) -> None:
        """Show a line of text at the top."""
        content = f'<div style="padding:0 0.8em 0.3em;font-size:0.85em;opacity:0.85">{text}</div>'
        if self._reading.content != content:
            self._reading.content = content

    def show_actions(self, action: np.ndarray) -> None:
        """Move the sliders to an action ``[A]``."""
        for slider, value in zip(self.sliders, action, strict=True):
            slider.value = float(np.clip(value, slider.min, slider.max))

    def show_error(self, text: str) -> None:
        """Show a text about the prediction."""
        content = f'<div style="padding:0 0.8em;font-size:0.85em">{text}</div>'
        if self._error.content != content:
            self._error.content = content

    def plot(self, time: float, error: float, std: float) -> None:
        """Add a point to the plot; an earlier time clears the plot first."""
        if self._points and time <= self._points[-1][0]:
            if time == self._points[-1][0]:
                return
            self._points = []
        self._points = [*self._points[-_PLOTTED:], (time, error, std)]

    def draw_plot(self) -> None:
        """Send the plot's points."""
        if self._points:
            self._plot.data = tuple(np.array(self._points).T.copy())[: len(self._plot.data)]


def _switch(gui: GuiApi, label: str, value: bool, hint: str) -> Any:
    return gui.add_checkbox(label, initial_value=value, hint=hint)
