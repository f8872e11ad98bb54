"""Export of a forward model as a program that runs without this package: in PyTorch, or as C++ source."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import os
import re
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.bound import BoundPredictor
from torchrl_gn.dynamics.ensemble import BoundEnsemble
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.executors.native import NativeExecutor, source
from torchrl_gn.dynamics.predictor import require_bound
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.dynamics.specialized import SpecializedPredictor, specialize
from torchrl_gn.networks.packed_layers import PackedLayers


def export_step(predictor: BoundPredictor | SpecializedPredictor, path: str | os.PathLike) -> Path:
    """Write one step of a scene's forward model as a ``torch.export`` program.

    The step is specialised first (:func:`specialize`). The file holds weights and program and needs only PyTorch::

        step = torch.export.load("swimmer6.pt2").module()
        next_state = step(state, action)  # [B, N, 13] and [B, A], in the dtypes given here: float64 and float32

    The file is a snapshot of the weights. The extra file ``scene.json`` in it lists nodes, state components, the number
    of actions and the control step. Returns the path.

    Raises:
        TypeError: for a recurrent model, an ensemble, or a model that is not bound.
        ValueError: if each sample has its own physical parameters.
        OSError: if there is no space; an existing file is kept.
    """
    model = _specialized(predictor, "eager")
    program = model.program()
    scene, device = model.scene, program.movable.device
    rest_state = torch.eye(model.layout.size, dtype=torch.float64, device=device)[min(3, model.layout.size - 1)]
    # Trace with two samples: with one, torch.export would fix the batch size to 1.
    state = rest_state.expand(2, scene.num_nodes, -1).clone()
    action = torch.zeros(2, scene.num_actions, dtype=torch.float32, device=device)
    batch = torch.export.Dim("batch")
    with torch.no_grad():
        exported = torch.export.export(_Step(program), (state, action), dynamic_shapes=({0: batch}, {0: batch}))
    about = {
        "scene": scene.name,
        "timestep": scene.timestep,
        "nodes": list(scene.node_names),
        "state": [{"component": part.name, "size": part.size} for part in model.layout.components],
        "actions": scene.num_actions,
    }
    content = io.BytesIO()  # torch's own writer of files ends the process when the disk is full
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No complete tensor found")  # constants that share memory are saved whole
        torch.export.save(exported, content, extra_files={"scene.json": json.dumps(about)})
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.getbuffer())
    return Path(path)


def export_c(predictor: BoundPredictor | SpecializedPredictor, folder: str | os.PathLike) -> Path:
    """Write a scene's forward model as C++ source that needs neither Python nor PyTorch.

    The folder's name begins all C names. The folder ``swimmer6``, for example, receives three files::

        swimmer6.cpp  # all code and weights: g++ -O3 -std=c++17 -march=native swimmer6.cpp main.c
        swimmer6.h  # swimmer6_step, swimmer6_rollout, swimmer6_rollout_gradient
        main.c  # a short example

    The code is a snapshot of the weights. With the flags above, results equal the native executor's bit for bit.
    Returns the folder.

    Args:
        predictor: the model of one scene.
        folder: the folder to write to; files of these names are replaced, all or none.

    Raises:
        TypeError: if the native executor cannot run the model: a recurrent model, a core that is not a list of layers,
            16-bit products, or a feature without scalar form; or for an ensemble, or a model that is not bound.
        ValueError: if each sample has its own physical parameters, or the folder's name is no C identifier.
        OSError: if there is no space; existing files are kept.
    """
    folder = Path(folder).absolute()
    if not re.fullmatch(r"[A-Za-z_]\w*", folder.name, re.ASCII):
        raise ValueError(f"The folder's name begins all C names: {folder.name!r} is no C identifier.")
    if not next(predictor.buffers()).is_cpu:
        predictor = copy.deepcopy(predictor).cpu()
    model = _specialized(predictor, "native")
    program, scene, executor, reason = model.program(), model.scene, model.executor, model.reason
    if program.dtype not in (torch.float32, torch.float64):
        reason = f"products in {str(program.dtype).removeprefix('torch.')} are not written out"
    core = program.core
    if reason is not None or not isinstance(executor, NativeExecutor) or not isinstance(core, PackedLayers):
        raise TypeError(f"This model cannot be exported as C++: {reason or 'it is specialised for another executor'}.")
    rest_state = program.reference.numpy()
    names = getattr(scene, "action_names", [f"command {index}" for index in range(scene.num_actions)])
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
        f"{about.name}.cpp": source.source(about, executor.structure, core, rest_state),
        f"{about.name}.h": source.header(about, (rest_state.shape[0], rest_state.shape[1])),
        "main.c": source.example(about),
    }
    with contextlib.ExitStack() as files:
        for name, text in texts.items():
            files.enter_context(atomic_path(folder / name)).write_text(text)
    return folder


def _specialized(predictor: BoundPredictor | SpecializedPredictor, executor: str) -> SpecializedPredictor:
    require_bound(predictor)
    if isinstance(predictor, BoundEnsemble):
        raise TypeError("An ensemble cannot be exported whole: export each of its members.")
    if not isinstance(predictor, (BoundPredictor, SpecializedPredictor)):
        raise TypeError(f"A {type(predictor).__name__} is not a forward model; torch.export.export exports policies.")
    if predictor.recurrent:
        raise TypeError("A recurrent model cannot be exported: its step also takes a hidden state.")
    if predictor.parameters_key is not None:
        raise ValueError(
            "Samples have physical parameters of their own; bind the model to one scene, without parameters_key."
        )
    return predictor if isinstance(predictor, SpecializedPredictor) else specialize(predictor, executor=executor)


class _Step(nn.Module):
    """One step of a program; the program's tensors become constants of the exported program."""

    def __init__(self, program: StepProgram) -> None:
        super().__init__()
        self.__dict__["step"] = program  # not as a submodule, so that its buffers become constants

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return eager.step(self.__dict__["step"], state, action, None)[0]
