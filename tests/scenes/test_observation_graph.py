"""Flat observations as graphs: the suite's swimmers, tables by hand, and refusals that name the fault."""

from __future__ import annotations

import json

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import ObservationGraph


def branching(**changes) -> ObservationGraph:
    """A torso with an arm and a leg, and a foot on the leg: everywhere another number of features."""
    declared = {
        "name": "branching",
        "observation": {"height": 1, "angles": 3, "velocities": 4, "goal": 2},
        "nodes": {
            "torso": ("height", "velocities[0:2]"),
            "arm": ("velocities[2]",),
            "leg": (),
            "foot": ("velocities[3]",),
        },
        "joints": {("torso", "arm"): ("angles[0]",), ("torso", "leg"): ("angles[1:3]",), ("leg", "foot"): ()},
        "globals_": ("goal",),
        "actions": {("torso", "leg"): (2, 0), ("leg", "foot"): (1,)},
    }
    return ObservationGraph(**(declared | changes))


@pytest.mark.parametrize("links", [3, 6, 11])
def test_swimmers_are_arranged_as_the_suite_observes_them(links, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")  # dm_control would look for a display
    from dm_control.suite import swimmer

    graph, task = ObservationGraph.swimmer(links), swimmer.swimmer(links, random=1)
    spec = {name: entry.shape[0] for name, entry in task.observation_spec().items()}
    assert list(graph.observation.items()) == list(spec.items())
    assert (graph.num_observations, graph.num_actions) == (4 * links + 1, task.action_spec().shape[0])

    task.reset()
    physics = task.physics
    with physics.reset_context():
        physics.data.qvel[:] = np.random.default_rng(0).normal(size=physics.model.nv)
    flat = np.concatenate(list(task.task.get_observation(physics).values()))
    model, data = physics.model.ptr, physics.data.ptr
    for node, entries in zip(graph.node_names, graph.node_entries, strict=True):
        body, velocity = model.body(node).id, np.empty(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
        np.testing.assert_allclose(flat[entries[:3]], velocity[[3, 4, 2]], atol=1e-12)
    for (before, after), action in graph.actions.items():
        joint = model.body(after).jntadr[0]
        assert model.body(after).parentid[0] == model.body(before).id
        assert flat[graph.node_entries[graph.node_names.index(after), 3]] == data.qpos[model.jnt_qposadr[joint]]
        assert [index for index in range(model.nu) if model.actuator_trnid[index, 0] == joint] == list(action)
    np.testing.assert_array_equal(flat[graph.global_entries], physics.nose_to_target())


def test_the_papers_swimmer_has_25_observations_and_5_actions():
    graph = ObservationGraph.of_task("swimmer", "swimmer6")
    assert (graph.num_observations, graph.num_actions, graph.num_nodes, graph.num_edges) == (25, 5, 6, 10)
    with pytest.raises(ValueError, match="Only swimmers have a mapping built in; .* for cheetah run"):
        ObservationGraph.of_task("cheetah", "run")


def test_tables_by_hand():
    graph = branching()
    assert graph.node_entries.tolist() == [
        [0, 4, 5, -1, -1],
        [6, -1, -1, 1, -1],
        [-1, -1, -1, 2, 3],
        [7, -1, -1, -1, -1],
    ]
    assert (graph.num_node_features, graph.num_joint_features) == (3, 2)
    assert graph.global_entries.tolist() == [8, 9]
    assert graph.edge_index.tolist() == [[0, 1, 0, 2, 2, 3], [1, 0, 2, 0, 3, 2]]
    assert graph.node_actions.tolist() == [[-1, -1], [-1, -1], [2, 0], [1, -1]]
    assert (graph.parent.tolist(), graph.moved.tolist()) == ([-1, 0, 0, 2], [1, 2, 3])
    lonely = ObservationGraph("lonely", {"x": 2}, {"all": ("x",)}, {})
    assert lonely.edge_index.shape == (2, 0) and lonely.node_entries.tolist() == [[0, 1]]


JOINTS = {("torso", "arm"): ("angles[0]",), ("torso", "leg"): ("angles[1]",), ("leg", "foot"): ("angles[2]",)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"globals_": ("gaol",)},
            r"'gaol' of 'branching' is not known; use \['height', 'angles', 'velocities', 'goal'\]",
        ),
        ({"globals_": ("goal[-1]",)}, r"'goal\[-1\]' of 'branching' is not known"),
        ({"globals_": ("goal[2]",)}, r"'goal\[2\]' of 'branching' is out of range: 'goal' has 2 numbers"),
        ({"globals_": ("goal[1:3]",)}, r"'goal\[1:3\]' of 'branching' is out of range"),
        ({"globals_": ("goal[1:1]",)}, r"'goal\[1:1\]' of 'branching' is out of range"),
        ({"globals_": ("goal[0]",)}, r"'goal\[1\]' has no place in the graph of 'branching'"),
        ({"globals_": ("goal", "height")}, r"'height\[0\]' is used twice in the graph of 'branching'"),
        ({"joints": JOINTS | {("leg", "tail"): ()}}, r"\('leg', 'tail'\) of 'branching': there is no node 'tail'"),
        ({"joints": JOINTS | {("tail", "torso"): ()}}, "there is no node 'tail'"),
        ({"joints": JOINTS | {("arm", "foot"): ()}}, "'foot' of 'branching' is the child of two joints"),
        ({"joints": JOINTS | {("foot", "torso"): ()}}, "Joints of 'branching' form a cycle at 'torso'"),
        ({"joints": JOINTS | {("torso", "torso"): ()}}, "form a cycle at 'torso'"),
        ({"actions": {("leg", "foot"): (1,)}}, r"Actions of 'branching' must be 0, 1, \.\.\. .*, got \[1\]"),
        ({"actions": {("leg", "foot"): (0, 0)}}, r"must be 0, 1, \.\.\. and each at one joint, got \[0, 0\]"),
        ({"actions": {("foot", "leg"): (0,)}}, r"at \[\('foot', 'leg'\)\], which are none of its joints"),
    ],
)
def test_what_does_not_fit_is_named(changes, message):
    with pytest.raises(ValueError, match=message):
        branching(**changes)


def test_a_description_makes_the_same_graph():
    for graph in (branching(identity=True), ObservationGraph.swimmer(4)):
        description = json.loads(json.dumps(graph.description()))
        again = ObservationGraph.from_description(description)
        assert str(again) == str(graph) and again.identity == graph.identity
        for table in ("node_entries", "global_entries", "node_actions", "edge_index"):
            np.testing.assert_array_equal(getattr(again, table), getattr(graph, table))


def test_a_description_may_leave_out_what_is_empty():
    described = ObservationGraph.swimmer(3).description()
    short = {key: value for key, value in described.items() if key != "identity"}
    assert str(ObservationGraph.from_description(short)) == str(ObservationGraph.swimmer(3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"nodes": None}, r"The mapping lacks \['nodes'\]; it needs \['name', .* may have \['globals',"),
        ({"global": []}, r"The mapping has unknown \['global'\]"),
        (
            {"joints": [["head", "segment_0"]]},
            r"Each of 'joints' must be \[parent body, .* got \['head', 'segment_0'\]",
        ),
        ({"actions": [["head", "segment_0", "01"]]}, "Each of 'actions' must be"),
        ({"joints": 2 * [["head", "segment_0", ["joints[0]"]]]}, r"'joints' name \['head', 'segment_0'\] twice"),
    ],
)
def test_a_description_that_does_not_fit_is_refused(changes, message):
    described = ObservationGraph.swimmer(3).description() | changes
    with pytest.raises(ValueError, match=message):
        ObservationGraph.from_description({key: value for key, value in described.items() if value is not None})
