"""The page's server: effects of buttons, sliders and switches, without a browser."""

from __future__ import annotations

import socket
import threading

import numpy as np
import pytest
import torch

import torchrl_gn as gn
from torchrl_gn.policies import StatePolicy
from torchrl_gn.scenes import load_scene
from torchrl_gn.viewer import Recording, Viewer
from torchrl_gn.viewer.acting import LivePolicy
from torchrl_gn.viewer.app import check_port

pytest.importorskip("viser", reason='the viewer needs viser: pip install "torchrl_gn[view]"')


@pytest.fixture
def view(scenes, make_model):
    """Make viewers on free ports, and stop them."""
    made = []

    def view(name: str, **options) -> Viewer:
        scene = scenes[name]
        made.append(Viewer(scene, make_model(scene).bind(scene), port=0, **options))
        return made[-1]

    yield view
    for each in made:
        each.close()


def press(viewer: Viewer, button: str) -> None:
    viewer.panel.asked.put(button)
    viewer.tick()


def place(viewer: Viewer, robot: str, node: int) -> np.ndarray:
    """World position of a node's frame as the page has it."""
    nodes = viewer._server.scene._handle_from_node_name
    return sum(nodes[name].position for name in ("/world", f"/world/{robot}", f"/world/{robot}/{node}"))


def test_buttons_step_and_reset(view):
    viewer = view("cheetah")
    start = viewer.world.moment
    viewer.tick()
    assert viewer.world.moment is start, "nothing runs while nobody looks"
    press(viewer, "Step")
    assert viewer.world.moment.time == pytest.approx(0.01) and not viewer.panel.running
    press(viewer, "Reset")
    assert viewer.world.moment.time == 0 and not torch.equal(viewer.world.moment.state, start.state)
    press(viewer, "Play")
    assert viewer.panel.running


def test_a_pause_brings_the_readings_up_to_the_picture(view):
    viewer = view("cheetah")
    viewer.tick()  # reads t = 0; while it runs, readings follow the picture only now and then
    viewer.world.step(viewer.world.random_action(), 0)
    viewer.tick()
    press(viewer, "Pause")
    assert "t = 0.01 s" in viewer.panel._reading.content


def test_sliders_are_the_controls(view):
    viewer = view("cheetah")
    viewer.panel.source.value = "sliders"
    values = np.linspace(-0.5, 0.5, 6)
    for slider, value in zip(viewer.panel.sliders, values, strict=True):
        slider.value = value
    press(viewer, "Step")
    np.testing.assert_allclose(viewer.world.moment.action, values)


def test_random_controls_move_the_sliders(view):
    viewer = view("cheetah")
    press(viewer, "Step")
    shown = [slider.value for slider in viewer.panel.sliders]
    np.testing.assert_allclose(shown, viewer.world.moment.action.clip(-1, 1))


def test_robots_stand_at_their_states_over_each_other_or_side_by_side(view):
    viewer = view("cheetah")
    for _ in range(3):
        press(viewer, "Step")
    moment = viewer.world.moment
    apart = place(viewer, "prediction", 3) - place(viewer, "truth", 3)
    np.testing.assert_allclose(apart, (moment.prediction - moment.state)[3, :3], atol=1e-6)
    mean = moment.state[1:, 0].mean()
    np.testing.assert_allclose(place(viewer, "truth", 3) - moment.state[3, :3].numpy(), [-mean, 0, 0], atol=1e-6)
    viewer.panel.beside.value = True
    viewer.tick()
    beside = place(viewer, "prediction", 3) - place(viewer, "truth", 3)
    assert np.linalg.norm(beside - apart) > viewer.picture.stage.radius
    viewer.panel.follow.value = viewer.panel.beside.value = False
    viewer.tick()
    np.testing.assert_allclose(place(viewer, "truth", 3), moment.state[3, :3], atol=1e-6)


def test_only_poses_are_sent_again(view, calls):
    viewer = view("cheetah")
    press(viewer, "Step")
    sent = calls(viewer._server._websock_server, "queue_message", lambda message: message)
    press(viewer, "Step")
    viewer.tick()
    kinds = {type(message).__name__ for message in sent}
    assert {"SetPositionMessage", "SetOrientationMessage"} <= kinds and "MeshMessage" not in kinds
    poses = [message for message in sent if type(message).__name__ == "SetPositionMessage"]
    assert len(poses) <= 2 * viewer.scene.num_nodes + 3


def test_every_switch_draws(view):
    viewer = view("cheetah")
    panel = viewer.panel
    for switch in (panel.contacts, panel.graph, panel.frames, panel.shadows, panel.ground, panel.predicted):
        switch.value = not switch.value
        press(viewer, "Step")
    nodes = viewer._server.scene._handle_from_node_name
    assert nodes["/world/graph_edges"].visible and nodes["/world/graph_nodes"].visible
    assert not nodes["/world/prediction"].visible and not nodes["/world/grid"].visible
    assert nodes["/world/truth/1"].show_axes
    edges = nodes["/world/graph_edges"].points
    assert edges.shape == (len(viewer.scene.pairs), 2, 3)


def test_a_planner_shows_its_plan(view):
    viewer = view("pendulum", task="balance")
    assert viewer.panel.source.value == "planner"
    press(viewer, "Step")
    nodes = viewer._server.scene._handle_from_node_name
    assert nodes["/world/plan_paths"].visible and nodes["/world/plan0"].visible
    assert viewer._plan.shape == (51, 2, 13)
    np.testing.assert_allclose(nodes["/world/plan3/1"].wxyz, viewer._plan[-1, 1, 3:7], atol=1e-6)
    viewer.panel.source.value = "random"
    press(viewer, "Step")
    assert not nodes["/world/plan_paths"].visible and not nodes["/world/plan0"].visible
    with pytest.raises(ValueError, match=r"no task 'dance' for scene 'pendulum'; there are \['balance'\]"):
        view("pendulum", task="dance")


def test_a_policy_chooses_the_controls_and_holds_them_for_its_own_step(view):
    slow = load_scene("cheetah", timestep=0.02)
    policy = StatePolicy(slow)
    viewer = view("cheetah", policy=policy)
    assert viewer.panel.source.value == "policy" and "planner" in viewer.panel.source.options
    actions, states = [], []
    for _ in range(5):
        states.append(viewer.world.moment.state)
        press(viewer, "Step")
        actions.append(viewer.world.moment.action)
    with torch.no_grad():
        expected = [policy.act(states[step][None])[0].double().numpy() for step in (0, 0, 2, 2, 4)]
    np.testing.assert_array_equal(actions, expected)
    viewer.panel.source.value = "random"
    press(viewer, "Step")
    viewer.panel.source.value = "policy"
    state = viewer.world.moment.state
    press(viewer, "Step")  # in the middle of a hold: nothing of before is held
    with torch.no_grad():
        np.testing.assert_array_equal(viewer.world.moment.action, policy.act(state[None])[0].double().numpy())
    with pytest.raises(ValueError, match="of scene .pendulum., whose bodies are not those of .cheetah."):
        LivePolicy(slow, StatePolicy(load_scene("pendulum")))
    with pytest.raises(ValueError, match="acts every 30 ms, no multiple of .* 20 ms"):
        LivePolicy(slow, StatePolicy(load_scene("cheetah", timestep=0.03)))
    with pytest.raises(ValueError, match="reads a target, which scene 'cheetah' does not have"):
        LivePolicy(slow, StatePolicy(slow, target=True))


def test_a_policy_of_the_suite_sees_its_target_and_is_paid():
    pytest.importorskip("dm_control")
    scene = load_scene("suite:reacher/easy")
    with Viewer(scene, policy=StatePolicy(scene, target=True), port=0) as viewer:
        target = viewer._policy.target
        press(viewer, "Step")
        assert viewer._reward in (0.0, 1.0)
        np.testing.assert_allclose(viewer.picture._target._handle.batched_positions, target[None], atol=1e-6)
        press(viewer, "Reset")
        assert not torch.equal(viewer._policy.target, target)


def test_recordings_play_seek_and_change(view, scenes):
    data = gn.collect_trajectories(scenes["pendulum"], 3, steps=6, seed=0)
    viewer = view("pendulum", recording=Recording({"test": data}))
    press(viewer, "Step")
    assert torch.equal(viewer.world.moment.state, data["state"][0, 1])
    viewer.panel.time.value = 5
    press(viewer, "seek")
    assert torch.equal(viewer.world.moment.state, data["state"][0, 5]) and viewer.world.moment.ahead == 5
    viewer.panel.number.value = 2
    viewer.tick()
    assert torch.equal(viewer.world.moment.state, data["state"][2, 0])
    for _ in range(8):
        press(viewer, "Step")
    assert torch.equal(viewer.world.moment.state, data["state"][2, 6]) and not viewer.panel.running
    press(viewer, "Restart")
    assert torch.equal(viewer.world.moment.state, data["state"][2, 0])
    assert not hasattr(viewer.panel, "task") and viewer.panel.sliders == []


def test_closing_ends_its_threads(view):
    before = set(threading.enumerate())
    viewer = view("pendulum")
    assert set(threading.enumerate()) - before
    viewer.close()
    assert not [thread for thread in set(threading.enumerate()) - before if not thread.daemon]
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", int(viewer.url.rpartition(":")[2])), timeout=1)


def test_a_port_that_is_taken_is_named():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=f"Cannot serve at 127.0.0.1, port {port}: .*Give another --port"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)
    with pytest.raises(OSError, match="must be from 0 to 65535"):
        check_port("127.0.0.1", 70_000)
