"""State maths: quaternions, state layouts, normalisers, matrix precision."""

from torchrl_gn.maths import quaternion as quaternion
from torchrl_gn.maths.normalizer import Normalizer as Normalizer
from torchrl_gn.maths.precision import fast_matmul as fast_matmul
from torchrl_gn.maths.state_layout import BODY_STATE as BODY_STATE
from torchrl_gn.maths.state_layout import Component as Component
from torchrl_gn.maths.state_layout import StateLayout as StateLayout
from torchrl_gn.maths.state_layout import joint_layout as joint_layout
