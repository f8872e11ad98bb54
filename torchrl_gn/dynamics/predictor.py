"""Interface of a forward model joined to one scene: the TensorDict module that predicts."""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_gn.dynamics.executors import eager
from torchrl_gn.dynamics.program import PreparedStep, StepProgram
from torchrl_gn.finite import require_real
from torchrl_gn.maths.precision import without_autocast
from torchrl_gn.maths.state_layout import StateLayout
from torchrl_gn.networks.graph import Graph
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.kinematic_tree import KinematicTree


class Predictor(TensorDictModuleBase):
    """Predictor of one scene's next state: a :class:`BoundPredictor` or a :class:`SpecializedPredictor`.

    Reads ``state`` ``[*B, N, 13]`` and ``action`` ``[*B, A]``, writes ``("next", "state")`` in the dtype of ``state``;
    the network sees recentred, normalised values in its own dtype.

    With a ``parameters_key``, each sample may be another variant of the scene. The predictor reads a TensorDict at that
    key with the entries of :class:`~torchrl_gn.scenes.PhysicalParameters`, from :meth:`parameters_of` or an inference
    model. Without a key, it refuses samples with other parameters. A model with ``parameters="none"`` or ``"inferred"``
    never reads true parameters.

    A recurrent model also reads ``hidden_state``, a TensorDict ``[*B]`` of ``nodes``, ``edges`` and ``globals_``, by
    default the initial one, and writes ``("next", "hidden_state")``.
    """

    scene: Articulation
    layout: StateLayout
    parameters_key: NestedKey | None
    recurrent: bool  # True if it carries a hidden state from step to step
    fixed_batch = False  # True if another batch size costs a compilation

    def __init__(
        self,
        scene: Articulation,
        layout: StateLayout,
        *,
        recurrent: bool,
        state_key: NestedKey = "state",
        action_key: NestedKey = "action",
        parameters_key: NestedKey | None = None,
    ) -> None:
        super().__init__()
        self.scene, self.layout, self.recurrent, self.parameters_key = scene, layout, recurrent, parameters_key
        hidden_keys = ["hidden_state"] if recurrent else []
        parameters_keys = [] if parameters_key is None else [parameters_key]
        self.in_keys: list[NestedKey] = [state_key, action_key, *parameters_keys, *hidden_keys]
        self.out_keys: list[NestedKey] = [unravel_key(("next", key)) for key in (state_key, *hidden_keys)]

    @property
    @abstractmethod
    def dtype(self) -> torch.dtype:
        """Dtype of the network's products."""

    @abstractmethod
    def own_parameters(self) -> TensorDict:
        """Return the scene's own entry for the ``parameters_key``, without batch; zeros for an inferred graph."""

    @abstractmethod
    def parameters_of(self, scene: Articulation) -> TensorDict:
        """Return physical parameters of a variant of this scene, for the ``parameters_key``; stack them for a batch.

        Raises ValueError if it is another scene (other bodies, joints, motors or control step). ``strict`` applies here
        too.
        """

    @abstractmethod
    def parameters_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Return the samples' own physical parameters; None if the scene's apply or the model reads none.

        Raises:
            KeyError: if the model reads them and they are missing.
            ValueError: if the model does not read them and they are not its scene's.
        """

    @abstractmethod
    def initial_hidden_state(self) -> TensorDict | None:
        """Return the initial hidden state of a recurrent model, without batch; None for other models."""

    @abstractmethod
    def program(self, parameters: TensorDictBase | None = None) -> StepProgram:
        """Return one step as data, which an executor runs.

        Args:
            parameters: physical parameters of each sample, or without batch; default: the scene's.
        """

    @abstractmethod
    def prepared(self, parameters: TensorDictBase | None = None, *, size: int = 1) -> PreparedStep:
        """Prepare the step and its executor, for any number of steps of the same samples.

        Args:
            parameters: physical parameters of each sample, or without batch; default: the scene's.
            size: expected number of steps times samples; it decides which executor pays off.
        """

    @abstractmethod
    def training_squares(self) -> dict[str, Tensor]:
        """Return the mean square ``[]`` in training of each additive state component; 0 if it is not known."""

    @abstractmethod
    def recentered(self, states: Tensor) -> Tensor:
        """Return states ``[*B, N, 13]`` relative to the scene's centre, along axes of translation invariance."""

    def hidden_state_in(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Return the samples' hidden state for a recurrent model; None: the initial one."""
        return tensordict.get("hidden_state", None) if self.recurrent else None

    @without_autocast
    def in_range(self, states: Tensor, limit: float) -> Tensor:
        """Return ``[*B]`` bool, True where states ``[*B, N, 13]`` are finite and in range of training.

        A state is in range if each body's distance from the scene's centre and its speeds are at most ``limit`` times
        their root mean square in training.
        """
        good = states.isfinite().flatten(-2).all(-1)
        states = self.recentered(states)
        for name, square in self.training_squares().items():
            # Before training there are no statistics to compare with.
            largest = torch.where(square > 0, limit**2 * square, torch.inf)
            good &= (states[..., self.layout.slices[name]].square().sum(-1) <= largest).all(-1)
        return good

    @dispatch()
    def forward(self, tensordict: TensorDictBase, *_: Tensor, **__: Tensor) -> TensorDictBase:
        """Write the predicted next state into ``tensordict``, or return it if entries are given as arguments."""
        state, action = (tensordict[key] for key in self.in_keys[:2])
        after, hidden = self.step(state, action, self.parameters_in(tensordict), self.hidden_state_in(tensordict))
        tensordict.set(self.out_keys[0], after)
        return tensordict if hidden is None else tensordict.set(self.out_keys[1], hidden)

    @without_autocast
    def step(
        self,
        state: Tensor,
        action: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        """Return the next state ``[*B, N, 13]``, and the next hidden state, None for a feed-forward model.

        Args:
            state: ``[*B, N, 13]``.
            action: ``[*B, A]``.
            parameters: physical parameters of each sample, or without batch; default: the scene's.
            hidden_state: ``[*B]`` hidden state of a recurrent model; default: the initial one.

        Raises:
            TypeError: if state or action is not a tensor of real numbers, or the state has fewer than 32 bits.
            ValueError: if a shape does not fit the scene.
        """
        check_shapes(self.scene, state, action, parameters)
        step = self.prepared(parameters, size=math.prod(state.shape[:-2]))
        after, hidden = step.step(state, action, self._graph(hidden_state))
        return after, None if hidden is None else hidden.tensordict()

    @without_autocast
    def rollout(
        self,
        state: Tensor,
        actions: Tensor,
        parameters: TensorDictBase | None = None,
        hidden_state: TensorDictBase | None = None,
        *,
        prepared: PreparedStep | None = None,
    ) -> tuple[Tensor, TensorDict | None]:
        """Return states ``[*B, T + 1, N, 13]`` under actions ``[*B, T, A]``, and the last hidden state.

        ``actions[..., t, :]`` leads from state ``t`` to ``t + 1``; the first state is the start. See :meth:`step`. For
        many rollouts with the same weights, pass the result of :meth:`prepared` for these parameters as ``prepared``.
        """
        check_steps(self.scene, state, actions, parameters)
        step = self.prepared(parameters, size=math.prod(actions.shape[:-1])) if prepared is None else prepared
        states, hidden = step.rollout(state, actions, self._graph(hidden_state))
        return states, None if hidden is None else hidden.tensordict()

    @without_autocast
    def teacher_forced(
        self, states: Tensor, actions: Tensor, parameters: TensorDictBase | None = None
    ) -> tuple[Tensor, TensorDict | None]:
        """Predict the state ``[*B, T, N, 13]`` after each of the true ``states``; also return the last hidden state."""
        check_steps(self.scene, states, actions, parameters, each=True)
        if not self.recurrent:
            if parameters is not None and parameters.ndim:
                parameters = parameters.unsqueeze(-1).expand(actions.shape[:-1])
            return self.step(states, actions, parameters)
        hidden, predictions, step = None, [], self.prepared(parameters, size=math.prod(actions.shape[:-1]))
        for state, action in zip(states.unbind(-3), actions.unbind(-2), strict=True):
            predicted, hidden = step.step(state, action, hidden)
            predictions.append(predicted)
        return torch.stack(predictions, dim=-3), None if hidden is None else hidden.tensordict()

    @without_autocast
    def delta(self, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> Tensor:
        """Return the predicted change ``[*B, N, 12]``, zero in fixed components.

        A recurrent model starts from its initial hidden state.
        """
        check_shapes(self.scene, state, action, parameters)
        return eager.delta(self.program(parameters), state, action)[0]

    @property
    @abstractmethod
    def _edge_index(self) -> Tensor:
        """``[2, E]``."""

    def _graph(self, hidden_state: TensorDictBase | None) -> Graph | None:
        if hidden_state is None:
            return None
        nodes, edges, globals_ = (hidden_state[part] for part in ("nodes", "edges", "globals_"))
        return Graph(nodes, edges, globals_, self._edge_index)

    def extra_repr(self) -> str:
        return f"scene={self.scene.name!r}"


def require_bound(model: object) -> None:
    """Raise TypeError for a model that is not bound to a scene."""
    if hasattr(model, "bind"):
        raise TypeError(f"{type(model).__name__} is not bound to a scene: use model.bind(scene).")


def check_shapes(scene: Articulation, state: Tensor, action: Tensor, parameters: TensorDictBase | None = None) -> None:
    """Raise ValueError unless states are ``[*B, N, C]``, actions ``[*B, A]``, and parameters of that batch or none.

    Raise TypeError unless states and actions are tensors of real numbers, states in single or double precision.
    """
    _require_precise(state)
    require_real(action, "The action")
    batch, nodes, size = state.shape[:-2], scene.num_nodes, scene.state_size
    if state.shape[-2:] != (nodes, size):
        raise ValueError(f"State of scene {scene.name!r} must be [*B, {nodes}, {size}], got {list(state.shape)}.")
    if action.shape != (*batch, scene.num_actions):
        raise ValueError(
            f"Action of scene {scene.name!r} must be {[*batch, scene.num_actions]} to go with a state"
            f" {list(state.shape)}, got {list(action.shape)}.{_past_commands(scene, action)}"
        )
    if parameters is not None and parameters.shape not in ((), batch):
        raise ValueError(
            f"Physical parameters must have no batch or that of the state, {list(batch)}, got {list(parameters.shape)}."
        )


def check_steps(
    scene: Articulation,
    states: Tensor,
    actions: Tensor,
    parameters: TensorDictBase | None = None,
    *,
    each: bool = False,
) -> None:
    """Check start states, or with ``each`` states ``[*B, T, N, C]``, and actions ``[*B, T, A]``.

    See :func:`check_shapes`.
    """
    _require_precise(states)
    require_real(actions, "The action")
    count, first = actions.shape[-2:-1].numel(), states
    if each:
        if states.shape[-3:-2].numel() == 0:
            raise ValueError("There is no state to predict from.")
        first = states[..., 0, :, :] if states.ndim > 2 else states
    if count:
        check_shapes(scene, first, actions[..., 0, :] if actions.ndim > 1 else actions, parameters)


def _require_precise(state: Tensor) -> None:
    """Raise TypeError for integer or 16-bit states, too coarse for positions and the constraint projection."""
    require_real(state, "The state", whole=False)
    if state.dtype.itemsize < 4:
        kind = str(state.dtype).removeprefix("torch.")
        raise TypeError(f"The state must be float32 or float64, not {kind}: convert it with float().")


def _past_commands(scene: Articulation, action: Tensor) -> str:
    """Return advice if an action may hold more or fewer past commands than the kinematic tree's; else an empty text."""
    commands = scene.num_actions // (scene.history + 1) if isinstance(scene, KinematicTree) else 0
    if not commands or action.shape[-1] % commands:
        return ""
    return f" If it holds past commands, give log_tree(..., history={action.shape[-1] // commands - 1})."
