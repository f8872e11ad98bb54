"""The viewer: a server, its page, and the loop that advances and draws a world."""

from __future__ import annotations

import contextlib
import io
import socket
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, cast

import numpy as np
from torch import Tensor

from torchrl_gn.data import sample_start_states
from torchrl_gn.dynamics import BoundEnsemble
from torchrl_gn.policies import BoundedPolicy
from torchrl_gn.scenes import Scene
from torchrl_gn.viewer.acting import LivePolicy
from torchrl_gn.viewer.panel import PLANNER, POLICY, RANDOM, Panel
from torchrl_gn.viewer.picture import Picture
from torchrl_gn.viewer.planning import LivePlanner, tasks_of
from torchrl_gn.viewer.recordings import Recording
from torchrl_gn.viewer.world import LiveWorld, Model, Playback, pose_error

_FRAME = 1 / 30  # seconds, the shortest time between frames
_BUSY = 0.1  # seconds of steps before a frame is drawn all the same
_READ = 0.2  # seconds between changes of readings and plots
_SCENES = 8  # start states that show how far a robot reaches


class Viewer:
    """A page on which a scene runs, with a model's prediction beside MuJoCo's truth.

    The constructor starts the server, :meth:`run` advances the world until it is interrupted, :meth:`close` stops the
    server. All visitors see the same world. Nothing runs while there is no visitor.

    Args:
        model: bound or specialised model of the scene.
        recording: trajectories to play, instead of a simulation.
        task: task of a planner, which chooses the controls from the start. Default: no planner at the start.
        policy: policy over the scene's states, which chooses the controls from the start if there is no ``task``.
        host: address to serve at; ``"0.0.0.0"`` serves other machines, too.
        port: port to serve at; 0: any free port.

    Raises:
        ImportError: if viser is not installed.
        ValueError: if the library has no such task for the scene, or the policy is of another scene.
        OSError: if the port is taken, or the address is not this machine's.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model | None = None,
        *,
        recording: Recording | None = None,
        task: str | None = None,
        policy: BoundedPolicy | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        seed: int = 0,
    ) -> None:
        try:
            import viser
        except ImportError:
            raise ImportError('The viewer needs viser: pip install "torchrl_gn[view]".') from None
        self.scene, self.model, self.recording = scene, model, recording
        tasks = tasks_of(scene) if recording is None and not scene.unbounded else ()
        if task is not None and task not in tasks:
            known = f"there are {list(tasks)}" if tasks else "there are none for it"
            raise ValueError(f"The library has no task {task!r} for scene {scene.name!r}; {known}.")
        tasks = tuple(sorted(tasks, key=lambda name: name != task))
        self._policy = None if policy is None else LivePolicy(scene, policy, seed=seed)
        self.world: Any
        parts = None
        if recording is None:
            self.world = LiveWorld(scene, model, seed=seed)
            starts = sample_start_states(scene, _SCENES, seed + 1)
            states = self.world.simulator.observe(starts).numpy()
        else:
            parts = {name: len(part) for name, part in recording.parts.items()}
            self._place: tuple[str, int] = next(iter(parts)), 0
            self.world = Playback(scene, recording[self._place], model)
            states = self.world.states.numpy()
            states = states[np.isfinite(states).all((1, 2))][:: max(1, len(states) // 20)]
        check_port(host, port)
        with _quiet():
            self._server = viser.ViserServer(host=host, port=port, verbose=False)
        self._host, self._seed = host, seed
        self._planner: LivePlanner | None = None
        self._acting: LivePlanner | LivePolicy | None = None  # chose the latest action
        try:
            self._lay_out(states, tasks, PLANNER if task is not None else POLICY if policy else RANDOM, parts)
        except BaseException:
            self.close()
            raise

    def _lay_out(self, states: np.ndarray, tasks: tuple[str, ...], acts: str, parts: dict[str, int] | None) -> None:
        """Send the page's controls and the scene's meshes."""
        scene, model = self.scene, self.model
        kind = None if model is None else "ensemble" if isinstance(model, BoundEnsemble) else "model"
        contacts = self.world.moment.physics is not None
        options: dict[str, Any] = {"tasks": tasks, "acts": acts, "policy": self._policy is not None}
        options |= {"parts": parts, "contacts": contacts}
        self.panel = Panel(self._server.gui, scene, model=kind, **options)
        if parts is not None:
            self.panel.length(len(self.world))
        picture = {"predicts": model is not None, "plans": len(tasks) > 0}
        self.picture = Picture(self._server.scene, scene, states, **picture)
        position, at, angle = self.picture.stage.camera()
        camera, radius = self._server.initial_camera, self.picture.stage.radius
        camera.position, camera.look_at, camera.fov = tuple(position), tuple(at), angle
        camera.near, camera.far = 0.01 * radius, 200 * radius
        self._server.on_client_connect(self._fit)
        self._plan: np.ndarray | None = None
        self._shown: tuple = (None, None, None)
        self._debt, self._clock, self._last_read = 0.0, time.monotonic(), 0.0
        self._reward: float | None = None
        self._note = ""
        if self._policy is not None:
            self._policy.begin(self.world.moment.state)

    def _fit(self, client: Any) -> None:
        """Fit the camera to a page that is higher than wide, such as a phone's."""
        if client.camera.aspect < 1:
            client.camera.position, client.camera.look_at, _ = self.picture.stage.camera(client.camera.aspect)

    @property
    def url(self) -> str:
        """Address of the page."""
        host = "localhost" if self._host in ("0.0.0.0", "127.0.0.1", "::") else self._host
        return f"http://{host}:{self._server.get_port()}"

    def run(self) -> None:
        """Advance and draw the world, at most 30 times a second, until KeyboardInterrupt."""
        self._draw()
        while True:
            began = time.monotonic()
            self.tick()
            time.sleep(max(_FRAME - (time.monotonic() - began), 0.001))

    def tick(self) -> None:
        """Handle button presses, advance the world by the time that has passed, and draw it."""
        self._obey()
        now = time.monotonic()
        passed, self._clock = now - self._clock, now
        if self.panel.running and self._server.get_clients():
            self._debt += min(passed, _BUSY) * self.panel.speed
            while self._debt >= self.scene.timestep and self.panel.running:
                self._debt -= self.scene.timestep
                self._step()
                if time.monotonic() - now > _BUSY:  # slower than real time
                    self._debt = 0.0
        self._draw()

    def close(self) -> None:
        """Stop the server and its threads."""
        with _quiet():
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _obey(self) -> None:
        panel = self.panel
        while not panel.asked.empty():
            command = panel.asked.get()
            if command == "Step":
                panel.running = False
                self._step()
            elif command in ("Reset", "Restart"):
                self._reset()
            elif command == "seek":
                panel.running = False
                self.world.at(min(int(panel.time.value), len(self.world)), self._every)
            elif command in ("Play", "Pause"):
                panel.running = command == "Play"
                if panel.running and isinstance(self.world, Playback) and self.world.index == len(self.world):
                    self.world.reset()
        if self.recording is not None:
            part = str(panel.part.value)
            place = part, min(int(panel.number.value), len(self.recording.parts[part]) - 1)
            if place != self._place:
                self._place = place
                self.world = Playback(self.scene, self.recording[place], self.model)
                panel.length(len(self.world))
            elif isinstance(self.world, Playback) and not panel.running:
                self.world.at(self.world.index, self._every)
        if panel.sliders and panel.task is not None:
            panel.task.visible = panel.source.value == PLANNER

    @property
    def _every(self) -> int:
        return int(self.panel.every.value) if self.panel.predicted is not None else 0

    def _reset(self) -> None:
        self.world.reset()
        self._plan, self._reward, self._note = None, None, ""
        for each in (self._planner, self._policy):
            if each is not None:
                each.begin(self.world.moment.state)

    def _step(self) -> None:
        before = self.world.moment
        action = None if self.recording is not None else self._action()
        if self.world.step(action, self._every):
            if self._acting is not None and action is not None:
                self._reward = self._acting.reward_of(before.state, action, self.world.moment.state)
        elif self.recording is not None:
            self.panel.running = False
        else:
            self._reset()
            self._note = "the simulation became unstable: a new start"

    def _action(self) -> np.ndarray:
        panel, world = self.panel, self.world
        before, self._acting, self._plan = self._acting, None, None
        if not panel.sliders:
            return self.scene.rest_action
        source = panel.source.value
        if source == RANDOM:
            return world.random_action()
        if source == POLICY and self._policy is not None:
            self._acting = self._policy
            return self._policy.act(world.moment.state, anew=before is not self._policy)
        if source != PLANNER:
            return np.array([slider.value for slider in panel.sliders])
        try:
            return self._planned(str(cast(Any, panel.task).value))
        except (ValueError, KeyError) as error:  # such as a model that the planner refuses
            panel.source.value, self._note = RANDOM, str(error)
            return world.random_action()

    def _planned(self, task: str) -> np.ndarray:
        moment = self.world.moment
        if self._planner is None or self._planner.task != task:
            self.panel.read("planning ...")
            self._planner = LivePlanner(self.scene, self.model, task, seed=self._seed)
            self._planner.begin(moment.state)
        action, self._plan = self._planner.act(moment.physics, moment.state)
        self._acting = self._planner
        return action

    def _draw(self) -> None:
        moment, panel = self.world.moment, self.panel
        before, plan, asked = self._shown
        asks = panel.switches, panel.running  # a pause brings the readings up to the picture
        if moment is before and self._plan is plan and asks == asked:
            return
        self._shown = moment, self._plan, asks
        with self._server.atomic():
            target = None if self._acting is None else self._acting.target
            self.picture.draw(moment, panel.switches, plan=self._plan, target=target)
        if time.monotonic() - self._last_read > _READ or not panel.running:
            self._last_read = time.monotonic()
            self._read()
        elif panel.predicted is not None and moment.prediction is not None:
            self._plot(moment.prediction)

    def _plot(self, prediction: Tensor) -> tuple[float, float]:
        moment = self.world.moment
        distance, angle = pose_error(self.scene, moment.state, prediction)
        std = 0.0 if moment.std is None else float(moment.std[self.scene.predicted].mean())
        self.panel.plot(moment.time, distance, std)
        return distance, angle

    def _read(self) -> None:
        moment, panel = self.world.moment, self.panel
        texts = [f"t = {moment.time:.2f} s"]
        texts += [f"reward {self._reward:.3g}"] if self._reward is not None and self._acting is not None else []
        texts += [self._note] if self._note else []
        panel.read(" · ".join(texts))
        if panel.sliders and panel.source.value in (RANDOM, PLANNER, POLICY) and moment.action is not None:
            panel.show_actions(moment.action)
        if isinstance(self.world, Playback):
            panel.time.value = self.world.index
        if panel.predicted is None:
            return
        if moment.prediction is None:
            panel.show_error(f"the prediction diverged; {moment.ahead} steps from the truth")
            return
        distance, angle = self._plot(moment.prediction)
        std = "" if moment.std is None else f"<br>std {float(moment.std[self.scene.predicted].mean()):.2g} m"
        panel.show_error(f"error <b>{distance:.2g} m</b>, <b>{angle:.2g} rad</b> after {moment.ahead} steps{std}")
        panel.draw_plot()


def check_port(host: str, port: int) -> None:
    """Raise OSError if a port is taken, or the host is not this machine's; viser would take another port silently."""
    if not 0 <= port < 65536:
        raise OSError(f"port={port} must be from 0 to 65535.")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise OSError(f"Cannot serve at {host}, port {port}: {error.strerror}. Give another --port.") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress viser's output to the terminal."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
