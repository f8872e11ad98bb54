"""Random MJCF models from a seed: most are valid, some are broken or unsupported on purpose."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

GEOMS = ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
DEFECTS = (
    *("unknown_element", "unknown_attribute", "nan", "inf", "zero_axis", "negative_mass", "massless", "nested_free"),
    *("no_such_joint", "no_such_site", "same_name", "bad_inertia", "missing_mesh", "empty_tendon", "huge", "no_joint"),
)


def random_mjcf(seed: int) -> str:
    """MJCF text of a random model of one to eight bodies."""
    return _Generator(np.random.default_rng(seed)).text()


class _Generator:
    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.root = Element("mujoco", model="random")
        self.joints: list[tuple[str, str]] = []  # name, type
        self.sites: list[str] = []
        self.bodies: list[str] = []
        self.geoms: list[tuple[str, str]] = []
        self.tendons: list[str] = []

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def choice(self, options):
        return options[int(self.rng.integers(len(options)))]

    def numbers(self, size: int, low: float = -1.0, high: float = 1.0) -> str:
        return " ".join(f"{value:.3g}" for value in self.rng.uniform(low, high, size))

    def span(self, scale: float = 1.0) -> str:
        low, high = sorted(self.rng.uniform(-scale, scale, 2))
        return f"{low:.3g} {high + 0.01:.3g}"

    def text(self) -> str:
        SubElement(self.root, "compiler", angle=self.choice(("radian", "degree")))
        self._options()
        assets = SubElement(self.root, "asset")
        SubElement(assets, "mesh", name="wedge", vertex="0 0 0  .3 0 0  0 .2 0  0 0 .1")
        world = SubElement(self.root, "worldbody")
        if self.chance(0.5):
            SubElement(world, "geom", name="floor", type="plane", size="5 5 .1")
        if self.chance(0.5):
            self._site(world)
        parents: list[tuple[Element, int]] = [(world, 0)]
        for _ in range(int(self.rng.integers(1, 9))):
            parent, depth = self.choice(parents)
            parents.append((self._body(parent, depth), depth + 1))
        for _ in range(int(self.rng.integers(0, 3))):
            self._tendon()
        for _ in range(int(self.rng.integers(0, 3))):
            self._equality()
        self._contacts()
        for _ in range(int(self.rng.integers(0, 6))):
            self._actuator()
        if self.chance(0.2):
            SubElement(SubElement(self.root, "sensor"), "framepos", objtype="body", objname=self.bodies[0])
        if self.chance(0.2):
            self._break(self.choice(DEFECTS))
        ElementTree.indent(self.root)
        return ElementTree.tostring(self.root, encoding="unicode")

    def _options(self) -> None:
        option = SubElement(self.root, "option", timestep=self.choice(("0.001", "0.002", "0.005")))
        option.set("integrator", self.choice(("Euler", "RK4", "implicit", "implicitfast")))
        option.set("cone", self.choice(("pyramidal", "elliptic")))
        if self.chance(0.3):
            option.set("gravity", self.numbers(3, -10, 10))
        if self.chance(0.3):
            option.set("density", self.numbers(1, 0, 1000))
            option.set("viscosity", self.numbers(1, 0, 1))
            option.set("wind", self.numbers(3))
        flags = [flag for flag in ("contact", "equality", "gravity", "limit", "clampctrl") if self.chance(0.08)]
        SubElement(option, "flag", {flag: "disable" for flag in flags})

    def _body(self, parent: Element, depth: int) -> Element:
        body = SubElement(parent, "body", pos=self.numbers(3, -0.5, 0.5))
        name = f"body_{len(self.bodies)}"
        self.bodies.append(name)
        body.set("name", name)
        if self.chance(0.5):
            body.set("quat", self.numbers(4, 0.1, 1))
        if depth == 0 and self.chance(0.05):
            body.set("mocap", "true")
        else:
            self._joints(body, depth)
        for _ in range(int(self.rng.integers(1, 3))):
            self._geom(body)
        if self.chance(0.1):
            SubElement(body, "inertial", pos=self.numbers(3, -0.1, 0.1), mass=self._mass(), diaginertia=".02 .015 .01")
        for _ in range(int(self.rng.integers(0, 3))):
            self._site(body)
        return body

    def _joints(self, body: Element, depth: int) -> None:
        kinds = {
            "free": 2.0 if depth == 0 else 0.0,
            "ball": 1.5,
            "hinge": 5.0,
            "slide": 1.5,
            "hinge hinge": 1.0,
            "slide hinge": 1.0,
            "slide slide hinge": 0.5,
            "hinge hinge hinge": 0.5,
            "slide ball": 0.3,
            "": 1.0,
        }
        weights = np.array(list(kinds.values()))
        chosen = str(self.rng.choice(list(kinds), p=weights / weights.sum()))
        for kind in chosen.split():
            name = f"joint_{len(self.joints)}"
            self.joints.append((name, kind))
            joint = SubElement(body, "joint", name=name, type=kind)
            if self.chance(0.05):
                del joint.attrib["name"]
                self.joints.pop()
            if kind == "free":
                continue
            if kind != "ball":
                joint.set("axis", self.choice(("1 0 0", "0 1 0", "0 0 1", self.numbers(3, 0.1, 1))))
            if self.chance(0.3):
                joint.set("pos", self.numbers(3, -0.2, 0.2))
            if self.chance(0.4):
                joint.set("range", f"0 {self.numbers(1, 0.1, 1)}" if kind == "ball" else self.span())
            for name, scale in (("stiffness", 20), ("damping", 2), ("armature", 0.5), ("frictionloss", 0.3)):
                if self.chance(0.3):
                    joint.set(name, self.numbers(1, 0, scale))
            if kind != "ball" and self.chance(0.2):
                joint.set("ref", self.numbers(1, -0.3, 0.3))

    def _mass(self) -> str:
        return f"{10 ** self.rng.uniform(-6, 4):.3g}" if self.chance(0.15) else self.numbers(1, 0.1, 3)

    def _geom(self, body: Element) -> None:
        kind, name = self.choice(GEOMS), f"geom_{len(self.geoms)}"
        self.geoms.append((name, kind))
        geom = SubElement(body, "geom", name=name, type=kind)
        if kind == "mesh":
            geom.set("mesh", "wedge")
        elif kind == "capsule" and self.chance(0.5):
            geom.set("fromto", self.numbers(6, -0.3, 0.3))
            geom.set("size", self.numbers(1, 0.02, 0.1))
        else:
            sizes = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
            geom.set("size", self.numbers(sizes[kind], 0.02, 0.2))
            geom.set("pos", self.numbers(3, -0.2, 0.2))
        if self.chance(0.4):
            geom.set("mass", self._mass())
        if self.chance(0.3) and not geom.get("fromto"):
            geom.set("quat", self.numbers(4, 0.1, 1))
        if self.chance(0.3):
            geom.set("contype", "0")
            geom.set("conaffinity", "0")
        if self.chance(0.2):
            geom.set("condim", self.choice(("1", "3", "4", "6")))
        if self.chance(0.1):
            geom.set("fluidshape", "ellipsoid")

    def _site(self, body: Element) -> None:
        self.sites.append(f"site_{len(self.sites)}")
        site = SubElement(body, "site", name=self.sites[-1], pos=self.numbers(3, -0.3, 0.3))
        if self.chance(0.5):
            site.set("quat", self.numbers(4, 0.1, 1))

    def _scalar_joints(self) -> list[str]:
        return [name for name, kind in self.joints if kind in ("hinge", "slide")]

    def _tendon(self) -> None:
        section = self.root.find("tendon")
        section = SubElement(self.root, "tendon") if section is None else section
        name, scalar = f"tendon_{len(self.tendons)}", self._scalar_joints()
        round_geoms = [geom for geom, kind in self.geoms if kind in ("sphere", "cylinder")]
        if scalar and self.chance(0.5):
            tendon = SubElement(section, "fixed", name=name)
            for joint in self.rng.choice(scalar, min(len(scalar), int(self.rng.integers(1, 4))), replace=False):
                SubElement(tendon, "joint", joint=str(joint), coef=self.numbers(1))
        elif len(self.sites) >= 2:
            tendon = SubElement(section, "spatial", name=name)
            path = list(self.rng.choice(self.sites, min(len(self.sites), int(self.rng.integers(2, 5))), replace=False))
            if len(path) >= 4 and self.chance(0.5):
                self._path(tendon, path[:2], round_geoms)
                SubElement(tendon, "pulley", divisor="2")
                path = path[2:]
            self._path(tendon, path, round_geoms)
        else:
            return
        self.tendons.append(name)
        for attribute, scale in (("stiffness", 20), ("damping", 2), ("frictionloss", 0.2)):
            if self.chance(0.3):
                tendon.set(attribute, self.numbers(1, 0, scale))
        if self.chance(0.2):
            tendon.set("range", f"0 {self.numbers(1, 0.1, 2)}")

    def _path(self, tendon: Element, sites: list[str], geoms: list[str]) -> None:
        for index, site in enumerate(sites):
            SubElement(tendon, "site", site=str(site))
            if geoms and index + 1 < len(sites) and self.chance(0.3):
                SubElement(tendon, "geom", geom=self.choice(geoms))

    def _equality(self) -> None:
        section = self.root.find("equality")
        section = SubElement(self.root, "equality") if section is None else section
        kind, scalar = self.choice(("connect", "weld", "joint", "tendon")), self._scalar_joints()
        element = None
        if kind in ("connect", "weld") and len(self.sites) >= 2 and self.chance(0.4):
            first, second = self.rng.choice(self.sites, 2, replace=False)
            element = SubElement(section, kind, site1=str(first), site2=str(second))
        elif kind in ("connect", "weld"):
            element = SubElement(section, kind, body1=self.choice(self.bodies), anchor=self.numbers(3, -0.2, 0.2))
            others = [body for body in self.bodies if body != element.get("body1")]
            if others and self.chance(0.7):
                element.set("body2", self.choice(others))
        elif kind == "joint" and len(scalar) >= 2:
            first, second = self.rng.choice(scalar, 2, replace=False)
            element = SubElement(section, "joint", joint1=str(first), joint2=str(second), polycoef="0 0.5 0 0 0")
        elif kind == "tendon" and self.tendons:
            element = SubElement(section, "tendon", tendon1=self.choice(self.tendons))
        if element is not None and self.chance(0.2):
            element.set("active", "false")

    def _contacts(self) -> None:
        section = SubElement(self.root, "contact")
        if len(self.bodies) >= 2 and self.chance(0.3):
            first, second = self.rng.choice(self.bodies, 2, replace=False)
            SubElement(section, "exclude", body1=str(first), body2=str(second))
        if len(self.geoms) >= 2 and self.chance(0.2):
            first, second = self.rng.choice(len(self.geoms), 2, replace=False)
            SubElement(section, "pair", geom1=self.geoms[first][0], geom2=self.geoms[second][0])

    def _actuator(self) -> None:
        section = self.root.find("actuator")
        section = SubElement(self.root, "actuator") if section is None else section
        kind = self.choice(("motor", "motor", "position", "velocity", "general", "damper", "adhesion"))
        if self.chance(0.06):
            kind = self.choice(("muscle", "intvelocity", "cylinder", "filter", "delay"))
        target = self._target(kind)
        if not target:
            return
        settings = {
            "position": {"kp": self.numbers(1, 0.1, 10)},
            "velocity": {"kv": self.numbers(1, 0.01, 1)},
            "damper": {"kv": self.numbers(1, 0.01, 1), "ctrlrange": "0 1"},
            "adhesion": {"gain": self.numbers(1, 0.1, 10), "ctrlrange": "0 1"},
            "general": {
                "gainprm": self.numbers(1, -3, 3),
                "biastype": self.choice(("none", "affine")),
                "biasprm": self.numbers(3),
            },
            "filter": {"dyntype": "filter", "dynprm": "0.1"},
            "delay": {"delay": "0.01", "nsample": "9"},
            "intvelocity": {"actrange": "-1 1"},
            "muscle": {"lengthrange": "0.1 1"},  # MuJoCo would look for it, which can take minutes
        }.get(kind, {})
        tag = {"filter": "general", "delay": "motor"}.get(kind, kind)
        actuator = SubElement(section, tag, target | settings, name=f"actuator_{len(section)}")
        if kind != "adhesion" and self.chance(0.6):
            actuator.set("gear", self.numbers(self.choice((1, 6)), -2, 2))
        if "ctrlrange" not in settings and kind != "muscle" and self.chance(0.7):
            actuator.set("ctrlrange", self.span())
        if kind in ("motor", "position", "general") and self.chance(0.3):
            actuator.set("forcerange", self.span())

    def _target(self, kind: str) -> dict[str, str]:
        if kind == "adhesion":
            return {"body": self.choice(self.bodies)}
        choices = []
        if self.joints:
            choices += [{"joint": self.choice(self.joints)[0]}] * 3
            choices.append({"jointinparent": self.choice(self.joints)[0]})
        if self.tendons:
            choices += [{"tendon": self.choice(self.tendons)}] * 2
        if self.sites:
            choices += [{"site": self.choice(self.sites)}] * 2
        if len(self.sites) >= 2:
            first, second = map(str, self.rng.choice(self.sites, 2, replace=False))
            choices += [{"site": first, "refsite": second}]
            if kind in ("motor", "general"):
                choices += [{"cranksite": first, "slidersite": second, "cranklength": "0.3"}]
        return self.choice(choices) if choices else {}

    def _break(self, defect: str) -> None:
        body = self.root.find(".//body")
        assert body is not None
        joint, geom = body.find("joint"), body.find("geom")
        match defect:
            case "unknown_element":
                SubElement(body, "gem", size="1")
            case "unknown_attribute":
                body.set("colour", "red")
            case "nan" | "inf" if joint is not None:
                joint.set("damping", defect)
            case "zero_axis" if joint is not None and joint.get("type") != "free":
                joint.set("axis", "0 0 0")
            case "negative_mass" if geom is not None:
                geom.set("mass", "-1")
            case "massless":
                for each in body.findall("geom"):
                    each.set("mass", "0")
            case "nested_free":
                inner = SubElement(body, "body", name="nested")
                SubElement(inner, "joint", name="nested", type="free")
                SubElement(inner, "geom", size=".1")
            case "no_such_joint":
                section = SubElement(self.root, "actuator")
                SubElement(section, "motor", name="lost", joint="nowhere", ctrlrange="-1 1")
            case "no_such_site":
                section = SubElement(self.root, "actuator")
                SubElement(section, "motor", name="lost", site="nowhere", ctrlrange="-1 1")
            case "same_name":
                SubElement(body, "geom", name="twice", size=".1")
                SubElement(body, "geom", name="twice", size=".1")
            case "bad_inertia":
                for each in body.findall("inertial"):
                    body.remove(each)
                SubElement(body, "inertial", pos="0 0 0", mass="1", diaginertia="1 0.1 0.1")
            case "missing_mesh" if geom is not None:
                geom.set("type", "mesh")
                geom.set("mesh", "nowhere")
            case "empty_tendon":
                SubElement(SubElement(self.root, "tendon"), "fixed", name="empty")
            case "huge" if geom is not None:
                geom.set("mass", "1e300")
            case "no_joint":
                for each in self.root.iter("body"):
                    for one in each.findall("joint"):
                        each.remove(one)
