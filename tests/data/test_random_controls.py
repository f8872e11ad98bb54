"""Random controls by actuator kind: scaled, reversing, around the current pose."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from torchrl_gn.data import Simulator, actuator_kind, random_controls, sample_start_states, spline_controls
from torchrl_gn.scenes import SceneError, load_scene

ARM = """
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body pos="0 0 1"><joint name="a" axis="0 0 1" damping="1" range="-170 170"/>
      <geom type="capsule" size=".05" fromto="0 0 0 .4 0 0"/>
      <body pos=".4 0 0"><joint name="b" axis="0 1 0" damping="1" range="-120 120"/>
        <geom type="capsule" size=".04" fromto="0 0 0 .3 0 0"/>
        <body pos=".3 0 0"><joint name="c" type="slide" axis="1 0 0" range="0 .2"/><geom size=".03"/>
          <body><joint name="d" axis="1 0 0" damping=".1"/><geom size=".03" pos="0 0 .1"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="a" joint="a" kp="200" kv="20" ctrlrange="-2.9 2.9"/>
    <general name="b" joint="b" gear="2" gainprm="300" biastype="affine" biasprm="60 -100 -10" ctrlrange="-1 1"/>
    <velocity name="c" joint="c" kv="50" ctrlrange="-.3 .2"/>
    <general name="d" joint="d" gainprm="2" biastype="affine" biasprm="0 0 -1" ctrlrange="-1 3"/>
  </actuator>
  <keyframe><key name="home" qpos="1 -.5 .1 0" ctrl="0 0 0 1"/></keyframe>
</mujoco>
"""


def test_kinds() -> None:
    model = load_scene(ARM).model
    assert [actuator_kind(model, actuator) for actuator in range(4)] == ["position", "position", "velocity", "motor"]
    assert {actuator_kind(load_scene("jaco").model, actuator) for actuator in range(9)} == {"velocity"}
    assert actuator_kind(load_scene("cheetah").model, 0) == "motor"


@pytest.fixture(scope="module")
def drawn() -> tuple[Simulator, np.ndarray, np.ndarray]:
    simulator = Simulator(load_scene(ARM), 1)
    physics = sample_start_states(simulator.scene, 300, 0)
    return simulator, physics, random_controls(simulator, physics, 200, 0)


def test_position_targets_hold_the_start_and_move_slowly(drawn) -> None:
    simulator, physics, controls = drawn
    scene = simulator.scene
    assert controls.shape == (300, 200, 4) and controls.dtype == np.float64
    assert (controls >= scene.action_low).all() and (controls <= scene.action_high).all()
    qpos = physics[:, 1:3]
    # Force: 200 (u - q), and 300 u + 60 - 100 (2 q).
    start = np.clip(np.stack([qpos[:, 0], (200 * qpos[:, 1] - 60) / 300], -1), [-2.9, -1], [2.9, 1])
    np.testing.assert_allclose(controls[:, 0, :2], start, atol=1e-12)
    speed = abs(np.diff(controls[..., :2], axis=1)).max(1) / scene.timestep
    limit = np.array([np.pi, 2.0])  # pi rad/s of the joint, and the width of the bounds a second
    assert (speed <= 1.0001 * limit).all() and (speed.max(0) > 0.6 * limit).all()
    assert (speed.mean(0) < 0.5 * limit).all()
    reach = np.ptp(controls[..., :2], axis=1)
    assert (reach.max(0) > 0.5 * np.array([5.8, 2])).all() and (reach.min(0) < 0.1 * np.array([5.8, 2])).all()


def test_the_speed_of_position_targets_is_a_factor(drawn) -> None:
    simulator, physics, controls = drawn
    other = random_controls(simulator, physics, 200, 0, target_speed=0.5)
    slow, full = (abs(np.diff(each[..., :2], axis=1)).max((0, 1)) for each in (other, controls))
    assert (slow <= 0.5001 * full).all() and (slow > 0.3 * full).all()
    np.testing.assert_array_equal(other[..., 2:], controls[..., 2:])
    free = random_controls(simulator, physics, 200, 0, target_speed=None)
    assert (abs(np.diff(free[..., :2], axis=1)).max((0, 1)) > 3 * full).all()
    for bad in (0, -1, np.inf, np.nan):
        with pytest.raises(ValueError, match="target_speed must be above 0 and finite"):
            random_controls(simulator, physics, 2, 0, target_speed=bad)


def test_servos_follow_without_flinging_the_arm(drawn) -> None:
    simulator, physics, controls = drawn
    physics, controls = physics[:40], controls[:40, :60]
    moved = simulator.rollout(physics, controls)
    assert moved["stable"].all()
    flung = simulator.rollout(physics, spline_controls(simulator.scene, 40, 60, 0))
    speed, before = (data["physics"][..., 5 + 1 : 5 + 2 + 1].abs() for data in (moved, flung))
    assert speed.max() < 8 and speed.max() < 0.4 * before.max()


def test_velocity_targets_reverse(drawn) -> None:
    _, _, controls = drawn
    target = controls[..., 2]
    assert target.min() > -0.3 - 1e-12 and target.max() < 0.2 + 1e-12
    sides = np.sign(target)
    reversals = (sides[:, 1:] != sides[:, :-1]).sum(1)
    assert (reversals >= 2).mean() > 0.97 and 4 < np.median(reversals) < 20
    assert abs(target).max(1).min() < 0.1 and abs(target).max(1).max() > 0.28


def test_motors_are_scaled_towards_the_keyframe(drawn) -> None:
    _, _, controls = drawn
    span = np.ptp(controls[..., 3], axis=1)
    assert span.min() < 0.35 * 4 and span.max() > 0.9 * 4
    calm = controls[span < 1.2, :, 3]
    assert calm.min() > -0.2 and calm.max() < 2.0  # 1 +- 0.4


def test_one_way_velocity_servos_and_short_sequences() -> None:
    scene = load_scene(ARM.replace('ctrlrange="-.3 .2"', 'ctrlrange=".1 .2"'))
    simulator, physics = Simulator(scene, 1), sample_start_states(scene, 20, 0)
    controls = random_controls(simulator, physics, 50, 0)[..., 2]
    assert controls.min() >= 0.1 and controls.max() <= 0.2 and np.ptp(controls) > 0.05
    for steps in (0, 1, 2):
        assert np.isfinite(random_controls(simulator, physics, steps, 0)).all()
    with pytest.raises(ValueError, match="knot_interval"):
        random_controls(simulator, physics, 3, 0, knot_interval=-1)


@pytest.mark.parametrize("name", ["jaco", "cheetah"])
def test_systems_of_the_paper_have_plain_splines(name: str) -> None:
    simulator = Simulator(load_scene(name), 1)
    controls = random_controls(simulator, sample_start_states(simulator.scene, 3, 0), 20, 7)
    np.testing.assert_array_equal(controls, spline_controls(simulator.scene, 3, 20, 7))


def test_each_variant_starts_from_its_own_pose() -> None:
    scenes = [
        load_scene(ARM),
        load_scene(ARM.replace('qpos="1 -.5', 'qpos="1 .5').replace('biasprm="60', 'biasprm="0')),
    ]
    simulator, variant = Simulator(scenes, 1), np.array([1, 0, 1])
    physics = np.concatenate([sample_start_states(scenes[which], 1, 0) for which in variant])
    controls = random_controls(simulator, physics, 5, 0, variant=variant)
    expected = (200 * physics[:, 2] - [0, 60, 0]) / 300
    np.testing.assert_allclose(controls[:, 0, 1], np.clip(expected, -1, 1), atol=1e-12)


def test_actions_without_bounds_are_named() -> None:
    scene = load_scene(ARM)
    scene = dataclasses.replace(scene, action_high=np.array([2.9, np.inf, 0.2, 3.0]))
    for draw in (
        lambda: random_controls(Simulator(scene, 1), sample_start_states(scene, 2, 0), 3, 0),
        lambda: spline_controls(scene, 2, 3, 0),
    ):
        with pytest.raises(SceneError, match=r"\['b'\] of scene 'arm' have no bounds .*action_bounds="):
            draw()
