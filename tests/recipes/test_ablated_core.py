"""The cores of the ablation study against the two graph networks that they are a part of."""

from __future__ import annotations

import pytest
import torch

from _common import AblatedCore
from torchrl_gn.data import collect_trajectories, trajectory_buffer
from torchrl_gn.dynamics import ForwardModel, specialize
from torchrl_gn.networks import GNBlock, GNCore, GraphSize
from torchrl_gn.objectives import ForwardModelLoss
from torchrl_gn.scenes import load_scene

EDGES = torch.tensor([[0, 1, 0, 2], [1, 0, 1, 2]])
SIZE, NONE = GraphSize(3, 2, 4), GraphSize(0, 0, 0)
SIZES = {"latent": 6, "edge_hidden": (7,), "node_hidden": (5,), "global_hidden": (4,)}


def test_with_all_its_parts_it_is_the_core(random_graph):
    torch.manual_seed(0)
    core = GNCore(SIZE, NONE, 5, **SIZES).double()
    ablated = AblatedCore(SIZE, NONE, 5, **SIZES).double()
    ablated.load_state_dict({name.replace("second", "last"): value for name, value in core.state_dict().items()})
    graph = random_graph(SIZE, EDGES, 3, 2)
    torch.testing.assert_close(ablated(graph).nodes, core(graph).nodes, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("part", ["nodes", "edges", "globals_"])
def test_what_a_block_does_not_update_passes_through(random_graph, part):
    torch.manual_seed(0)
    sizes = {"nodes": 6, "edges": 5, "globals_": 3} | {part: 0}
    hidden = {"edge_hidden": (7,), "node_hidden": (5,), "global_hidden": (4,)}
    graph = random_graph(SIZE, EDGES, 3, 2)
    out = GNBlock(SIZE, GraphSize(**sizes), **hidden).double()(graph)
    for name, size in sizes.items():
        assert getattr(out, name).shape[-1] == (size or getattr(SIZE, name))
    assert torch.equal(getattr(out, part), getattr(graph, part))


def reaches(core: AblatedCore, graph, source: str, item: int) -> set[int]:
    """Nodes whose prediction depends on one node or edge."""
    features = getattr(graph, source).clone().requires_grad_()
    graph = type(graph)(**(vars(graph) | {source: features}))
    out, reached = core(graph).nodes, set()
    for node in range(out.shape[-2]):
        (gradient,) = torch.autograd.grad(out[..., node, :].sum(), features, retain_graph=True)
        if gradient[..., item, :].abs().sum() > 0:
            reached.add(node)
    return reached


def test_how_far_information_reaches(random_graph):
    """The globals reach all nodes of a chain of five; two rounds reach two joints, one round reaches one."""
    chain = torch.tensor([[0, 1, 2, 3, 1, 2, 3, 4], [1, 2, 3, 4, 0, 1, 2, 3]])
    graph = random_graph(SIZE, chain, 5, 2)
    expected = {
        ("none", True): {0, 1, 2, 3, 4},
        ("no_global_update", True): {0, 1, 2},
        ("no_global_update", False): {0, 1, 2},
        ("interaction_network", True): {0, 1},
        # Summed over all nodes, with or without the first update of each.
        ("no_node_update", True): {0, 1, 2, 3, 4},
        ("no_edge_update", False): {0, 1, 2, 3, 4},
    }
    for (ablation, skip), nodes in expected.items():
        torch.manual_seed(0)
        core = AblatedCore(SIZE, NONE, 5, ablation=ablation, skip=skip, activation="tanh", **SIZES).double()
        assert reaches(core, graph, "nodes", 0) == nodes, ablation


@pytest.fixture(scope="module")
def swimmer():
    """A scene and its transitions."""
    scene = load_scene("swimmer6")
    trajectories = collect_trajectories(scene, 5, 20, seed=0)
    return scene, trajectory_buffer(trajectories, batch_size=100, seed=0).sample()


@pytest.mark.parametrize(
    "ablation", ["interaction_network", "no_edge_update", "no_node_update", "no_global_update", "none"]
)
@pytest.mark.parametrize("skip", [True, False])
def test_every_ablation_predicts_and_learns(swimmer, ablation, skip):
    scene, seen = swimmer
    torch.manual_seed(0)
    model = ForwardModel.for_scene(scene, core="ablated", ablation=ablation, skip=skip, **SIZES)
    bound, reference = model.bind(scene), model.bind(scene, reference=True)
    loss = ForwardModelLoss(bound)
    loss.fit_normalizers(seen)
    state, action = seen["state"][:4], seen["action"][:4]
    after, _ = bound.step(state, action)
    torch.testing.assert_close(after, reference.step(state, action)[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(after, specialize(bound).step(state, action)[0], rtol=1e-5, atol=1e-6)
    again = ForwardModel.from_description(model.description())
    again.load_state_dict(model.state_dict())
    assert torch.equal(again.bind(scene).step(state, action)[0], after)
    loss(seen[:4])["loss_forward_model"].backward()
    matrices = [weight for weight in model.core.parameters() if weight.ndim == 2]
    assert all(weight.grad is not None and weight.grad.abs().sum() > 0 for weight in matrices)
    with pytest.raises(TypeError, match="AblatedCore has no fold"):
        specialize(bound, executor="compiled")


def test_unknown_choices_are_named():
    with pytest.raises(ValueError, match="ablation='both' is not known; use one of"):
        AblatedCore(SIZE, NONE, 5, ablation="both", **SIZES)
    with pytest.raises(ValueError, match="activation='sin' is not known"):
        AblatedCore(SIZE, NONE, 5, activation="sin", **SIZES)
