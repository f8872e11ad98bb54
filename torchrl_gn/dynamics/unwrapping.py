"""Change of the unwrapped angles that states hold for joints that may make whole turns."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor
from torch.nn.functional import pad

from torchrl_gn.dynamics.joint_coordinates import JointCoordinates
from torchrl_gn.maths.float64_buffers import Float64Buffers

if TYPE_CHECKING:
    from torchrl_gn.dynamics.features.canonical_state import CanonicalState
    from torchrl_gn.scenes import Scene
    from torchrl_gn.scenes.physical_parameters import PhysicalParameters


class Unwrapping(Float64Buffers):
    """Change of a scene's unwrapped angles in a control step, extrapolated at the rates at its start.

    The extrapolation need only be right within half a turn: the next state's bodies give the exact angle up to whole
    turns (:class:`JointCoordinates`), so errors do not add up.
    """

    joint: Tensor
    place: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        held = scene.unwrapped
        self.timestep, self.joints = float(scene.timestep), int(scene.model.njnt)
        self.coordinates = JointCoordinates(scene, partly=True)
        self.constants({"joint": held.joint, "place": held.places(scene.num_nodes)})

    def forward(self, canonical: CanonicalState, parameters: PhysicalParameters) -> Tensor:
        """Return the change ``[*B, N, K]`` of the angles in canonical states."""
        state, matrices = canonical[:2]
        assert matrices is not None
        joint = parameters.joint[..., : 2 * self.joints : 2, :]
        joint_states = self.coordinates.joints(state, matrices, parameters.joint_pose, joint)
        after = joint_states.coordinate + self.timestep * joint_states.rate
        held = state[..., self.coordinates.node, self.coordinates.channel]
        return pad(after[..., self.joint] - held, (0, 1))[..., self.place]
