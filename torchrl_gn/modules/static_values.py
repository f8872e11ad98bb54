"""The numbers that a model reads of its scene, and of samples that bring their own."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey

from torchrl_gn.modules.float64_buffers import Float64Buffers
from torchrl_gn.scenes.scene_values import SceneValues

if TYPE_CHECKING:
    from torchrl_gn.scenes import Scene

_INFERRED = ("nodes", "edges", "globals_")
_PINS = ("parent_arm", "arm")


class StaticValues(Float64Buffers):
    """What a bound model reads of lengths, masses, ...: its scene's, its samples', or what was inferred of them.

    Args:
        own: the scene's, as the model reads them.
        kind: the model's option ``static``: ``"scene"``, ``"none"`` or ``"inferred"``.
        key: where samples bring their own; None: they are the scene's.
        linked: whether the model links bodies, for which it needs their pins.
        scene: the scene.
    """

    def __init__(self, own: SceneValues, kind: str, key: NestedKey | None, *, linked: bool, scene: Scene) -> None:
        super().__init__()
        self.kind, self.key, self.scene = kind, key, scene
        self.inferred = (*_INFERRED, *_PINS) if linked else _INFERRED
        self.constants(own._asdict())

    @property
    def own(self) -> SceneValues:
        """The scene's own, without batch."""
        return SceneValues(*(getattr(self, name) for name in SceneValues._fields))

    def entries(self) -> TensorDict:
        """What a sample of the scene itself brings, without batch; zeros of an inferred graph."""
        own = self.own.tensordict()
        return own.select(*self.inferred) if self.kind == "inferred" else own

    def read(self, static: TensorDictBase | None) -> SceneValues:
        """Numbers that samples bring, or the scene's own.

        Raises:
            ValueError: if the model infers its static graph and they are true parameters, or pins are missing.
        """
        if static is None:
            return self.own
        if self.kind == "inferred":
            given, wanted = set(map(str, static.keys())), set(self.inferred)
            if given - wanted:
                raise ValueError(
                    f"The model reads an inferred static graph; {sorted(given - wanted)} are true"
                    " parameters, which it must not see. Give what an inference model wrote."
                )
            if not set(_PINS) & wanted <= given:
                raise ValueError(
                    f"The model links bodies where an inference model finds their pins; {sorted(wanted - given)} are"
                    " missing. Give what this model's own inference model wrote."
                )
        return SceneValues.read(static, self.own)

    def find(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """The static values that samples bring; None where they are the scene's own.

        Of a model that does not read the true static parameters nothing of the samples' own scenes gets here.

        Raises:
            KeyError: if the model reads them and they are missing.
            ValueError: if the model does not read them and they are not its scene's.
        """
        static = tensordict.get("static" if self.key is None else self.key, None)
        if self.key is not None:
            if self.kind == "none":
                return None
            if static is None:
                raise KeyError(
                    f"The model reads each sample's static values at {self.key!r}; give static_of(scene),"
                    " or bind without static_key."
                )
            return static
        if isinstance(static, TensorDictBase):
            self._refuse_others(static)
        return None

    def _refuse_others(self, static: TensorDictBase) -> None:
        for name, own in self.own._asdict().items():
            given = static.get(name, None)
            if given is None:
                continue
            if given.shape[-1] != own.shape[-1]:  # all features of a scene, not only those that the model reads
                own = getattr(SceneValues.of(self.scene), name).to(own.device)
            alike = given.shape[-1] == own.shape[-1]
            if alike and bool((given.to(own.device) - own).abs().le(1e-6 * own.abs() + 1e-12).all()):
                continue
            raise ValueError(
                f"Samples have other static {name!r} than scene {self.scene.name!r}, which the model is bound to."
                " Bind it with static_key='static' to predict variants of the scene."
            )
