"""Checkpoints: one file with weights, normalisers and all that is needed to use or resume them; trained models."""

from __future__ import annotations

import difflib
import importlib.metadata
import json
import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

import torchrl_gn
from torchrl_gn.dynamics import BoundEnsemble, BoundPredictor, Ensemble, ForwardModel
from torchrl_gn.identification import IdentifyingModel
from torchrl_gn.maths import Normalizer
from torchrl_gn.networks.foldable import hooked
from torchrl_gn.policies import Agent, BoundedPolicy, GraphStatePolicy, StatePolicy, StateReward, StateValue
from torchrl_gn.scenes import Articulation, scene_from_description
from torchrl_gn.training.description_limits import MemoryLimit, check_whole_numbers
from torchrl_gn.training.nested_state import flatten, unflatten
from torchrl_gn.training.tensor_files import DAMAGE, digest_of, read_tensors, write_tensors

CHECKPOINT_FILE = Path("checkpoint") / "checkpoint.safetensors"  # in a run folder
POLICY_FILE = Path("policy.safetensors")  # there, of an actor-critic
WEIGHTS = Path(torchrl_gn.__file__).with_name("weights")  # the models that come with the package
FORMAT = 5  # version of the checkpoint format that this package writes
_IN_HEADER = 4  # older version, also readable, whose description is in the size-limited header
_DESCRIPTION = "description"  # name of the tensor with the bytes of the description's JSON
_PACKAGES = ("torchrl_gn", "torch", "torchrl", "tensordict", "torch-geometric", "mujoco", "dm-control", "numpy")

# Types that a checkpoint can hold.
Trained = ForwardModel | Ensemble | IdentifyingModel | Agent | StateValue | StateReward | BoundedPolicy
KINDS: dict[str, type[Trained]] = {
    "forward_model": ForwardModel,
    "ensemble": Ensemble,
    "identifying_model": IdentifyingModel,
    "agent": Agent,
    "state_value": StateValue,
    "state_reward": StateReward,
    "state_policy": StatePolicy,
    "graph_state_policy": GraphStatePolicy,
}
_Kind = TypeVar("_Kind")
_Loaded = TypeVar("_Loaded")
# Errors from using an untrusted description or state.
_UNUSABLE = (ValueError, RuntimeError, TypeError, LookupError, AttributeError, ArithmeticError, MemoryError)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used: missing, damaged, of a newer format, not ours, or forged."""


@dataclass(repr=False)
class Checkpoint:
    """Contents of a checkpoint file."""

    trained: Trained
    scene_descriptions: list[dict]
    config: dict  # configuration of the run that made it
    versions: dict  # package versions of that run
    metrics: dict = field(default_factory=dict)
    training: dict = field(default_factory=dict)  # nested state to resume from
    path: Path | None = None  # file it was read from

    def __repr__(self) -> str:
        scenes = [(description.get("kinematic_tree") or description)["name"] for description in self.scene_descriptions]
        versions = self.versions
        written_by = f", torchrl_gn {versions['torchrl_gn']}" if "torchrl_gn" in versions else ""
        return f"Checkpoint({type(self.trained).__name__}, scenes={scenes}, metrics={self.metrics}{written_by})"

    @property
    def model(self) -> ForwardModel:
        """The forward model; CheckpointError if the checkpoint holds no forward model."""
        return self._as(ForwardModel)

    def bind(self, scene: Articulation | str | os.PathLike, **options) -> BoundPredictor:
        """Bind the forward model to a scene; see :meth:`ForwardModel.bind`."""
        return self.model.bind(scene, **options)

    @property
    def ensemble(self) -> Ensemble:
        """The ensemble; CheckpointError if the checkpoint holds no ensemble."""
        return self._as(Ensemble)

    @property
    def agent(self) -> Agent:
        """The agent; CheckpointError if the checkpoint holds no agent."""
        return self._as(Agent)

    @property
    def value(self) -> StateValue:
        """The value of states; CheckpointError if the checkpoint holds no such value."""
        return self._as(StateValue)

    @property
    def reward(self) -> StateReward:
        """The learned reward; CheckpointError if the checkpoint holds no reward."""
        return self._as(StateReward)

    @property
    def policy(self) -> BoundedPolicy:
        """The policy over states; CheckpointError if the checkpoint holds no such policy."""
        return self._as(BoundedPolicy)

    def resume(self, load: Callable[[dict], _Loaded]) -> _Loaded:
        """Call ``load``, such as ``trainer.load_state_dict``, on :attr:`training`, and return its result.

        Raises:
            CheckpointError: the state belongs to other networks or options, or is forged; the message names the file.
        """
        try:
            return load(self.training)
        except _UNUSABLE as error:
            why = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {_first_line(error)}"
            raise CheckpointError(f"Checkpoint {self.path} cannot resume this training: {why}.") from error

    def _as(self, kind: type[_Kind]) -> _Kind:
        if not isinstance(self.trained, kind):
            raise CheckpointError(f"The checkpoint holds {type(self.trained).__name__}, not {kind.__name__}.")
        return self.trained

    def scenes(self) -> list[Articulation]:
        """Rebuild the scenes that the model was trained on."""
        return [scene_from_description(description) for description in self.scene_descriptions]

    def scene(self) -> Articulation:
        """Rebuild the one scene that the model was trained on; CheckpointError if there are several, or none."""
        if not self.scene_descriptions:
            raise CheckpointError(
                "The checkpoint holds no scene: give the scene yourself, as in bind(scene), or save the model with its"
                " scene: save_checkpoint(path, model, scene=scene), or save_checkpoint(path, model.bind(scene))."
            )
        if len(self.scene_descriptions) > 1:
            names = [scene.name for scene in self.scenes()]
            raise CheckpointError(
                f"The model was trained on several scenes, {names}; say which one to use: system= of a recipe, or one"
                " of scenes()."
            )
        return scene_from_description(self.scene_descriptions[0])


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that a run's results depend on."""
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def save_checkpoint(
    path: str | os.PathLike,
    model: Trained | BoundPredictor | BoundEnsemble,
    *,
    scene: Articulation | Sequence[Articulation] = (),
    config: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    training: Mapping[str, Any] | None = None,
) -> None:
    """Write a checkpoint, atomically and without pickle.

    Args:
        model: model to save, or a predictor or bound ensemble that holds it.
        scene: the scene or scenes of the training; default: that of a bound model, else none. Agents, values and
            policies hold their own scenes.
        config: configuration of the run; like ``metrics``, plain JSON-able values.
        training: nested dictionaries and lists of tensors and plain values, to resume from.

    Warns of hooks, which no checkpoint holds.

    Raises:
        TypeError: if no checkpoint can hold the model, the configuration, the metrics or the training state.
        ValueError: if a tensor has NaN or Inf, or layers were changed after construction (pruning, adapters, another
            activation), which no checkpoint describes; an existing checkpoint is kept.
        OSError: if there is no space; an existing checkpoint is kept.
    """
    scenes = list(scene) if isinstance(scene, Sequence) else [scene]
    if isinstance(model, BoundPredictor):
        model, scenes = model.model, scenes or [model.scene]
    elif isinstance(model, BoundEnsemble):
        model, scenes = _ensemble_of(model), scenes or [model.scene]
    kind = next((name for name, kind in KINDS.items() if isinstance(model, kind)), None)
    if kind is None:
        kinds = ", ".join(cast(type, each).__name__ for each in (BoundPredictor, BoundEnsemble, *KINDS.values()))
        raise TypeError(f"A checkpoint cannot hold a {type(model).__name__}; give one of {kinds}.")
    tensors: dict[str, Tensor] = {}
    plain = flatten(training or {}, "training", tensors)
    tensors |= {f"model.{name}": value for name, value in model.state_dict().items()}
    if bad := _not_finite(tensors):
        raise ValueError(f"The checkpoint {path} is not written, as {bad!r} has NaN or Inf; an older one is kept.")
    described = model.description()
    if change := _change_since(KINDS[kind], described, model):
        raise ValueError(
            f"The checkpoint {path} is not written, as it would be read as another network: {change}. Undo or merge the"
            " change, or keep model.state_dict() yourself; an older checkpoint is kept."
        )
    description = {
        "kind": kind,
        "model": described,
        "scenes": [each.description() for each in scenes],
        "config": dict(config or {}),
        "versions": package_versions(),
        "metrics": dict(metrics or {}),
        "training": plain,
    }
    text = json.dumps(
        description, default=_plain
    )  # keys not sorted: the order of observation entries locates their numbers
    # A tensor, not header text, as the header must stay below 100 MB and scene descriptions contain meshes.
    tensors[_DESCRIPTION] = torch.frombuffer(bytearray(text.encode()), dtype=torch.uint8)
    write_tensors(path, tensors, format=str(FORMAT))


def _ensemble_of(bound: BoundEnsemble) -> Ensemble:
    """Return the ensemble that a bound one was made from; TypeError if it is specialised, without models to train."""
    models = [each.model for each in bound.members if isinstance(each, BoundPredictor)]
    if not models:
        raise TypeError("A checkpoint cannot hold a specialised ensemble; save the bound one that it was made from.")
    ensemble = Ensemble(models)
    ensemble.calibration = bound.calibration
    return ensemble


def read_checkpoint(
    path: str | os.PathLike, *, physics: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Checkpoint:
    """Read a checkpoint from its file, its folder or run folder; convert half-precision weights to single precision.

    Untrusted files are safe to read: no code in them runs, and sizes in them are checked.

    Args:
        physics: known physics that a forward model corrects; checkpoints do not hold this function.

    Raises:
        CheckpointError: if the file is missing, damaged, of another format or no checkpoint, or holds NaN or Inf.
        ValueError: if the model needs physics that are not given, or was trained with others.
    """
    path = Path(path)
    if path.is_dir():
        inside = path / CHECKPOINT_FILE.name
        path = inside if inside.is_file() else path / CHECKPOINT_FILE
    if not path.is_file():
        raise CheckpointError(f"No checkpoint at {path}.")
    try:
        tensors, metadata = read_tensors(path)
    except DAMAGE as error:
        raise CheckpointError(f"Checkpoint {path} is damaged ({error}); use another or train again.") from error
    number = metadata.get("format", "")
    if not re.fullmatch("[0-9]{1,9}", number) or "sha256" not in metadata:
        raise CheckpointError(f"{path} is a safetensors file, but no checkpoint of torchrl_gn.")
    if int(number) not in (FORMAT, _IN_HEADER):
        what = "update torchrl_gn" if int(number) > FORMAT else "train again"
        raise CheckpointError(
            f"Checkpoint {path} has format {number}, this version reads formats {_IN_HEADER} and {FORMAT}; {what}."
        )
    in_header = metadata.get("description", "")
    if digest_of(tensors, in_header) != metadata["sha256"]:
        raise CheckpointError(f"Checkpoint {path} is damaged (checksum differs); use another or train again.")
    try:
        if bad := _not_finite(tensors):
            raise CheckpointError(f"Checkpoint {path} has NaN or Inf in {bad!r}; use another or train again.")
        text = tensors.pop(_DESCRIPTION).numpy().tobytes() if _DESCRIPTION in tensors else in_header
        checkpoint = _checkpoint_of(json.loads(text), tensors, {} if physics is None else {"physics": physics})
        return replace(checkpoint, path=path)
    except CheckpointError:
        raise
    except ValueError as error:
        raise CheckpointError(f"Checkpoint {path} cannot be used: {error}") from error
    except _UNUSABLE as error:
        raise CheckpointError(
            f"Checkpoint {path} is of a version of torchrl_gn with other networks, or forged"
            f" ({type(error).__name__}: {_first_line(error)}); train again."
        ) from error


def _checkpoint_of(description: dict, tensors: dict[str, Tensor], given: dict[str, Any]) -> Checkpoint:
    """Build a checkpoint from an undamaged but untrusted description and tensors."""
    scenes, plain = description["scenes"], {name: description[name] for name in ("config", "versions", "metrics")}
    training = unflatten(description["training"], tensors)
    if not all(isinstance(each, dict) for each in [*scenes, *plain.values(), training]) or not isinstance(scenes, list):
        raise TypeError("scenes, config, versions, metrics and training are not dictionaries")
    weights = {name.removeprefix("model."): value for name, value in tensors.items() if name.startswith("model.")}
    stored = next((value.dtype for name, value in weights.items() if name.endswith(".weight")), None)
    if stored is None or not stored.is_floating_point:
        raise TypeError(f"weights are of dtype {stored}")
    check_whole_numbers(description["model"])
    with MemoryLimit(sum(value.nbytes for value in weights.values()), len(weights)):
        model = KINDS[description["kind"]].from_description(description["model"], **given)
    for name, value in model.state_dict().items():  # an ensemble's calibration would take the file's sizes
        if name in weights and weights[name].shape != value.shape:
            raise TypeError(f"{name} is {list(weights[name].shape)}, not {list(value.shape)} as described")
    model.to(torch.float32 if stored == torch.float16 else stored).load_state_dict(weights)
    for name, module in model.named_modules():
        if isinstance(module, Normalizer) and not bool(torch.isfinite(module.inverse_std).all()):
            raise ValueError(f"the statistics {name!r} have no standard deviation")
    return Checkpoint(model, scenes, **plain, training=training)


def _change_since(kind: type[Trained], description: dict, model: Trained) -> str | None:
    """Name the first layer in which a network differs from the one that is built of its description; None if none does.

    Warns of hooks, which may only observe.
    """
    physics = next((each.physics for each in model.modules() if isinstance(each, ForwardModel)), None)
    if "scene" in description:  # reading the scene anew would take most of the time
        description = {**description, "scene": cast(Any, model).scene}
    with torch.random.fork_rng(devices=[]), torch.device("cpu"):
        built = kind.from_description(description, **({} if physics is None else {"physics": physics}))
    layers = dict(built.named_modules())
    for name, layer in model.named_modules():
        usual, found = layers.pop(name, None), type(layer).__name__
        if usual is None:
            return f"{name!r} is an additional {found}"
        if type(layer) is not type(usual) or layer.extra_repr() != usual.extra_repr():
            wanted = type(usual).__name__
            return f"{name or 'it'!r} is {found}({layer.extra_repr()}), not {wanted}({usual.extra_repr()})"
    if layers:
        return f"{next(iter(layers))!r} is missing"
    own, expected = (each.state_dict().keys() for each in (model, built))
    if different := sorted(own ^ expected):
        return f"{different[0]!r} is an additional or missing tensor"
    if names := [name for name, layer in model.named_modules() if hooked(layer)]:
        warnings.warn(f"The checkpoint does not hold the hooks of {names}.", stacklevel=3)
    return None


def _plain(value: Any) -> Any:
    """Return the plain number of a scalar of NumPy or torch, for JSON; TypeError for other objects."""
    if isinstance(value, (np.generic, np.ndarray, Tensor)) and value.ndim == 0:
        return value.item()
    raise TypeError(
        f"Config and metrics of a checkpoint must be plain values, not {type(value).__name__} {value!r:.60}."
    )


def _not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Return the name of the first tensor with NaN or Inf; None if there is none."""
    for name, value in tensors.items():
        if value.is_floating_point() and not bool(torch.isfinite(value).all()):
            return name
    return None


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [""])[0]


def pretrained_names() -> list[str]:
    """Return the names of all models that come with the package."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def load_pretrained(
    source: str | os.PathLike, *, physics: Callable[[Tensor, Tensor], Tensor] | None = None
) -> Checkpoint:
    """Load a trained model: one of :func:`pretrained_names`, or the path of a run folder, checkpoint folder or file.

    The ``metrics`` of the package's models hold their errors; the errors of a run are in its ``metrics.json``.

    Args:
        source: a name, or a path. Write ``"./cheetah"`` for a folder that has the name of a model.
        physics: known physics that a forward model corrects; not needed for
            :class:`~torchrl_gn.dynamics.MujocoPhysics`, which the checkpoint rebuilds.

    Raises:
        CheckpointError: if there is no such source, or the file cannot be used.
        TypeError: if ``source`` is neither a name nor a path, such as a list of them.
        ValueError: if the model needs physics.

    Example:
        >>> from torchrl_gn.scenes import load_scene
        >>> from torchrl_gn.training import load_pretrained
        >>> checkpoint = load_pretrained("swimmer6")
        >>> predictor = checkpoint.bind(load_scene("swimmer6"))
        >>> checkpoint.metrics["swimmer6"]["rollout_error_100"] < 0.01
        True
    """
    if not isinstance(source, (str, os.PathLike)):
        raise TypeError(f"load_pretrained takes one model, a name or a path; got {source!r}.")
    names = pretrained_names()
    if source in names:
        return read_checkpoint(WEIGHTS / f"{source}.safetensors")
    if not Path(source).exists():
        near = difflib.get_close_matches(str(source), names, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise CheckpointError(
            f"There is no checkpoint at {source}, and the package has no trained model of that name; its models"
            f" are {names}.{hint}"
        )
    return read_checkpoint(source, physics=physics)
