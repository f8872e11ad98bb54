"""Graph networks as learnable physics engines, for TorchRL.

Example:
    >>> import torchrl_gn as gn
    >>> scene = gn.load_scene("pendulum")
    >>> model = gn.ForwardModel.for_scene(scene, hidden=16).bind(scene)
    >>> history = gn.fit(model, gn.collect_trajectories(scene, 10, seed=0), steps=2, progress=False)
    >>> fast = gn.specialize(model)
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_gn.data import collect_trajectories as collect_trajectories
    from torchrl_gn.data import create_dataset as create_dataset
    from torchrl_gn.data import load_dataset as load_dataset
    from torchrl_gn.data import trajectory_buffer as trajectory_buffer
    from torchrl_gn.dynamics import Ensemble as Ensemble
    from torchrl_gn.dynamics import ForwardModel as ForwardModel
    from torchrl_gn.dynamics import export_c as export_c
    from torchrl_gn.dynamics import export_step as export_step
    from torchrl_gn.dynamics import specialize as specialize
    from torchrl_gn.envs import ModelEnv as ModelEnv
    from torchrl_gn.envs import SceneEnv as SceneEnv
    from torchrl_gn.evaluation import calibrate as calibrate
    from torchrl_gn.evaluation import evaluate_coverage as evaluate_coverage
    from torchrl_gn.evaluation import evaluate_errors as evaluate_errors
    from torchrl_gn.evaluation import rollout_video as rollout_video
    from torchrl_gn.identification import IdentifyingModel as IdentifyingModel
    from torchrl_gn.objectives import ForwardModelLoss as ForwardModelLoss
    from torchrl_gn.objectives import IdentificationLoss as IdentificationLoss
    from torchrl_gn.objectives import SHACLoss as SHACLoss
    from torchrl_gn.objectives import SVGLoss as SVGLoss
    from torchrl_gn.planners import GradientPlanner as GradientPlanner
    from torchrl_gn.planners import ILQGPlanner as ILQGPlanner
    from torchrl_gn.planners import PlanAhead as PlanAhead
    from torchrl_gn.planners import SamplingPlanner as SamplingPlanner
    from torchrl_gn.rewards import available_rewards as available_rewards
    from torchrl_gn.rewards import make_reward as make_reward
    from torchrl_gn.scenes import load_scene as load_scene
    from torchrl_gn.training import fit as fit
    from torchrl_gn.training import fit_ensemble as fit_ensemble
    from torchrl_gn.training import load_pretrained as load_pretrained
    from torchrl_gn.training import pretrained_names as pretrained_names
    from torchrl_gn.training import save_checkpoint as save_checkpoint

__version__ = "0.1.0"

# Public names by the folder that defines them; __getattr__ imports each at its first use.
_FOLDERS = {
    "data": ("collect_trajectories", "create_dataset", "load_dataset", "trajectory_buffer"),
    "dynamics": ("Ensemble", "ForwardModel", "export_c", "export_step", "specialize"),
    "envs": ("ModelEnv", "SceneEnv"),
    "evaluation": ("calibrate", "evaluate_coverage", "evaluate_errors", "rollout_video"),
    "identification": ("IdentifyingModel",),
    "objectives": ("ForwardModelLoss", "IdentificationLoss", "SHACLoss", "SVGLoss"),
    "planners": ("GradientPlanner", "ILQGPlanner", "PlanAhead", "SamplingPlanner"),
    "rewards": ("available_rewards", "make_reward"),
    "scenes": ("load_scene",),
    "training": ("fit", "fit_ensemble", "load_pretrained", "pretrained_names", "save_checkpoint"),
}
_PLACES = {name: folder for folder, names in _FOLDERS.items() for name in names}

__all__ = sorted(_PLACES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_PLACES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
