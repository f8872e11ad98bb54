"""A forward model as a program that runs without this package."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from torchrl_gn.atomic import atomic_path
from torchrl_gn.dynamics.predictor import Folded, Predictor
from torchrl_gn.dynamics.specialized import SpecializedPredictor, specialize


def export_step(bound: Predictor, path: str | os.PathLike) -> Path:
    """Write one step of a scene's forward model as a ``torch.export`` program.

    Everything that the scene doesn't need is folded away first (:func:`specialize`). The file holds weights and program
    and needs PyTorch alone::

        step = torch.export.load("swimmer6.pt2").module()
        next_state = step(state, action)  # [B, N, 13] and [B, A], in the dtypes given here: float64 and float32

    It is a snapshot: later changes of the weights don't reach it. Beside the program lies ``scene.json``, as an extra
    file, with the names of nodes and actions and the control step.

    Args:
        bound: the forward model of the scene; what :func:`specialize` takes, or gives.
        path: file to write, ``.pt2``.

    Returns:
        The written path.

    Raises:
        TypeError: for a recurrent core, or one of the ablation study.
        ValueError: if every sample brings physical parameters of its own.
    """
    if bound.parameters_key is not None:
        raise ValueError(
            "Samples bring physical parameters of their own; bind the model to one scene, without parameters_key."
        )
    model = bound if isinstance(bound, SpecializedPredictor) else specialize(bound)
    scene, device = model.scene, model.movable.device
    rest = torch.eye(model.layout.size, dtype=torch.float64, device=device)[min(3, model.layout.size - 1)]
    # Two samples: of one alone the program would be for one alone.
    state = rest.expand(2, scene.num_nodes, -1).clone()
    action = torch.zeros(2, scene.num_actions, device=device)
    batch = torch.export.Dim("batch")
    with torch.no_grad():
        program = torch.export.export(
            _Step(model, model.fold()), (state, action), dynamic_shapes=({0: batch}, {0: batch})
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
    """One step from a snapshot, which is then a constant of the program."""

    model: SpecializedPredictor

    def __init__(self, model: SpecializedPredictor, folded: Folded) -> None:
        super().__init__()
        self.__dict__["model"], self.folded = model, folded  # no submodule: its weights are not exported

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        return Predictor._advance(self.model, state, action, self.folded)[0]  # never the compiled step
