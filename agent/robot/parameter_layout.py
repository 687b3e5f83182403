"""Where the standard parameters of an arm stand in one vector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot.description import RobotDescription

#: Of one link, in Pinocchio's order: mass [kg], first moments [kg·m], inertia about the link's frame [kg·m²].
LINK_PARAMETERS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")


@dataclass(frozen=True)
class ParameterLayout:
    """p standard parameters: those of each link from base to tip, then one rotor inertia [kg·m², motor side] a drive.

    `links` and `rotors` are slices of the vector (p,).
    """

    n_links: int
    n_rotors: int

    @classmethod
    def of(cls, robot: RobotDescription, rotors: bool = True) -> ParameterLayout:
        """Of a serial arm: a link and, with `rotors`, a drive for each joint."""
        return cls(robot.dof, robot.dof if rotors else 0)

    @property
    def size(self) -> int:
        """p."""
        return self.rotors.stop

    @property
    def links(self) -> slice:
        """All links' parameters."""
        return slice(0, len(LINK_PARAMETERS) * self.n_links)

    @property
    def rotors(self) -> slice:
        """All rotor inertias."""
        return slice(self.links.stop, self.links.stop + self.n_rotors)

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) "m1", "mx1", …, "Izz6", "J1", …."""
        links = [f"{name}{link + 1}" for link in range(self.n_links) for name in LINK_PARAMETERS]
        return (*links, *(f"J{rotor + 1}" for rotor in range(self.n_rotors)))

    def link(self, link: int) -> slice:
        """The parameters of one link, counted from 0."""
        return slice(len(LINK_PARAMETERS) * link, len(LINK_PARAMETERS) * (link + 1))

    def blocks(self, standard: np.ndarray) -> np.ndarray:
        """(links, 10) the links' share of a vector (p,), or of one of links alone."""
        return np.asarray(standard)[self.links].reshape(self.n_links, len(LINK_PARAMETERS))


def about_centre(block: np.ndarray) -> np.ndarray:
    """(3, 3) inertia [kg·m²] about the centre of mass, from ten standard parameters about the link's frame."""
    mass, moment = block[0], block[1:4]
    xx, xy, yy, xz, yz, zz = block[4:]
    about_frame = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return about_frame - (moment @ moment * np.eye(3) - np.outer(moment, moment)) / mass
