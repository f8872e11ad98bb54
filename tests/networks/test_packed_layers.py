"""Packed layers are the folded core that they were made of, and packing loses nothing."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchrl_gn.dynamics.executors.native import NoCompilerError
from torchrl_gn.dynamics.executors.native.operators import load_operators
from torchrl_gn.networks import Incidence
from torchrl_gn.networks.graph import GraphSize
from torchrl_gn.networks.layers import LayerList
from torchrl_gn.networks.packed_layers import PANEL, LayerShapes, PackedLayers, pack_pairs, pack_sample_tables

from .test_layers import NO_EDGES, RING, TREE, core


def has_compiler() -> bool:
    try:
        load_operators()
    except NoCompilerError:
        return False
    return True


pytestmark = pytest.mark.skipif(not has_compiler(), reason="there is no C++ compiler")
SHAPES = [(1, 1), (3, 5), (16, 16), (17, 16), (16, 17), (40, 33), (5, 1), (1, 50), (31, 2)]


def packed(layers: LayerList, predicted, dtype: torch.dtype = torch.float64) -> PackedLayers:
    shapes, sums = LayerShapes(layers), torch.float32 if dtype == torch.bfloat16 else dtype
    weights = [layer.weight for layer in layers.layers]
    tables = [layer.table.reshape(-1) for layer in layers.layers if layer.table is not None and layer.table.ndim == 2]
    pack = torch.ops.torchrl_gn.pack
    plain = torch.cat([weight.reshape(-1) for weight in weights]).to(sums)
    return PackedLayers(
        shapes,
        predicted,
        pack_pairs(weights) if dtype == torch.bfloat16 else pack(plain, shapes.weights, True),
        pack(torch.cat([*tables, plain[:0]]).to(sums), shapes.tables, False),
        torch.zeros(1, 0, dtype=torch.float64),
        pack_sample_tables(layers, sums),
    )


@pytest.mark.parametrize("own", [False, True])
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("kind", ["gn", "mlp"])
@pytest.mark.parametrize(("edges", "predicted"), [(RING, [0, 1, 2]), (TREE, [3, 1]), (NO_EDGES, [1])])
def test_predicts_as_the_folded_core(random_graph, kind, edges, predicted, depth, own):
    sizes, num_nodes = (GraphSize(3, 2, 0), GraphSize(4, 1, 3)), 4
    dynamic, static = (random_graph(size, edges, num_nodes, 6) for size in sizes)
    if not own:  # one static graph for all samples
        static = type(static)(*(part[0] for part in static.features), edges)
    incidence = Incidence(edges, num_nodes, torch.tensor(predicted))
    folded = core(kind, sizes, (num_nodes, edges.shape[1]), depth).fold(incidence, static)
    layers = packed(folded.layers(), folded.predicted)
    assert (layers.sample_tables is not None) == own
    found, expected = layers.predict(dynamic), folded.predict(dynamic)
    torch.testing.assert_close(found[:, predicted], expected[:, predicted])
    others = [node for node in range(num_nodes) if node not in predicted]
    assert found.shape == expected.shape and not found[:, others].any()
    if not own:
        graph = type(dynamic)
        single = layers.predict(graph(*(part[0] for part in dynamic.features), edges))
        torch.testing.assert_close(single, found[0])
        both = layers.predict(graph(*(part.unflatten(0, (2, 3)) for part in dynamic.features), edges))
        torch.testing.assert_close(both.flatten(0, 1), found)
        nothing = layers.predict(graph(*(part[:0] for part in dynamic.features), edges))
        assert nothing.shape == expected[:0].shape


def matrices(*shapes: tuple[int, int]) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator) for shape in shapes]


def layers_of(weights: list[Tensor]) -> PackedLayers:
    """Layers of which only the weights matter."""
    shapes = object.__new__(LayerShapes)
    shapes.layers = tuple(type("Layer", (), {"weight": tuple(each.shape)})() for each in weights)
    nothing = torch.zeros(0)
    return PackedLayers(shapes, slice(None), nothing, nothing, nothing)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_packed_weights_are_panels_of_the_matrix_and_of_its_transpose(dtype):
    given = [each.to(dtype) for each in matrices(*SHAPES)]
    numbers = torch.cat([each.flatten() for each in given])
    out = torch.ops.torchrl_gn.pack(numbers, [size for shape in SHAPES for size in shape], True)
    place = 0
    for weight in given:
        for matrix in (weight, weight.T):
            rows, columns = matrix.shape
            panels = -(-rows // PANEL)
            part = out[place : place + panels * columns * PANEL].view(panels, columns, PANEL)
            padded = torch.nn.functional.pad(matrix, (0, 0, 0, panels * PANEL - rows))
            assert torch.equal(part, padded.view(panels, PANEL, columns).mT)
            place += part.numel()
    assert place == out.numel()
    layers = layers_of(given)
    found = PackedLayers(layers.shapes, layers.predicted, out, layers.tables, layers.numbers).plain_weights()
    assert all(map(torch.equal, found, given))


def test_pairs_of_bfloat16_are_read_again():
    given = matrices(*SHAPES)
    layers = layers_of(given)
    out = pack_pairs(given)
    found = PackedLayers(layers.shapes, layers.predicted, out, layers.tables, layers.numbers).plain_weights()
    for matrix, wanted in zip(found, given, strict=True):
        assert torch.equal(matrix, wanted.to(torch.bfloat16))


def test_layers_without_inputs_take_no_room_in_bfloat16():
    weight = matrices((17, 5))[0]
    assert torch.equal(pack_pairs([torch.zeros(4, 0), weight, torch.zeros(0, 3)]), pack_pairs([weight]))


def test_tables_are_padded_row_by_row():
    given = matrices((3, 5), (2, 16), (1, 17))
    shapes = [size for each in given for size in each.shape]
    out = torch.ops.torchrl_gn.pack(torch.cat([each.flatten() for each in given]), shapes, False)
    parts = [torch.nn.functional.pad(each, (0, -each.shape[1] % PANEL)).flatten() for each in given]
    assert torch.equal(out, torch.cat(parts))


@pytest.mark.parametrize("weights", [False, True])
def test_the_gradient_of_packing_is_that_of_copying(weights):
    given = torch.randn(15 + 34, dtype=torch.float64, requires_grad=True)
    out = torch.ops.torchrl_gn.pack(given, [3, 5, 17, 2], weights)
    marks = torch.arange(1.0, out.numel() + 1, dtype=torch.float64)
    (found,) = torch.autograd.grad((out * marks).sum(), given)
    # Marks of the first copy alone: a weight's transpose is the engine's own.
    places = torch.ops.torchrl_gn.pack(torch.arange(1.0, 50, dtype=torch.float64), [3, 5, 17, 2], weights)
    for index in range(49):
        first = (places == index + 1).nonzero()[0]
        assert found[index] == marks[first]


def test_bfloat16_predicts_about_the_same(random_graph):
    sizes = GraphSize(3, 2, 0), GraphSize(4, 1, 3)
    dynamic, static = random_graph(sizes[0], RING, 3, 6), random_graph(sizes[1], RING, 3)
    folded = core("gn", sizes, (3, 3), 2).fold(Incidence(RING, 3), static)
    layers = packed(folded.layers(), folded.predicted, torch.bfloat16)
    graph = type(dynamic)(*(part.to(torch.bfloat16) for part in dynamic.features), RING)
    expected = folded.predict(dynamic)
    assert (layers.predict(graph).double() - expected).norm() < 0.03 * expected.norm()
