"""Command line ``torchrl-gn``, or ``python -m torchrl_gn``; imports slow modules only when needed.

Usage:
    torchrl-gn [list]
    torchrl-gn show SCENE [--image FILE]
    torchrl-gn view SCENE [--model MODEL] [--trajectory PATH] [--plan [TASK]] [--policy PATH]
                          [--host ADDRESS] [--port NUMBER]
    torchrl-gn doctor
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return 0; on an error, print one message to standard error and exit with code 2."""
    parser = argparse.ArgumentParser("torchrl-gn", description="Graph-network physics models of articulated bodies.")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("list", help="built-in systems and pretrained models (default)")
    show = commands.add_parser("show", help="a scene as a graph: nodes, joints, motors, moving parts")
    show.add_argument(
        "scene", metavar="SCENE", help="a built-in system, an MJCF or URDF file, a run folder, or a checkpoint"
    )
    show.add_argument("--image", metavar="FILE", help="draw the start state into this file (.png, .jpg, ...)")
    _add_view(commands)
    commands.add_parser("doctor", help="this machine: hardware, libraries, speeds, and recommended options")
    options = parser.parse_args(arguments)
    try:
        if options.command == "show":
            text = _show(options.scene, options.image)
        elif options.command == "view":
            text = _view(options)
        elif options.command == "doctor":
            from torchrl_gn.doctor import diagnose

            text = diagnose()
        else:
            text = f"{_systems()}\n\n{_models()}"
    except (ValueError, OSError, ImportError) as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    try:
        if text:
            print(text, flush=True)
    except BrokenPipeError:  # the reader, such as head, closed the pipe; Python flushes again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _systems() -> str:
    from torchrl_gn.scenes import SYSTEMS, has_variants, load_scene

    rows: list[tuple[str, ...]] = [("system", "nodes", "joints", "actions", "control step", "random variants")]
    for name in SYSTEMS:
        scene = load_scene(name)
        sizes = (scene.num_nodes, len(scene.joint_names), scene.num_actions)
        step = f"{1e3 * scene.timestep:g} ms"
        rows.append((name, *map(str, sizes), step, "yes" if has_variants(scene) else "no"))
    return _table(rows) + "\nswimmerN exists for every N >= 3; any MJCF file is a scene, too."


def _models() -> str:
    from torchrl_gn.training import load_pretrained, pretrained_names

    keys = ("one_step_error", "rollout_error_20", "rollout_error_100")
    titles = [key.replace("_error", "").replace("_", " ") for key in keys]
    rows = [["model", "system", "trained on", *titles]]
    for name in pretrained_names():
        loaded = load_pretrained(name)
        trained = [description["name"] for description in loaded.scene_descriptions]
        stated: Mapping[str, Any] = {key: value for key, value in loaded.metrics.items() if key != "evaluation"}
        for system in sorted(stated, key=lambda system: (system.rstrip("0123456789"), len(system), system)):
            errors = (f"{stated[system][key]:.1e}" if key in stated[system] else "-" for key in keys)
            rows.append([name, system, "yes" if system in trained else "no", *errors])
    return _table(rows) + "\nSquared errors of 20 trajectories, relative to the persistence baseline (no motion)."


def _show(source: str, image: str | None) -> str:
    from torchrl_gn.scenes import SYSTEMS, load_scene

    if source not in SYSTEMS and (Path(source).is_dir() or Path(source).suffix == ".safetensors"):
        from torchrl_gn.training import load_pretrained

        scene = load_pretrained(source).scene()
    else:
        scene = load_scene(source)
    if image is None:
        return str(scene)
    from torchrl_gn.atomic import atomic_path
    from torchrl_gn.data import Simulator, sample_start_states
    from torchrl_gn.evaluation import rollout_frames
    from torchrl_gn.scenes import Scene

    if not isinstance(scene, Scene):
        raise ValueError(f"{source} is of a robot that is known by its joints alone, which has no shapes to draw.")
    start = Simulator(scene).observe(sample_start_states(scene, 1, 0))
    picture = next(rollout_frames(scene, start, size=480, labels=("start state", "")))
    with atomic_path(image) as temporary:
        picture.save(temporary)
    return f"{scene}\n{image}"


def _add_view(commands: Any) -> None:
    view = commands.add_parser(
        "view",
        help="a page in the browser: MuJoCo's simulation, and a model's prediction beside it",
        description="Serve a page with the robot's simulation, and the prediction of its model, if it has one. "
        "Ctrl-C ends it.",
    )
    view.add_argument(
        "scene",
        metavar="SCENE",
        help="a built-in system, the path of an MJCF or URDF file, a run folder, or a pretrained model",
    )
    view.add_argument(
        "--model",
        metavar="MODEL",
        help="run folder, checkpoint, or pretrained model of another source (default: the run's, the system's own)",
    )
    view.add_argument(
        "--trajectory",
        metavar="PATH",
        help="play recorded trajectories: a data set, episodes of recipes/mpc.py, a robot's log",
    )
    view.add_argument(
        "--plan",
        nargs="?",
        const="",
        metavar="TASK",
        help="let a planner choose the controls (default: the first task)",
    )
    view.add_argument(
        "--policy",
        metavar="PATH",
        help="let a policy choose the controls: run folder of recipes/shac.py, or checkpoint (default: the run's)",
    )
    view.add_argument(
        "--host",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="default: 127.0.0.1, this machine alone; 0.0.0.0: other machines, too",
    )
    view.add_argument("--port", metavar="NUMBER", type=int, default=8080, help="default: 8080; 0: any free port")


def _view(options: argparse.Namespace) -> str:
    """Serve the page until Ctrl-C; return an empty text."""
    if importlib.util.find_spec("viser") is None:  # before slow imports
        raise ImportError('The viewer needs viser: pip install "torchrl_gn[view]".')
    from torchrl_gn.viewer import serve

    try:
        serve(
            options.scene,
            model=options.model,
            trajectory=options.trajectory,
            task=options.plan,
            policy=options.policy,
            host=options.host,
            port=options.port,
            ready=lambda url: print(f"{url}  (Ctrl-C ends it)", flush=True),
        )
    except KeyboardInterrupt:
        return ""
    return ""


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Format rows of cells with aligned columns and a rule under the first row."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


if __name__ == "__main__":
    sys.exit(main())
