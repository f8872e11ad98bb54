"""Joined bodies, and the anchors of their joints."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes import SYSTEMS, load_scene

XML = """
<mujoco><worldbody>
  <body name="arm" pos="0 0 1">{}<geom size=".1"/>
    <body name="tip" pos=".3 0 0" euler="0 0 40">{}<geom size=".1"/></body>
  </body>
</worldbody></mujoco>"""
HINGE, BALL = '<joint axis="0 1 0" pos=".05 0 0"/>', '<joint type="ball" pos="0 .1 0"/>'
SLIDE, FREE = '<joint type="slide" axis="1 0 0"/>', "<freejoint/>"

CASES = {
    "hinges": (HINGE, HINGE, [0, 0, 0]),
    "free and ball": (FREE, BALL, [0, 1, 1]),
    "slide below": (HINGE, SLIDE, [0, 0, 2]),
    "slide and hinge": (HINGE, SLIDE + HINGE, [0, 0, 2]),
    "two hinges, one point": (FREE, HINGE + '<joint axis="1 0 0" pos=".05 0 0"/>', [0, 1, 1]),
    "two hinges, two points": (FREE, HINGE + '<joint axis="1 0 0"/>', [0, 1, 2]),
}


@pytest.mark.parametrize("case", CASES)
def test_mechanisms_of_small_models(case):
    upper, lower, roots = CASES[case]
    assert load_scene(XML.format(upper, lower)).joint_anchors.root.tolist() == roots


@pytest.mark.parametrize("source", [*SYSTEMS, "swimmer3", *(XML.format(u, b) for u, b, _ in CASES.values())])
def test_pins_are_at_one_place_on_both_bodies(source):
    scene = load_scene(source)
    joint_anchors, model = scene.joint_anchors, scene.model
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(3):
        data.qpos[:] = model.qpos0 + rng.normal(size=model.nq)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        position, frame = data.xpos[scene.body], data.xmat[scene.body].reshape(-1, 3, 3)
        upper = position[joint_anchors.parent] + np.einsum(
            "nij,nj->ni", frame[joint_anchors.parent], joint_anchors.parent_anchor
        )
        lower = position + np.einsum("nij,nj->ni", frame, joint_anchors.child_anchor)
        np.testing.assert_allclose(upper, lower, atol=1e-12)
        # A chain leads from the root to its node.
        along = joint_anchors.ancestors @ (lower - position - (upper - position[joint_anchors.parent]))
        np.testing.assert_allclose(position[joint_anchors.root] - along, position, atol=1e-12)
