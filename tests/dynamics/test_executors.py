"""Every executor is the reference: values of steps and rollouts, and their gradients."""

from __future__ import annotations

import functools
import itertools

import pytest
import torch
from tensordict import TensorDictBase
from torch import nn

from torchrl_gn.dynamics import ForwardModel, PairContacts, Predictor, specialize
from torchrl_gn.dynamics.executors import EXECUTORS, NativeExecutor
from torchrl_gn.networks import CORES, Core, Graph, GraphSize
from torchrl_gn.scenes import SYSTEMS

from .. import zoo
from ..compiling import compiles


class LinearCore(Core):
    """One layer for every node, without fold()."""

    def __init__(self, dynamic: GraphSize, static: GraphSize, out_nodes: int) -> None:
        super().__init__(dynamic)
        size = dynamic + static
        self.layer = nn.Linear(size.nodes + size.globals_, out_nodes)

    def forward(self, graph: Graph) -> Graph:
        everywhere = graph.globals_.unsqueeze(-2).expand(*graph.nodes.shape[:-1], -1)
        nodes = self.layer(torch.cat((graph.nodes, everywhere), -1)).tanh()
        return Graph(nodes, graph.edges, graph.globals_, graph.edge_index)


SIZES = {"latent": 16, "hidden": 32}
MODELS = {
    "gn": SIZES,
    "mlp": {"core": "mlp", "hidden": (16, 12)},
    "recurrent": {"core": "recurrent", "hidden_state": (3, 4, 5), **SIZES},
    "unfolded": {"core": "unfolded"},
    "absolute": {"parent_relative": False, **SIZES},
}
BOUNDS = {torch.float64: 1e-10, torch.float32: 1e-4}


def cases() -> list:
    """Executor, system, model, batches, whether each sample has parameters of its own, and dtype."""
    batches, found, large = [(), (1,), (5,)], [], {"cheetah", "walker2d", "jaco", "crawler"}
    # State maths are the system's and networks the core's: every one of both, not every pair.
    pairs = [*itertools.product([*SYSTEMS, "joints", "crawler"], ["gn"]), *itertools.product(["swimmer6"], MODELS)]
    for each in dict.fromkeys(pairs):
        marks = [pytest.mark.slow] if each[0] in large else []
        for executor, dtype in itertools.product(("eager", "native"), BOUNDS):
            found.append(pytest.param(executor, *each, batches, False, dtype, marks=marks))
            found.append(pytest.param(executor, *each, [(5,), (2, 1)], True, dtype, marks=marks))
    # A gradient takes minutes to compile. Of recurrent cores see test_compiled.py, of several joints, contacts and
    # float32 test_pair_contacts.py.
    few = [("pendulum", "gn", [()], True, torch.float64), ("pendulum", "mlp", [(5,)], False, torch.float32)]
    for executor in sorted(EXECUTORS.keys() - {"eager", "native"}):
        found += [pytest.param(executor, *each, marks=[pytest.mark.slow, compiles]) for each in few]
    return found


load = functools.cache(zoo.load)


def vjp(predictor: Predictor, state, actions, parameters: TensorDictBase | None, varies) -> list[torch.Tensor]:
    """Changes in a step and in a rollout, and gradients of random functions of both.

    Gradients in channels of the state that cannot move are left out: executors may take them for constants.
    """
    leaves = [value.detach().clone().requires_grad_() for value in (state, actions)]
    after, _ = predictor.step(leaves[0], leaves[1][..., 0, :], parameters)
    states, _ = predictor.rollout(*leaves, parameters)
    generator = torch.Generator().manual_seed(7)
    found = []
    for out in (after - leaves[0], states[..., 1:, :, :] - states[..., :1, :, :]):
        weights = torch.randn(out.shape, generator=generator, dtype=out.dtype)
        gradients = torch.autograd.grad((out * weights).sum(), leaves, retain_graph=True, allow_unused=True)
        of_state, of_actions = (torch.zeros(1) if each is None else each for each in gradients)
        found += [out.detach(), of_state * varies, of_actions]
    return found


def own_parameters(predictor: Predictor, batch: tuple[int, ...]) -> TensorDictBase:
    """Physical parameters of every sample, up to 10 % from the scene's."""
    parameters = predictor.own_parameters().expand(batch).clone()
    generator = torch.Generator().manual_seed(4)
    anchors = ("parent_anchor", "child_anchor", "contact_offset", "contact_radius")
    for part in ("nodes", "edges", "globals_", *anchors, "joint_pose", "actuator"):
        shape = parameters[part].shape
        parameters[part] *= 1 + 0.1 * torch.rand(shape, generator=generator, dtype=torch.float64)
    return parameters


@pytest.mark.parametrize(("executor", "name", "kind", "batches", "own", "dtype"), cases())
def test_every_executor_is_the_reference(
    fit, moved, random_states, random_actions, monkeypatch, executor, name, kind, batches, own, dtype
):
    monkeypatch.setitem(CORES, "unfolded", LinearCore)
    scene = load(name)
    torch.manual_seed(0)
    features = ForwardModel.for_scene(scene, **MODELS[kind]).features
    if own:  # contact edges have the geoms of one variant
        features = [each for each in features if not isinstance(each, PairContacts)]
    model = ForwardModel.for_scene(scene, **{**MODELS[kind], "features": features}).to(dtype)
    model = fit(model, scene).requires_grad_(False)
    reference = model.bind(scene, reference=True, parameters_key="parameters" if own else None)
    predictor = specialize(reference, executor=executor)
    some = random_states(scene, 20)
    varies = (some != some[0]).any(0)
    for batch in batches:
        # About the reference pose state maths is shorter: all samples are, none is, or every other one.
        about = (torch.arange(torch.Size(batch).numel()).view(batch) + (batch == (1,))) % 2 == 0
        state = torch.where(about[..., None, None], moved(reference, *batch), random_states(scene, *batch, seed=3))
        actions = random_actions(scene, *batch, 3, seed=3)
        parameters = own_parameters(reference, batch) if own else None
        expected, found = (vjp(each, state, actions, parameters, varies) for each in (reference, predictor))
        for wanted, got in zip(expected, found, strict=True):
            assert got.dtype == wanted.dtype and got.shape == wanted.shape
            assert (got - wanted).norm() <= BOUNDS[dtype] * wanted.norm()
        if executor == "native":
            running = predictor.prepared(parameters).executor
            assert isinstance(running, NativeExecutor) and (running.reason is None) == (
                kind in ("gn", "mlp", "absolute")
            )
