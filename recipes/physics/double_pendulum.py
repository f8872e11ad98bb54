"""Rigid-body physics of a torque-driven double pendulum with motors at both joints, for ``physics=`` of real_robot.py.

    physics=recipes/physics/double_pendulum.py:DoublePendulum "physics_options={parameters: identified.yml}"

Equations and names of the double pendulum of DFKI's Underactuated Lab (design C): angles from hanging down, the second
relative to the first link; viscous and Coulomb friction, geared motors with rotor inertia.
"""

from __future__ import annotations

from pathlib import Path

import torch
import yaml
from torch import Tensor, nn

from torchrl_gn.scenes import KinematicTree

SLOPE = 100.0  # of Coulomb friction against velocity, arctan(100 v), s / rad


class DoublePendulum(nn.Module):
    """One control step of the double pendulum, by the Runge-Kutta method of order 4.

    Args:
        tree: the robot.
        parameters: YAML file of m1, m2 [kg], l1, l2, r1, r2 [m], I1, I2, Ir [kg m^2], gr, b1, b2 [N m s / rad], cf1,
            cf2 [N m], g [m / s^2].
        trained: whether to train factors on inertias, gravity torques, friction and commands with the network.
    """

    def __init__(self, tree: KinematicTree, parameters: str, trained: bool = False) -> None:
        super().__init__()
        self.timestep = tree.timestep
        p = {name: float(value) for name, value in yaml.safe_load(Path(parameters).read_text()).items()}
        rotor = p["gr"] ** 2 * p["Ir"]
        values = {
            "inertia1": p["I1"] + p["m2"] * p["l1"] ** 2 + rotor + p["Ir"],
            "inertia2": p["I2"],
            "rotor2": rotor,
            "rotor12": p["gr"] * p["Ir"],
            "coupling": p["m2"] * p["l1"] * p["r2"],
            "gravity1": p["g"] * (p["m1"] * p["r1"] + p["m2"] * p["l1"]),
            "gravity2": p["g"] * p["m2"] * p["r2"],
            "viscous1": p["b1"],
            "viscous2": p["b2"],
            "coulomb1": p["cf1"],
            "coulomb2": p["cf2"],
            "slope": SLOPE,
            "motor1": 1.0,
            "motor2": 1.0,
        }
        self.names = tuple(values)
        self.register_buffer("identified", torch.tensor(list(values.values()), dtype=torch.float64), persistent=False)
        self.logarithm = nn.Parameter(torch.zeros(len(values), dtype=torch.float64), requires_grad=trained)

    identified: Tensor

    def acceleration(self, angle: Tensor, velocity: Tensor, torque: Tensor, value: dict[str, Tensor]) -> Tensor:
        """Return joint accelerations ``[*B, 2]``, rad/s^2."""
        first, second = angle[..., 0], angle[..., 1]
        v1, v2 = velocity[..., 0], velocity[..., 1]
        coupled, gravity = value["coupling"] * second.cos(), value["gravity2"] * (first + second).sin()
        m12 = value["inertia2"] + coupled - value["rotor12"]
        m11 = value["inertia1"] + value["inertia2"] + 2 * coupled
        m22 = value["inertia2"] + value["rotor2"]
        bend = value["coupling"] * second.sin()
        friction1 = value["viscous1"] * v1 + value["coulomb1"] * (value["slope"] * v1).atan()
        friction2 = value["viscous2"] * v2 + value["coulomb2"] * (value["slope"] * v2).atan()
        f1 = value["motor1"] * torque[..., 0] + bend * (2 * v1 * v2 + v2 * v2) - friction1
        f1 = f1 - value["gravity1"] * first.sin() - gravity
        f2 = value["motor2"] * torque[..., 1] - bend * v1 * v1 - friction2 - gravity
        determinant = m11 * m22 - m12 * m12
        return torch.stack(((m22 * f1 - m12 * f2) / determinant, (m11 * f2 - m12 * f1) / determinant), dim=-1)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """Return the next state ``[*B, 3, 3]`` (cosine, sine, velocity) under torques ``[*B, 2]``."""
        scaled = (self.identified * self.logarithm.exp()).to(state.dtype)
        value = dict(zip(self.names, scaled.unbind(), strict=True))
        joints, step = state[..., 1:, :], self.timestep
        angle, velocity = torch.atan2(joints[..., 1], joints[..., 0]), joints[..., 2]
        stages, at, rate = [], angle, velocity
        for share in (0.5, 0.5, 1.0, 0.0):
            stages.append((rate, self.acceleration(at, rate, action, value)))
            at, rate = angle + share * step * stages[-1][0], velocity + share * step * stages[-1][1]
        (a1, b1), (a2, b2), (a3, b3), (a4, b4) = stages
        angle = angle + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        velocity = velocity + step / 6 * (b1 + 2 * b2 + 2 * b3 + b4)
        moved = torch.stack((angle.cos(), angle.sin(), velocity), dim=-1)
        return torch.cat((state[..., :1, :], moved), dim=-2)
