"""Smoke test of an installed wheel without extras: ``python .ci/smoke.py VERSION``, from outside the checkout."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

import torch

import torchrl_gn as gn

POLE = """
<mujoco>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0 0 1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" gear="5" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


def main(version: str) -> None:
    """Train for two steps and predict in C++; raise AssertionError for a wrong version, place, executor or number."""
    place = Path(gn.__file__)
    assert Path(__file__).resolve().parents[1] not in place.parents, f"{place} was imported, not the wheel."
    found = {gn.__version__, metadata.version("torchrl_gn")}
    assert found == {version}, f"The wheel is of version {found}, not {version}."
    assert "swimmer6" in gn.pretrained_names(), "The wheel lacks the trained models."
    scene = gn.load_scene(POLE)
    true = gn.collect_trajectories(scene, 10, seed=0)
    model = gn.ForwardModel.for_scene(scene, hidden=16).bind(scene)
    gn.fit(model, true, steps=2, progress=False)
    fast = gn.specialize(model)
    assert fast.reason is None, f"The model runs by torch: {fast.reason}"  # no compiler, or sources are missing
    with torch.no_grad():
        predicted, _ = fast.step(true["state"][:, 0], true["action"][:, 0])
        reference, _ = model.step(true["state"][:, 0], true["action"][:, 0])
    torch.testing.assert_close(predicted, reference, rtol=1e-4, atol=1e-4)
    print(f"{place.parent}, version {version}: two steps of training, and a prediction in C++ as by torch.")


if __name__ == "__main__":
    main(sys.argv[1])
