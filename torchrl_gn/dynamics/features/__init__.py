"""Input features of the network, one per file.

Your own feature subclasses :class:`~torchrl_gn.dynamics.features.feature.Feature`. Add it to :data:`FEATURES` before
you save or load a checkpoint with it.
"""

from torchrl_gn.dynamics.features.activations import Activations as Activations
from torchrl_gn.dynamics.features.actuators import Actuators as Actuators
from torchrl_gn.dynamics.features.body_state import BodyState as BodyState
from torchrl_gn.dynamics.features.canonical_state import Canonicalizer as Canonicalizer
from torchrl_gn.dynamics.features.canonical_state import CanonicalState as CanonicalState
from torchrl_gn.dynamics.features.constraints import Constraints as Constraints
from torchrl_gn.dynamics.features.contacts import Contacts as Contacts
from torchrl_gn.dynamics.features.controls import Controls as Controls
from torchrl_gn.dynamics.features.couplings import Couplings as Couplings
from torchrl_gn.dynamics.features.feature import Feature as Feature
from torchrl_gn.dynamics.features.feature import StepInputs as StepInputs
from torchrl_gn.dynamics.features.feature import graph_edges as graph_edges
from torchrl_gn.dynamics.features.joint_axes import JointAxes as JointAxes
from torchrl_gn.dynamics.features.joints import Joints as Joints
from torchrl_gn.dynamics.features.mocap_poses import MocapPoses as MocapPoses
from torchrl_gn.dynamics.features.pair_contacts import PairContacts as PairContacts
from torchrl_gn.dynamics.features.pair_contacts import trees_can_touch as trees_can_touch
from torchrl_gn.dynamics.features.physics_change import PhysicsChange as PhysicsChange
from torchrl_gn.dynamics.features.tendons import Tendons as Tendons
from torchrl_gn.dynamics.features.world_contacts import WorldContacts as WorldContacts
from torchrl_gn.dynamics.features.world_contacts import contacts_of as contacts_of
from torchrl_gn.dynamics.features.wrenches import Wrenches as Wrenches

FEATURES: dict[str, type[Feature]] = {
    "activations": Activations,
    "actuators": Actuators,
    "body_state": BodyState,
    "constraints": Constraints,
    "contact_pairs": PairContacts,
    "contacts": Contacts,
    "controls": Controls,
    "couplings": Couplings,
    "joint_axes": JointAxes,
    "joints": Joints,
    "mocap_poses": MocapPoses,
    "physics_change": PhysicsChange,
    "tendons": Tendons,
    "world_contacts": WorldContacts,
    "wrenches": Wrenches,
}
"""Features by their names in checkpoints."""
