"""Which links of an arm are in a volume of the world: exact, by the arm's convex collision shapes."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core.kinematics.arm import ArmKinematics
from roboxim_core.models.description import RobotModel
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.mesh_files import Stamp, file_stamp
from roboxim_core.poses import Pose


class LinkVolumes:
    """Collision shapes of an arm and its gripper. One call at a time computes: threads share `link_volumes`."""

    def __init__(self, model: RobotModel) -> None:
        """Load the shapes of the model's URDF.

        Raises:
            ConfigError: When the URDF lacks a joint or link that the model names.
        """
        import pinocchio as pin

        self._arm, self._lock = ArmKinematics(model), threading.Lock()
        whole = pin.buildModelFromUrdf(str(model.urdf))
        folders = [str(folder) for folder in model.urdf.resolve().parents]
        found = pin.buildGeomFromUrdf(whole, str(model.urdf), pin.GeometryType.COLLISION, package_dirs=folders)
        self._shapes: list[tuple[str, Any, Pose]] = []
        for item in found.geometryObjects:
            frame = whole.frames[item.parentFrame]
            shape = item.geometry
            if hasattr(shape, "buildConvexHull"):
                shape.buildConvexHull(True, "Qt")
                shape = shape.convex
            place = frame.placement.actInv(item.placement)
            self._shapes.append((frame.name, shape, Pose.from_arrays(place.translation, _rotation(place.rotation))))

    def inside(
        self, joints: npt.ArrayLike, fingers: Sequence[float], tcp: Pose, lower: npt.ArrayLike, upper: npt.ArrayLike
    ) -> set[str]:
        """Return the links that reach into a box of the world.

        Args:
            joints: Arm joint positions, shape (n,) [rad].
            fingers: Positions of the fingers' driven joints [m or rad].
            tcp: Pose of the tool centre point in the world, which says where the arm stands.
            lower: Least x, y, z of the box [m].
            upper: Greatest x, y, z of the box [m].
        """
        import coal

        low, high = np.asarray(lower, float), np.asarray(upper, float)
        box, middle = coal.Box(*(high - low).tolist()), coal.Transform3s(np.eye(3), (low + high) / 2)
        with self._lock:
            base = tcp @ self._arm.fk(joints).inverse()
            links = self._arm.link_poses(joints, fingers)
        found = set()
        for link, shape, place in self._shapes:
            if link not in found:
                pose = base @ links[link] @ place
                at = coal.Transform3s(pose.rotation.as_matrix(), np.array(pose.position))
                if coal.collide(shape, at, box, middle, coal.CollisionRequest(), coal.CollisionResult()):
                    found.add(link)
        return found


def link_volumes(robot: str) -> LinkVolumes:
    """Return the shapes of a robot of ``config/robots``, kept until its YAML file or URDF changes.

    Raises:
        ConfigError: When there is no such robot.
    """
    library = ModelLibrary()
    file, urdf = library.path("robots", robot), library.robot(robot).urdf
    return _volumes(file, (file_stamp(file), file_stamp(urdf)))


@lru_cache(maxsize=4)
def _volumes(file: Path, _stamp: Stamp) -> LinkVolumes:
    return LinkVolumes(ModelLibrary(file.parent.parent).robot(file.stem))


def _rotation(matrix: npt.ArrayLike) -> Any:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix)
