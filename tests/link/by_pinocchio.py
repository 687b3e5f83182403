"""Where the NS16's flange is, by Pinocchio on the URDF: kinematics that neither planner nor emulator has."""

import numpy as np
import pinocchio

from agent.robot import load_robot

ROBOT = load_robot("comau_ns16")
START = np.radians([5.0, 10.0, -95.0, 10.0, 40.0, 0.0])
MODEL = pinocchio.buildModelFromXML(ROBOT.urdf)
DATA = MODEL.createData()


def flange(q: np.ndarray) -> pinocchio.SE3:
    pinocchio.framesForwardKinematics(MODEL, DATA, q)
    return DATA.oMf[MODEL.getFrameId(ROBOT.tip_frame)].copy()
