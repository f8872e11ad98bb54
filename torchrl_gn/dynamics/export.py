"""A forward model as a program that runs without this package: by PyTorch, or as C++ source."""

from __future__ import annotations

import contextlib
import json
import os
import re
import warnings
from pathlib import Path

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native import source
from torchrl_gn.dynamics.executors.native.executor import list_layers
from torchrl_gn.dynamics.executors.native.library import DTYPES
from torchrl_gn.dynamics.executors.native.samples import ParameterInputs
from torchrl_gn.dynamics.executors.native.state_maths import may_be_constant
from torchrl_gn.dynamics.executors.native.traced_program import trace_states
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.dynamics.specialized import SpecializedPredictor, specialize
from torchrl_gn.scenes.scene import Scene


def export_step(predictor: Predictor, path: str | os.PathLike) -> Path:
    """Write one step of a scene's forward model as a ``torch.export`` program.

    The step is specialised first (:func:`specialize`). The file holds weights and program and needs PyTorch alone::

        step = torch.export.load("swimmer6.pt2").module()
        next_state = step(state, action)  # [B, N, 13] and [B, A], in the dtypes given here: float64 and float32

    It is a snapshot. An extra file ``scene.json`` names nodes and actions and the control step. Returns the path.

    Raises:
        TypeError: for a recurrent model.
        ValueError: if each sample brings its own physical parameters.
    """
    model = _specialized(predictor)
    scene, device = model.scene, model.movable.device
    rest = torch.eye(model.layout.size, dtype=torch.float64, device=device)[min(3, model.layout.size - 1)]
    # Two samples: of one alone the program would be for one alone.
    state = rest.expand(2, scene.num_nodes, -1).clone()
    action = torch.zeros(2, scene.num_actions, device=device)
    batch = torch.export.Dim("batch")
    with torch.no_grad():
        program = torch.export.export(
            _Step(model.executor().program), (state, action), dynamic_shapes=({0: batch}, {0: batch})
        )
    about = {
        "scene": scene.name,
        "timestep": scene.timestep,
        "nodes": list(scene.node_names),
        "state": [{"component": part.name, "size": part.size} for part in model.layout.components],
        "actions": scene.num_actions,
    }
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No complete tensor found")  # constants that share memory are saved whole
        torch.export.save(program, temporary, extra_files={"scene.json": json.dumps(about)})
    return Path(path)


def export_c(predictor: Predictor, folder: str | os.PathLike, states: Tensor | None = None) -> Path:
    """Write a scene's forward model as C++ source that needs neither Python nor PyTorch.

    The folder, whose name begins all C names, receives three files; ``swimmer6``, say::

        swimmer6.cpp  # all code and weights: g++ -O3 -std=c++17 -march=native swimmer6.cpp main.c
        swimmer6.h  # swimmer6_step, swimmer6_rollout, swimmer6_rollout_gradient
        main.c  # a short example

    A snapshot. With the flags above, results are those of the native executor bit for bit, if it took the same
    constants from its first states. Returns the folder.

    Args:
        predictor: the model of one scene.
        folder: where to write; files of these names are replaced, all or none.
        states: ``[*B, N, C]``, states of the scene. Channels that cannot move, and are equal in all of them, become
            constants, and the C functions refuse states with others. Default: the reference pose, at rest.

    Raises:
        TypeError: if the native executor cannot run the model: a recurrent one, a core that is no list of layers,
            16-bit products, a feature without scalar form.
        ValueError: if each sample brings its own physical parameters, the folder's name is no C identifier, or
            ``states`` have another shape.
    """
    folder = Path(folder).absolute()
    if not re.fullmatch(r"[A-Za-z_]\w*", folder.name, re.ASCII):
        raise ValueError(f"The folder's name begins all C names: {folder.name!r} is no C identifier.")
    model = _specialized(predictor)
    program, scene = model.executor().program, model.scene
    layers, reason = list_layers(program)
    if program.dtype not in DTYPES:
        reason = f"products in {str(program.dtype).removeprefix('torch.')} are not written out"
    if layers is None or reason is not None:
        raise TypeError(f"This model cannot be exported as C++: {reason}.")
    states = _rest(model) if states is None else states.detach().cpu()
    shape = scene.num_nodes, model.layout.size
    if states.shape[-2:] != shape or not states.numel():
        raise ValueError(f"states must be [*B, {shape[0]}, {shape[1]}], got {list(states.shape)}.")
    flat = states.reshape(-1, *shape).double().numpy()
    rest = flat[0]
    constant = may_be_constant(program, rest) & (np.abs(flat - rest) <= 1e-10 * (1 + np.abs(rest))).all(0)
    maths = trace_states(program, layers, rest, constant, ParameterInputs.of(program.parameters, None))
    names = getattr(scene, "actuator_names", [f"command {index}" for index in range(scene.num_actions)])
    about = source.Description(
        name=folder.name,
        scene=scene.name,
        timestep=scene.timestep,
        nodes=tuple(scene.node_names),
        channels=tuple(f"{part.name} {part.size}" for part in model.layout.components),
        actions=tuple(
            f"{name}, {low:g} to {high:g}"
            for name, low, high in zip(names, scene.action_low, scene.action_high, strict=True)
        ),
    )
    texts = {
        f"{about.name}.cpp": source.source(about, layers, maths, rest),
        f"{about.name}.h": source.header(about, shape),
        "main.c": source.example(about),
    }
    with contextlib.ExitStack() as files:
        for name, text in texts.items():
            files.enter_context(atomic_path(folder / name)).write_text(text)
    return folder


def _specialized(predictor: Predictor) -> SpecializedPredictor:
    if predictor.model.core.recurrent:
        raise TypeError("A recurrent model cannot be exported: its step also takes a hidden state.")
    if predictor.parameters_key is not None:
        raise ValueError(
            "Samples bring physical parameters of their own; bind the model to one scene, without parameters_key."
        )
    return predictor if isinstance(predictor, SpecializedPredictor) else specialize(predictor, executor="eager")


def _rest(model: SpecializedPredictor) -> Tensor:
    """A scene's reference pose at rest, ``[N, C]``; of a robot known by its joints, all angles zero."""
    scene = model.scene
    if not isinstance(scene, Scene):
        return torch.eye(model.layout.size, dtype=torch.float64)[0].repeat(scene.num_nodes, 1)
    data = mujoco.MjData(scene.model)
    for stage in ("kinematics", "comPos", "comVel", "sensorPos", "sensorVel"):
        getattr(mujoco, f"mj_{stage}")(scene.model, data)
    return torch.from_numpy(data.sensordata[scene.sensor_slice].reshape(scene.num_nodes, scene.state_size))


class _Step(nn.Module):
    """One step of a program, whose tensors become constants of the exported one."""

    def __init__(self, program: StepProgram) -> None:
        super().__init__()
        self.__dict__["step"] = program  # no submodules: its buffers are constants

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return eager.step(self.__dict__["step"], state, action, None)[0]
