"""The viewer by names: load scene, model and policy, and serve the page until Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable

from torchrl_gn.viewer.app import Viewer
from torchrl_gn.viewer.planning import tasks_of
from torchrl_gn.viewer.recordings import read_recording
from torchrl_gn.viewer.sources import load_policy, load_source


def serve(
    source: str,
    *,
    model: str | None = None,
    trajectory: str | None = None,
    task: str | None = None,
    policy: str | None = None,
    host: str = "127.0.0.1",
    port: int = 8080,
    ready: Callable[[str], object] | None = None,
) -> None:
    """Show a scene in the browser until KeyboardInterrupt, then stop the server.

    Args:
        source, model: see :func:`load_source`.
        trajectory: path of recorded trajectories to play (:func:`read_recording`).
        task: task of a planner that chooses the controls; ``""``: the library's first task for the scene.
        policy: see :func:`load_policy`; it chooses the controls if there is no ``task``.
        host, port: see :class:`Viewer`.
        ready: called with the page's address once it is served.

    Raises:
        ValueError: if a name, path or task does not fit; see the functions above.
        ImportError: if viser is not installed.
        OSError: if the port is taken or a file cannot be read.
    """
    scene, bound = load_source(source, model)
    recording = None if trajectory is None else read_recording(trajectory, scene)
    for option, value in (("--plan", task), ("--policy", policy)):
        if value is not None and recording is not None:
            raise ValueError(f"A recording has its own controls: give --trajectory or {option}, not both.")
    if task is not None and policy is not None:
        raise ValueError("Give --plan or --policy, not both: each chooses the controls.")
    acting = None if recording is not None else load_policy(source, policy)
    if task == "":
        tasks = tasks_of(scene)
        if not tasks:
            raise ValueError(f"The library has no task for scene {scene.name!r} to plan.")
        task = tasks[0]
    with Viewer(scene, bound, recording=recording, task=task, policy=acting, host=host, port=port) as viewer:
        if ready is not None:
            ready(viewer.url)
        viewer.run()
