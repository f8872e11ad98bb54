"""A learned model as a TorchRL environment."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs.model_based import ModelBasedEnvBase

from torchrl_gn.checks import check_count
from torchrl_gn.data.simulate import Simulator
from torchrl_gn.drawing import draw_states
from torchrl_gn.dynamics import Predictor, as_predictor
from torchrl_gn.dynamics.as_predictor import ModulePredictor
from torchrl_gn.dynamics.ensemble import BoundEnsemble, mean_of
from torchrl_gn.dynamics.predictor import require_bound
from torchrl_gn.dynamics.program import PreparedStep
from torchrl_gn.envs.episode_ends import Imagined, imagined_steps
from torchrl_gn.envs.partial_steps import step_some
from torchrl_gn.envs.specs import (
    DoneFunction,
    RewardFunction,
    finite_reward,
    outcome,
    read,
    reward_of,
    set_specs,
    spec_of,
)
from torchrl_gn.envs.starts import StartSampler, StartStates
from torchrl_gn.envs.terminal import TerminalValue, step_entries, terminal_of
from torchrl_gn.envs.transform_checks import note_output, refuse_transforms
from torchrl_gn.finite import is_traced, require_finite, require_real
from torchrl_gn.scenes.articulation import Articulation
from torchrl_gn.scenes.kinematic_tree import KinematicTree
from torchrl_gn.scenes.scene import Scene

_UNIT = 1e-2  # tolerance on the squared length of a quaternion


class ModelEnv(ModelBasedEnvBase):
    """Environment of a learned model, with the specs of :class:`~torchrl_gn.envs.SceneEnv` but no ``physics``.

    Stateless, batched over any leading batch, and differentiable in ``state``, ``action`` and the weights of
    ``world_model``. If a prediction is not finite, the step keeps the last good state, sets ``done`` and ``terminated``
    and gives ``unstable_reward``. Rollouts and collectors reset at every end, as with any TorchRL environment.

    ``reset(tensordict, set_state=True)`` starts from the TensorDict's ``state`` and the entries that the model carries
    from step to step; ``reset()`` starts from drawn states. Physical parameters come from the TensorDict, else from the
    scene (zeros if inferred); TorchRL does not carry them across auto-resets. For a model that reads past commands
    (:attr:`KinematicTree.history`), ``past_actions`` ``[*B, history, A]`` is a further entry, and ``action`` is the
    present command alone.

    Args:
        model: module from ``"state"`` and ``"action"`` to ``("next", "state")``, with an attribute ``scene``.
        reward: function ``(state, action, next_state, task) -> [*B, 1]``; zero without one.
        done, unstable_reward, terminal: see :class:`~torchrl_gn.envs.SceneEnv`.
        action_repeat: model steps per step of the environment. The action is held, their rewards are summed, and
            ``done`` may end the episode after each. :attr:`scene` has the longer control step.
        trust: for an ensemble, the highest accepted :meth:`~torchrl_gn.dynamics.BoundEnsemble.doubt` of a step. A step
            with more doubt ends the episode, like one that is not finite.
        start_states: full MuJoCo states ``[M, S]``, or ``(n, generator) -> [n, S]``. Default: the system's own. A
            :class:`~torchrl_gn.scenes.KinematicTree` needs states ``[M, N, C]``, for example from a log.
        seed: seed of the start states. Default: drawn from torch's global generator.

    Raises:
        TypeError: the model lacks these keys or the scene.
        ValueError: an entry, the start states or the reward do not fit the scene, or are not finite; ``trust`` is not
            positive, or given with a model without ``doubt``; or actions are repeated for a model that reads past ones.
        RuntimeError: ``trust`` is given with an ensemble that is not calibrated.
    """

    _supports_set_state = True
    scene: Articulation

    def __init__(
        self,
        model: TensorDictModuleBase,
        reward: RewardFunction | None = None,
        *,
        done: DoneFunction | None = None,
        terminal: TerminalValue | None = None,
        start_states: StartStates | None = None,
        unstable_reward: float | None = None,
        action_repeat: int = 1,
        trust: float | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ):
        require_bound(model)
        inputs, outputs = getattr(model, "in_keys", ()), getattr(model, "out_keys", ())
        if not {"state", "action"} <= set(inputs) or ("next", "state") not in outputs:
            keys = f"{type(model).__name__} has in_keys {list(inputs)} and out_keys {list(outputs)}"
            raise TypeError(f"the model must read 'state' and 'action' and write ('next', 'state'); {keys}")
        if not hasattr(model, "scene"):
            raise TypeError(f"the model has no attribute 'scene'; bind {type(model).__name__} to a scene first")
        if device is None:
            weight = next(itertools.chain(model.parameters(), model.buffers()), None)
            device = torch.device("cpu") if weight is None else weight.device
        super().__init__(cast(TensorDictModule, model), device=device)
        robot, self.history = cast(Articulation, model.scene), 0
        if isinstance(robot, KinematicTree):
            self.history, robot = robot.history, robot.present
        self.scene = robot
        self.reward = reward_of(reward, self, self.scene)
        self.action_repeat = _checked_repeat(action_repeat, self.history)
        self.scene = _with_longer_steps(self.scene, self.action_repeat)
        self.ends = done
        self.terminal = terminal_of(terminal, self, self.scene)
        self.unstable_reward, self.spares_learners = finite_reward(unstable_reward), unstable_reward is None
        self.trust = None if trust is None else checked_trust(trust, model)
        self.starts = StartSampler(self.scene, start_states, seed)
        self._state_shape = self.scene.num_nodes, self.scene.state_size
        self._simulator: Simulator | None = None
        set_specs(self, self.scene, physics=False)
        if self.parameters_key is not None:
            self.state_spec[self.parameters_key] = spec_of(cast(Any, model).own_parameters(), self.device)
        if "hidden_state" in inputs:
            for spec in (self.observation_spec, self.state_spec):
                spec["hidden_state"] = spec_of(cast(Any, model).initial_hidden_state(), self.device)
        if self.history:
            for spec in (self.observation_spec, self.state_spec):
                shape = torch.Size((self.history, self.scene.num_actions))
                spec["past_actions"] = Unbounded(shape, dtype=torch.float32, device=self.device)

    @property
    def predictor(self) -> Predictor | ModulePredictor:
        return as_predictor(cast(TensorDictModuleBase, self.world_model))

    @property
    def members(self) -> int:
        """Number of members of an ensemble; 1 for another model."""
        return len(self.world_model.members) if isinstance(self.world_model, BoundEnsemble) else 1

    def by_member(self) -> ModelEnv:
        """Return this environment with its ensemble split (:meth:`~torchrl_gn.dynamics.BoundEnsemble.split`).

        The result steps ``[K B]`` samples, the first ``B`` by the first member. Without an ensemble, return this
        environment.
        """
        if not isinstance(self.world_model, BoundEnsemble):
            return self
        env = copy.copy(self)
        env._modules = dict(self._modules)  # copy.copy shares the dict
        env.world_model = cast(Any, self.world_model.split())
        return env

    def of_states(self) -> ModelEnv:
        """Return this environment with single model steps, and without reward, ``done`` and terminal value.

        Call :func:`imagined_steps` afterwards to evaluate those for all steps at once.
        """
        env = copy.copy(self)
        env._modules = dict(self._modules)  # copy.copy shares the dict
        env.reward = env.ends = env.terminal = None
        env.action_repeat = 1
        return env

    @property
    def parameters_key(self) -> NestedKey | None:
        """Key of the physical parameters of each sample; None if the model reads none."""
        return getattr(self.world_model, "parameters_key", None)

    def _reset(self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, **_) -> TensorDict:
        tensordict = TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict
        shape = tensordict.shape
        if set_state:
            state = read(tensordict, "state", self._state_shape, self).to(torch.float64, copy=True)
            require_finite(state, f"{self}: 'state'")
        else:
            if self._simulator is None and isinstance(self.scene, Scene):
                self._simulator = Simulator(self.scene)
            state = self.starts.draw(shape, tensordict.get("_reset", None), simulator=self._simulator)
            if self._simulator is not None:
                state = self._simulator.observe(state)
        note_output(self, state, reset=True)
        reset = TensorDict({"state": state}, batch_size=shape, device=self.device)  # also moves entries set later
        if (key := self.parameters_key) is not None:
            if (parameters := tensordict.get(key, None)) is None:
                parameters = cast(Any, self.world_model).own_parameters().expand(shape)
            else:
                require_finite(parameters, f"{self}: {key!r}")
            reset.set(key, parameters)
        if "hidden_state" in self.world_model.in_keys:
            hidden_state = tensordict.get("hidden_state", None) if set_state else None  # else of another episode
            if hidden_state is None:
                hidden_state = cast(Any, self.world_model).initial_hidden_state().expand(shape).clone()
            reset.set("hidden_state", hidden_state)
        if self.history:
            known = tensordict if set_state else TensorDict(batch_size=shape)
            reset.set("past_actions", self._past_actions(known).clone())
        if self.terminal is not None:
            reset.set("discount", torch.ones(*shape, 1, dtype=torch.float32))
        return reset

    def _past_actions(self, tensordict: TensorDictBase) -> Tensor:
        """Return previous actions ``[*B, history, A]``, the latest first; zeros (within bounds) by default."""
        if "past_actions" in tensordict.keys():
            return read(tensordict, "past_actions", (self.history, self.scene.num_actions), self)
        low, high = (torch.as_tensor(bound).float() for bound in (self.scene.action_low, self.scene.action_high))
        return low.new_zeros(*tensordict.shape, self.history, len(low)).clamp(low, high).to(self.device)

    def _with_past(self, tensordict: TensorDictBase, actions: Tensor) -> Tensor:
        """Return the model's input ``[*B, H, (history + 1) A]``: actions ``[*B, H, A]``, each with its past actions."""
        if not self.history:
            return actions
        past = self._past_actions(tensordict).to(actions.dtype)
        windows = torch.cat((past.flip(-2), actions), -2).unfold(-2, self.history + 1, 1)  # [*B, H, A, history + 1]
        return windows.flip(-1).transpose(-1, -2).flatten(-2)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        refuse_transforms(self, tensordict, "state")
        stepped = step_some(tensordict, self._step_all)
        note_output(self, cast(Tensor, stepped["state"]), reset=False)
        return stepped

    def _step_all(self, tensordict: TensorDictBase) -> TensorDict:
        state = read(tensordict, "state", self._state_shape, self)
        action = read(tensordict, "action", (self.scene.num_actions,), self)
        self._require_own(state)
        entries = self._model_step(tensordict, state, action)
        for _ in range(1, self.action_repeat):
            now = tensordict.exclude("next").update({key: entries[key] for key in ("state", *self.carried_keys)})
            entries = _continued(entries, self._model_step(now, entries["state"], action))
        entries |= step_entries(self, tensordict, state, entries)
        return TensorDict(entries, batch_size=tensordict.shape, device=self.device)

    def _model_step(self, tensordict: TensorDictBase, state: Tensor, action: Tensor) -> dict[str, Any]:
        """Return the entries after one model step."""
        inputs = self._inputs(tensordict)
        predicted, trusted = self._predicted(inputs)
        stable = cast(Tensor, predicted["state"]).isfinite().flatten(-2).all(-1, keepdim=True)
        if trusted is not None:
            stable = stable & trusted.unsqueeze(-1)
        carried = self.carried(tensordict, predicted)
        return outcome(self, tensordict, state, action, predicted["state"], stable, **carried)

    def _predicted(self, inputs: TensorDictBase) -> tuple[TensorDictBase, Tensor | None]:
        """Return the model's entries after a step, and a mask ``[*B]`` of trusted ones; None: all are.

        Of an ensemble the entries are the mean alone, which needs no calibration.
        """
        state, action = (cast(Tensor, inputs[key]) for key in ("state", "action"))
        if not isinstance(self.world_model, BoundEnsemble):
            trusted = None if self.trust is None else self._trusted(state, action)
            return cast(TensorDictBase, self.world_model(inputs)["next"]), trusted
        self.world_model.parameters_in(inputs)  # refuses other variants
        members, trusted = self.world_model.step(state, action), None
        if self.trust is not None:  # from the same steps of the members
            trusted = self.world_model.doubt_of(members.detach()) <= self.trust
        return TensorDict({"state": mean_of(members, self.world_model.layout)}, inputs.shape), trusted

    def _trusted(self, state: Tensor, action: Tensor) -> Tensor:
        """Return a mask ``[*B]`` of trusted steps from states ``[*B, N, 13]``."""
        with torch.no_grad():
            return cast(Any, self.world_model).doubt(state, action) <= self.trust

    def _require_own(self, state: Tensor) -> None:
        """Raise ValueError if quaternions show that a transform has overwritten the state that a step starts from."""
        bodies = isinstance(self.world_model, Predictor) and isinstance(self.scene, Scene)
        if not bodies or state.device.type != "cpu" or is_traced():
            return
        off = (state.detach()[..., 3:7].square().sum(-1) - 1).abs()
        if bool((off > _UNIT).any()):
            raise ValueError(
                f"{self}: a quaternion of 'state' has squared length {float(1 + off.max()):.3g} or as far below 1. A"
                " transform that changes observations (ObservationNorm, VecNorm) must write them to another key,"
                " out_keys=[...]: the next step starts from 'state'."
            )

    @property
    def carried_keys(self) -> list[str]:
        """Entries that a step reads and writes besides the state."""
        return [key for key in ("hidden_state", "past_actions") if key in self.observation_spec.keys()]

    def carried(self, tensordict: TensorDictBase, predicted: TensorDictBase | None = None) -> dict[str, Any]:
        """Return the next step's :attr:`carried_keys`; ``predicted`` is the model's output, if known."""
        entries: dict[str, Any] = {}
        if "hidden_state" in self.carried_keys:
            predicted = self.world_model(self._inputs(tensordict))["next"] if predicted is None else predicted
            entries["hidden_state"] = cast(TensorDictBase, predicted)["hidden_state"]
        if self.history:
            action = tensordict["action"].unsqueeze(-2)
            entries["past_actions"] = torch.cat((action, self._past_actions(tensordict)[..., :-1, :]), -2)
        return entries

    def _inputs(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the model's input, a shallow copy, because the model writes into it.

        The copy keeps all entries, so that the model can refuse some.
        """
        inputs = tensordict.exclude("next")
        if self.history:
            inputs.set("action", self._with_past(tensordict, tensordict["action"].unsqueeze(-2)).squeeze(-2))
        return inputs

    def imagine(self, tensordict: TensorDictBase, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Predict states ``[*B, H + 1, N, 13]`` and rewards ``[*B, H, 1]`` of actions ``[*B, H, A]``; differentiable.

        Equals stepping a TensorDict ``[*B]`` until ``done``, but is faster; later rewards are 0. States are returned
        as predicted, also after the end and where they are not finite. With a terminal value, the rewards are those of
        :func:`~torchrl_gn.envs.terminal.plan_rewards`.
        """
        return self.imagine_steps(tensordict, actions)[:2]

    def prepared(self, tensordict: TensorDictBase, horizon: int) -> PreparedStep | None:
        """Prepare the model's step for many calls of :meth:`imagine_steps` with fixed weights and physical parameters.

        Returns None if the model cannot prepare one.
        """
        model = self.predictor
        if not isinstance(model, Predictor):
            return None
        size = tensordict.numel() * horizon * self.action_repeat
        return model.prepared(model.parameters_in(tensordict), size=size)

    def imagine_by_member(
        self, tensordict: TensorDictBase, actions: Tensor, prepared: PreparedStep | None = None
    ) -> Imagined:
        """Run :meth:`imagine_steps` with every member of an ensemble, from a TensorDict ``[B]``.

        Returns ``[K B, ...]``, the first member's samples first; ``K`` is 1 for another model.
        """
        if (count := self.members) > 1:
            tensordict = cast(TensorDictBase, torch.cat(cast(Any, [tensordict] * count)))
            actions = actions.repeat(count, 1, 1)
        return self.by_member().imagine_steps(tensordict, actions, prepared)

    def imagine_steps(
        self, tensordict: TensorDictBase, actions: Tensor, prepared: PreparedStep | None = None
    ) -> Imagined:
        """Return states and rewards as :meth:`imagine` does, and a mask of the steps that count."""
        require_real(actions, "The actions")
        shape = (*tensordict.shape, actions.shape[-2] if actions.ndim > 1 else 0, self.scene.num_actions)
        if actions.shape != shape or shape[-2] < 1:
            raise ValueError(
                f"actions must be [*B, H, {self.scene.num_actions}] with the TensorDict's batch"
                f" {list(tensordict.shape)} and H at least 1, got {list(actions.shape)}"
            )
        state = read(tensordict, "state", self._state_shape, self)
        model = self.predictor
        inputs: Any = model.parameters_in(tensordict), model.hidden_state_in(tensordict)
        folded: Any = {} if prepared is None else {"prepared": prepared}
        if self.action_repeat > 1:
            actions = actions.repeat_interleave(self.action_repeat, -2)
        model_actions = self._with_past(tensordict, actions)
        states, _ = model.rollout(state, model_actions, *inputs, **folded)
        trusted = None if self.trust is None else self._trusted(states[..., :-1, :, :], model_actions)
        return imagined_steps(self, tensordict, states, actions, trusted)

    def render(self, tensordict: TensorDictBase, *, size: int = 360) -> np.ndarray:
        """Render images ``[*B, size, size, 3]`` uint8 of the TensorDict's ``state``, as :class:`SceneEnv` does.

        TypeError for a kinematic tree, which has no shapes.
        """
        if not isinstance(self.scene, Scene):
            raise TypeError(f"{self} cannot be drawn: a robot known by its joints alone has no shapes")
        return draw_states(self.scene, read(tensordict, "state", self._state_shape, self), size=size)

    def _set_seed(self, seed: int | None) -> None:
        self.starts.seed(seed)

    def __repr__(self) -> str:
        return f"ModelEnv({self.scene.name!r})"

    def __getstate__(self) -> dict:
        # Copies and worker processes start their own threads and MuJoCo data.
        return {**super().__getstate__(), "_simulator": None}


def _checked_repeat(action_repeat: int, history: int) -> int:
    """Return ``action_repeat``; ValueError unless it is a whole number above 0, and 1 for a model of past actions."""
    check_count("action_repeat", action_repeat, 1)
    if history and action_repeat > 1:
        raise ValueError(
            f"action_repeat={action_repeat} is for models without past actions: this model reads {history} of"
            " them, one per step."
        )
    return int(action_repeat)


def _with_longer_steps(scene: Articulation, factor: int) -> Articulation:
    """Return a scene or kinematic tree with control steps ``factor`` times as long."""
    if factor == 1:
        return scene
    if isinstance(scene, Scene):
        return dataclasses.replace(scene, substeps=factor * scene.substeps)
    return dataclasses.replace(scene, timestep=factor * scene.timestep)


def _continued(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """Return the entries after two model steps, with both rewards; episodes that ended stay as they were."""
    ended = before["terminated"]
    entries = {key: _pick_ended(ended, before[key], after[key]) for key in after}
    entries["reward"] = before["reward"] + torch.where(ended, 0.0, after["reward"])
    return entries


def _pick_ended(ended: Tensor, before: Any, after: Any) -> Any:
    """Return ``before`` where ``ended`` ``[*B, 1]``, else ``after``: tensors or TensorDicts ``[*B, ...]``."""
    if isinstance(after, TensorDictBase):
        return after.apply(lambda new, old: _pick_ended(ended, old, new), before)
    return torch.where(ended.reshape(*ended.shape[:-1], *[1] * (after.ndim - ended.ndim + 1)), before, after)


def checked_trust(trust: float, model: object) -> float:
    """Return ``trust``, the highest accepted doubt of a model, as a float.

    ValueError unless it is positive and the model has ``doubt``; RuntimeError if an ensemble is not calibrated.
    """
    if not hasattr(model, "doubt"):
        raise ValueError(f"trust={trust} needs a model with doubt(), an ensemble, not {type(model).__name__}.")
    if not trust > 0:
        raise ValueError(f"trust={trust} must be positive: 1 is typical of the calibration data.")
    if isinstance(model, BoundEnsemble):
        model.calibration.require_fitted()
    return float(trust)
