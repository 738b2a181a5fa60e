"""The inputs of `roboxim robot new` besides a URDF: the mount of the gripper, and limits that a URDF lacks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.poses import Vec3

NAME_PATTERN = r"[a-z][a-z0-9_]*"


@dataclass(frozen=True, kw_only=True)
class RobotRecipe:
    """How a robot is derived from somebody's URDF. A YAML file, or the options of `roboxim robot new`."""

    name: str
    """Id of the robot: lower-case letters, digits and ``_``."""
    urdf: str = ""
    """URDF or MJCF file; relative to the recipe, or ``package:DISTRIBUTION/PATH`` in an installed wheel."""
    arm: str = ""
    """Robot of ``config/robots`` whose arm gets another gripper, instead of a URDF. Its limits and meshes are kept."""
    title: str = ""
    """What it is, for the comment of its file, e.g. ``Franka Research 3``."""
    source: str = ""
    """Where the URDF comes from, with version and licence."""
    base: str = ""
    """Root link of the arm; empty: the root of the URDF. What lies above it is left out."""
    base_xyz: Vec3 = (0.0, 0.0, 0.0)
    """Where the arm's base stands in the robot's base frame [m]. A small arm stands closer to the things and higher,
    on a pillar, while areas and poses of tasks stay those of every arm."""
    flange: str = ""
    """Link that the gripper is mounted on; empty: the last one. What lies beyond it is left out."""
    without: tuple[str, ...] = ()
    """Links fixed beside the chain to leave out, with what hangs on them, e.g. fingers on the palm below the flange."""
    gripper: str = "franka_hand"
    """Gripper of ``config/grippers``."""
    mount_xyz: Vec3 = (0.0, 0.0, 0.0)
    """Position of the gripper in the flange; with ``arm``, in the place of that robot's own gripper [m]."""
    mount_rpy: Vec3 = (0.0, 0.0, 0.0)
    """Rotation of the gripper in the flange: z out of the flange, y along the opening [rad]."""
    velocity: tuple[float, ...] = ()
    """Joint speeds [rad/s]; one number: of all joints; empty: the URDF's."""
    effort: tuple[float, ...] = ()
    """Joint torques [N m]; one number: of all joints; empty: the URDF's."""
    acceleration: tuple[float, ...] = ()
    """Joint accelerations [rad/s^2], which a URDF does not have; one number: of all joints."""
    jerk: tuple[float, ...] = ()
    """Joint jerks [rad/s^3]; empty: the acceleration is reached in 50 ms."""
    range_rad: float = 6.283185307179586
    """Largest range of a joint [rad]; wider and continuous joints are cut to it, so that no search winds the arm up."""
    home: tuple[float, ...] = ()
    """Joint positions at home [rad]; empty: searched for, with the tool above the table's middle."""
    collision_m: float = 0.002
    """How far a convex collision part may reach beyond the mesh's hull [m]. A coarser part has fewer faces and loads
    faster; 0: the hull itself."""
    cover: bool = False
    """Make the collision parts of the visual meshes, where the file's collision shapes leave much of them uncovered."""
    start: tuple[float, ...] = ()
    """Box in which tasks start the tool of an arm that is too small for theirs, see `RobotModel.start` [m]."""
    triangles: int = 1200
    """Triangles of a link's visual mesh. The renderer draws a coarse shape of a link with more faces than pixels."""

    def __post_init__(self) -> None:
        """Check what one value says about another.

        Raises:
            ConfigError: When one is missing or out of range.
        """
        for name in ("base_xyz", "mount_xyz", "mount_rpy"):
            if len(given := getattr(self, name)) != 3:
                raise ConfigError(f"{name}: expected 3 numbers, got {len(given)}")
        if bool(self.urdf) == bool(self.arm):
            raise ConfigError(
                "expected either urdf, a file to derive an arm from, or arm, a robot of config/robots that gets "
                f"another gripper; got {'both' if self.urdf else 'neither'}"
            )
        if self.collision_m < 0.0:
            raise ConfigError(f"collision_m must be at least 0, got {self.collision_m}")
        if self.arm:
            taken = ("base", "base_xyz", "flange", "without", "velocity", "effort", "acceleration", "jerk", "cover")
            if given := [name for name in taken if _states(getattr(self, name))]:
                raise ConfigError(f"{', '.join(given)}: with arm they are those of '{self.arm}'; leave them out")
            return
        if not self.acceleration:
            raise ConfigError(
                "a URDF has no joint accelerations: give them from the maker's data sheet "
                "(acceleration: [rad/s^2 of each joint], or --acceleration with one number for all joints)"
            )
        for name in ("velocity", "effort", "acceleration", "jerk"):
            if any(value <= 0.0 for value in getattr(self, name)):
                raise ConfigError(f"{name} must be greater than 0, got {list(getattr(self, name))}")


def _states(value: bool | str | tuple[float | str, ...]) -> bool:
    return any(value) if isinstance(value, tuple) else bool(value)


def spread(values: tuple[float, ...], joints: int, name: str) -> tuple[float, ...]:
    """Return a value for each joint.

    Raises:
        ConfigError: When there is neither one value nor one for each joint.
    """
    if len(values) not in (1, joints):
        raise ConfigError(f"{name}: expected 1 or {joints} numbers, one for each joint of the arm, got {len(values)}")
    return values * joints if len(values) == 1 else values


def source_file(urdf: str, folder: Path) -> Path:
    """Return the file that a recipe's ``urdf`` names.

    Args:
        urdf: Path, or ``package:DISTRIBUTION/PATH``.
        folder: Folder that a path is relative to.

    Raises:
        ConfigError: When the distribution or the file is missing.
    """
    if not urdf.startswith("package:"):
        path = (folder / urdf).resolve()
    else:
        from importlib import metadata

        name, _, inner = urdf.removeprefix("package:").partition("/")
        try:
            path = Path(str(metadata.distribution(name).locate_file(inner)))
        except metadata.PackageNotFoundError:
            raise ConfigError(f"{urdf}: the distribution '{name}' is not installed: pip install {name}") from None
    if not path.is_file():
        raise ConfigError(f"no such URDF: {path}")
    return path
