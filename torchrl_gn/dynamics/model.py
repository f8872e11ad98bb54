"""Forward model: one set of weights that predicts a control step of any scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Literal, get_args

from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_gn.dynamics.features.contacts import Contacts
from torchrl_gn.maths.normalizer import Normalizer
from torchrl_gn.maths.state_layout import BODY_STATE, Component, Encoding, StateLayout
from torchrl_gn.networks.ablated_core import AblatedCore, UnfoldedCore
from torchrl_gn.networks.folded_gn_core import FoldedCore
from torchrl_gn.networks.gn_block import Pool
from torchrl_gn.networks.gn_core import GNCore
from torchrl_gn.networks.graph import Graph, GraphSize
from torchrl_gn.networks.incidence import Incidence
from torchrl_gn.networks.mlp_core import FoldedMLP, MLPCore
from torchrl_gn.networks.recurrent_core import RecurrentCore
from torchrl_gn.scenes.parameter_names import ParameterNames
from torchrl_gn.scenes.physical_parameters import PhysicalParameters

if TYPE_CHECKING:
    from torchrl_gn.dynamics.predictor import Predictor
    from torchrl_gn.scenes import Scene

Static = Literal["none", "scene", "inferred"]
CoreKind = Literal[
    "gn", "recurrent", "mlp", "interaction_network", "no_edge_update", "no_node_update", "no_global_update"
]

# Spreads below this are rounding noise of the simulator (metres, m/s, quaternion entries ...).
_DYNAMIC_FLOOR = 1e-9
# Bodies this many spreads from all that training saw are shown as if they were that far only.
_STATIC_LIMIT = 20.0


class ForwardModel(nn.Module):
    """Graph-network forward model (paper, "Forward models", SM "Forward prediction algorithm").

    Holds everything that is learned: the core's weights and the normalisers. It
    knows no scene; :meth:`bind` joins it to one and gives the TensorDict module
    that predicts. Any number of scenes can be bound to the same weights.

    Args:
        features: static features that the model reads, see :meth:`ParameterNames.of`.
        parameters: ``"scene"`` reads the true physical parameters, ``"none"`` none of them, ``"inferred"`` a graph that
            another network makes instead, with features as they are.
        inferred: numbers of node, edge and global features of the inferred graph. With ``link`` nodes get six more: how
            far joint anchors were found from where the scene has them.
        layout: what the state's channels mean.
        encoding: how the network sees an orientation: as the entries of its rotation
            ``"matrix"`` or (paper) as the ``"quaternion"``.
        integrate: predict position and orientation as what their rates do not explain
            (trapezoidal rule); the paper predicts the whole change.
        joint_axes: show the network each joint's axis in the frame of the positions and the control along
            it, so that it need not learn to turn them; the paper shows the control alone.
        contacts: show the network how far each body's points are from the plane that they can touch, and
            how they move, so that it need not compute that; the paper shows it positions alone.
        controls: how many controls act at a joint; several only without ``joint_axes``.
        recenter: make the prediction independent of where a translation-invariant scene
            is (paper: on for single systems, off when several train together).
        positions: show the network where bodies are along axes of translation invariance. Where joints joint anchor all
            bodies together orientations tell it too, and a network without positions is at home in scenes larger
            than those it was trained on.
        align: make the prediction independent of how a rotation-invariant scene is turned
            (:attr:`Scene.yaw_frame <torchrl_gn.scenes.Scene>`); the paper does not.
        link: keep bodies that joints joint anchor together together: of the predicted positions and
            velocities only those of each joint_anchors as a whole are used, the rest follows
            from the orientations and angular velocities. The paper lets bodies drift apart.
        core: ``"gn"``, two graph networks; ``"recurrent"``, these with a hidden state
            (:class:`~torchrl_gn.networks.RecurrentCore`); their rival ``"mlp"``, one MLP over the flattened
            graph (paper, SM "MLP baseline architectures"); or what they are without one of their parts
            (:class:`~torchrl_gn.networks.AblatedCore`; paper, SM Figure "Ablation study of the architecture"):
            ``"interaction_network"``, ``"no_edge_update"``, ``"no_node_update"`` or ``"no_global_update"``.
        skip: whether the second graph network also reads what the first read.
        pool: whether globals see the ``"sum"`` (paper) of all nodes and edges or their ``"mean"``.
        hidden_state: numbers of node, edge and global features that a recurrent core remembers.
        latent: features of the graph between the two GN blocks.
        edge_hidden: hidden sizes of the edge MLPs.
        node_hidden: hidden sizes of the node MLPs.
        global_hidden: hidden sizes of the global MLP.
        mlp_hidden: hidden sizes of the rival.
        items: numbers of nodes and edges of the only graphs that the rival can read.
        activation: between the layers: ``"silu"``, ``"gelu"``, ``"tanh"`` or (paper) ``"relu"``.

    Raises:
        ValueError: if an option is none of its choices, the rival lacks ``items``, or ``skip=False`` means nothing.
    """

    def __init__(
        self,
        features: ParameterNames,
        *,
        parameters: Static = "scene",
        inferred: Sequence[int] = (10, 10, 10),
        layout: StateLayout = BODY_STATE,
        encoding: Encoding = "matrix",
        integrate: bool = True,
        joint_axes: bool = True,
        contacts: bool = True,
        controls: int = 1,
        recenter: bool = True,
        positions: bool = True,
        align: bool = True,
        project: bool = True,
        core: CoreKind = "gn",
        skip: bool = True,
        pool: Pool = "sum",
        hidden_state: Sequence[int] = (20, 20, 20),
        latent: int = 128,
        edge_hidden: Sequence[int] = (128, 128),
        node_hidden: Sequence[int] = (128, 128),
        global_hidden: Sequence[int] = (128, 128),
        mlp_hidden: Sequence[int] = (256, 256, 256, 256, 256),
        items: Sequence[int] | None = None,
        activation: str = "silu",
    ) -> None:
        super().__init__()
        for name, value, choices in (
            ("parameters", parameters, Static),
            ("encoding", encoding, Encoding),
            ("core", core, CoreKind),
        ):
            if value not in get_args(choices):
                raise ValueError(f"{name}={value!r} is not known; use one of {list(get_args(choices))}.")
        if not skip and core in ("recurrent", "mlp"):
            raise ValueError(f"skip=False is for two graph networks; core={core!r} cannot do without. Leave skip out.")
        self.features = features if parameters == "scene" else ParameterNames()
        self.parameter_source, self.layout = parameters, layout
        self.encoding: Encoding = encoding
        self.integrate, self.joint_axes = integrate, joint_axes
        self.contacts = contacts
        self.recenter, self.positions, self.align, self.project = recenter, positions, align, project
        self.options = {
            "parameters": parameters,
            "inferred": list(inferred),
            "encoding": encoding,
            "integrate": integrate,
            "joint_axes": joint_axes,
            "contacts": contacts,
            "controls": controls,
            "recenter": recenter,
            "positions": positions,
            "align": align,
            "project": project,
            "core": core,
            "skip": skip,
            "pool": pool,
            "hidden_state": list(hidden_state),
            "latent": latent,
            "edge_hidden": list(edge_hidden),
            "node_hidden": list(node_hidden),
            "global_hidden": list(global_hidden),
            "mlp_hidden": list(mlp_hidden),
            "items": None if items is None else list(items),
            "activation": activation,
        }

        encoded = layout.encoded_size(encoding) + (Contacts.size if contacts else 0)
        names = self.features
        self.inferred_size = GraphSize(*inferred)
        if parameters == "inferred":
            # Where joint anchors were found says how long bodies are.
            self.static_size = self.inferred_size + GraphSize(6 if project else 0, 0, 0)
        else:
            self.static_size = GraphSize(len(names.nodes), len(names.edges), len(names.globals_))
        self.node_normalizer = Normalizer(encoded, floor=_DYNAMIC_FLOOR)
        if joint_axes and controls != 1:
            raise ValueError(f"joint_axes=True takes one control at each joint, not controls={controls}.")
        self.dynamic_size = GraphSize(encoded, 7 if joint_axes else controls, 0)
        self.edge_normalizer = Normalizer(self.dynamic_size.edges, floor=_DYNAMIC_FLOOR)
        self.parameter_node_normalizer = Normalizer(self.static_size.nodes, limit=_STATIC_LIMIT)
        self.parameter_edge_normalizer = Normalizer(self.static_size.edges, limit=_STATIC_LIMIT)
        self.parameter_global_normalizer = Normalizer(self.static_size.globals_, limit=_STATIC_LIMIT)
        # The network's output has the residual's scale; errors are weighed by the whole change's.
        self.residual_normalizer = Normalizer(layout.delta_size, floor=_DYNAMIC_FLOOR)
        self.delta_normalizer = Normalizer(layout.delta_size, floor=_DYNAMIC_FLOOR)
        in_size, out = self.dynamic_size + self.static_size, layout.delta_size
        self.core: GNCore | RecurrentCore | MLPCore | AblatedCore
        if core == "mlp":
            if items is None:
                raise ValueError("core='mlp' needs items, the numbers of nodes and edges of its scene.")
            nodes, edges = items
            self.core = MLPCore(in_size, out, items=(nodes, edges), hidden=mlp_hidden, activation=activation)
            return
        hidden = {"edge_hidden": edge_hidden, "node_hidden": node_hidden, "global_hidden": global_hidden}
        sizes: dict[str, Any] = {"latent": latent, "activation": activation, "pool": pool, **hidden}
        if core == "recurrent":
            self.core = RecurrentCore(self.dynamic_size, self.static_size, out, hidden_state=hidden_state, **sizes)
        elif core == "gn" and skip:
            self.core = GNCore(in_size, out, **sizes)
        else:
            ablation = "none" if core == "gn" else core
            self.core = AblatedCore(in_size, out, ablation=ablation, skip=skip, **sizes)

    @property
    def parameter_normalizers(self) -> dict[str, Normalizer]:
        """Normalisers of static features, by the part of the graph that has them."""
        return {
            "nodes": self.parameter_node_normalizer,
            "edges": self.parameter_edge_normalizer,
            "globals_": self.parameter_global_normalizer,
        }

    @property
    def fitted(self) -> bool:
        """Whether the normalisers of all that the model reads and predicts have seen data. Waits for the device."""
        read = [self.node_normalizer, self.edge_normalizer, self.residual_normalizer, self.delta_normalizer]
        if self.parameter_source == "scene":  # an inferred graph is read as it is
            read += self.parameter_normalizers.values()
        return all(normalizer.fitted for normalizer in read)

    def values_of(self, scene: Scene) -> PhysicalParameters:
        """What the model reads of a scene; zeros where it reads an inferred graph.

        Raises:
            ValueError: if the scene lacks features that the model reads.
        """
        values = self.features.select(scene)
        if self.parameter_source != "inferred":
            return values
        zeros = {
            part: getattr(values, part).new_zeros(*getattr(values, part).shape[:-1], size)
            for part, size in asdict(self.inferred_size).items()
        }
        return values._replace(**zeros)

    def bind(
        self,
        scene: Scene,
        *,
        strict: bool = False,
        plain: bool = False,
        parameters_key: NestedKey | None = None,
        static_features: ParameterNames | None = None,
    ) -> Predictor:
        """Join these weights to a scene.

        Args:
            scene: any scene with the features the model reads.
            strict: refuse, instead of warning, a scene with a value that training never saw
                in a feature that never varied.
            plain: evaluate the core as the paper writes it, slowly: the reference for all that is faster.
            parameters_key: where each sample has its own physical parameters (a variant's, or inferred); None: all have the
                scene's.
            static_features: names of the static features that samples bring there, a data set's ``features``, from
                which the model takes its own by name. Default: all that the scene has, as samples of this version of
                the library bring them.

        Returns:
            TensorDict module ``state, action -> ("next", "state")`` that shares these weights.

        Raises:
            ValueError: if the scene, or what samples bring, lacks features that the model reads; or with ``strict``.
        """
        from torchrl_gn.dynamics.predictor import Predictor
        from torchrl_gn.dynamics.recurrent_predictor import RecurrentPredictor

        kind = RecurrentPredictor if isinstance(self.core, RecurrentCore) else Predictor
        options = {
            "strict": strict,
            "plain": plain,
            "parameters_key": parameters_key,
            "static_features": static_features,
        }
        return kind(self, scene, **options)

    def fold(self, parameters: Graph, incidence: Incidence) -> FoldedCore | FoldedMLP | UnfoldedCore:
        """The core for one scene, differentiable in the weights.

        Args:
            parameters: normalised static graph.
            incidence: of the scene, and which of its nodes are predicted: those that move.
        """
        return self.core.fold(self.dynamic_size, incidence, parameters)

    def forward(self, dynamic: Graph, folded: FoldedCore | FoldedMLP | UnfoldedCore) -> Tensor:
        """Predicted residual change, in SI units.

        Args:
            dynamic: normalised dynamic graph ``[*B, ...]``.
            folded: what :meth:`fold` gave for the scene.

        Returns:
            ``[*B, N, delta_size]``, for predicted nodes.
        """
        return self.residual_normalizer.inverse(folded.predict(dynamic))

    def description(self) -> dict:
        """Everything needed to build this model again, as plain JSON-able values."""
        return {"features": asdict(self.features), "layout": asdict(self.layout), "options": self.options}

    @classmethod
    def from_description(cls, description: dict) -> ForwardModel:
        """Build the model that :meth:`description` described, with fresh weights."""
        features = ParameterNames.from_names(description["features"])
        layout = StateLayout(tuple(Component(**component) for component in description["layout"]["components"]))
        return cls(features, layout=layout, **description["options"])
