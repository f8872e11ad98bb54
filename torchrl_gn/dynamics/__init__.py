"""Forward models: weights, predictors of one scene, and what executes their steps."""

from torchrl_gn.dynamics.as_predictor import as_predictor as as_predictor
from torchrl_gn.dynamics.bound import BoundPredictor as BoundPredictor
from torchrl_gn.dynamics.bound import UnseenParameterWarning as UnseenParameterWarning
from torchrl_gn.dynamics.export import export_c as export_c
from torchrl_gn.dynamics.export import export_step as export_step
from torchrl_gn.dynamics.features import Actuators as Actuators
from torchrl_gn.dynamics.features import BodyState as BodyState
from torchrl_gn.dynamics.features import Canonicalizer as Canonicalizer
from torchrl_gn.dynamics.features import Contacts as Contacts
from torchrl_gn.dynamics.features import Controls as Controls
from torchrl_gn.dynamics.features import Feature as Feature
from torchrl_gn.dynamics.features import JointAxes as JointAxes
from torchrl_gn.dynamics.features import Joints as Joints
from torchrl_gn.dynamics.features import PairContacts as PairContacts
from torchrl_gn.dynamics.features import PhysicsChange as PhysicsChange
from torchrl_gn.dynamics.features import Wrenches as Wrenches
from torchrl_gn.dynamics.model import ForwardModel as ForwardModel
from torchrl_gn.dynamics.mujoco_physics import MujocoPhysics as MujocoPhysics
from torchrl_gn.dynamics.physics import ConstantVelocity as ConstantVelocity
from torchrl_gn.dynamics.physics import Physics as Physics
from torchrl_gn.dynamics.predictor import Predictor as Predictor
from torchrl_gn.dynamics.specialized import SpecializedPredictor as SpecializedPredictor
from torchrl_gn.dynamics.specialized import specialize as specialize
