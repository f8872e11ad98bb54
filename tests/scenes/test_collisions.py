"""Geoms that can collide are those that MuJoCo finds in contact where all geoms overlap."""

import mujoco
import numpy as np
import pytest

from torchrl_gn.scenes.collisions import colliding_geoms

MODEL = """<mujoco><option><flag {flags}/></option><worldbody>
  <geom type="plane" size="1 1 1"/><geom size=".1"/>
  <body name="root"><freejoint/><geom size=".1"/><geom size=".1" contype="2" conaffinity="4"/>
    <body name="welded"><geom size=".1"/>
      <body name="child"><joint/><geom size=".1"/><geom size=".1" contype="0" conaffinity="1"/>
        <body name="grandchild"><joint/><geom name="tip" size=".1"/></body></body></body></body>
  <body name="other"><freejoint/><geom name="other" size=".1"/><geom size=".1" contype="4" conaffinity="0"/></body>
  <body name="fixed"><geom size=".1"/><body name="hinged"><joint/><geom size=".1"/></body></body>
  <body name="hand" mocap="true"><geom size=".1"/><body name="finger"><joint/><geom size=".1"/></body></body>
</worldbody><contact>
  <exclude body1="other" body2="root"/><exclude body1="grandchild" body2="world"/>
  <exclude body1="other" body2="grandchild"/>
  <pair geom1="tip" geom2="other"/>
</contact></mujoco>"""


@pytest.mark.parametrize("flags", ["", 'filterparent="disable"', 'contact="disable"', 'constraint="disable"'])
def test_as_mujoco(flags):
    model = mujoco.MjModel.from_xml_string(MODEL.format(flags=flags))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    colliding = colliding_geoms(model)
    found = np.zeros_like(colliding)
    found[tuple(data.contact.geom.reshape(-1, 2).T)] = True
    np.testing.assert_array_equal(colliding, found | found.T)
