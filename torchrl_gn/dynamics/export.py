"""A forward model as a program that runs without this package."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.predictor import Predictor
from torchrl_gn.dynamics.program import StepProgram
from torchrl_gn.dynamics.specialized import SpecializedPredictor, specialize


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
    if predictor.model.core.recurrent:
        raise TypeError("A recurrent model cannot be exported: its step also takes a hidden state.")
    if predictor.parameters_key is not None:
        raise ValueError(
            "Samples bring physical parameters of their own; bind the model to one scene, without parameters_key."
        )
    model = predictor if isinstance(predictor, SpecializedPredictor) else specialize(predictor)
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


class _Step(nn.Module):
    """One step of a program, whose tensors become constants of the exported one."""

    def __init__(self, program: StepProgram) -> None:
        super().__init__()
        self.__dict__["step"] = program  # no submodules: its buffers are constants

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return eager.step(self.__dict__["step"], state, action, None)[0]
