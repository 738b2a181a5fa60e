"""Find the defects of an object's file before an episode does.

An error makes an object unusable; a warning points at a probable mistake. Every built-in object passes without either.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from roboxim_core.config import load_config
from roboxim_core.errors import ConfigError
from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.bounds import links_bounds, shape_bounds
from roboxim_core.models.description import GraspAnnotation, ObjectModel, Shape, Visual
from roboxim_core.models.hulls import load_mesh
from roboxim_core.models.mesh_files import mesh_references
from roboxim_core.models.object_config import ObjectConfig
from roboxim_core.models.urdf import urdf_root
from roboxim_core.models.visuals import visual_parts
from roboxim_core.poses import Array, Pose
from roboxim_core.vision.renderer import TriangleMesh
from roboxim_core.vision.textures import pixels

LARGEST_M, SMALLEST_M = 1.5, 0.004
"""Limits of an object's longest side [m]; beyond them the file probably uses another unit."""
DENSITIES = (15.0, 12_000.0)
"""Plausible densities, from foam to heavy metal [kg/m^3]."""
SMALLEST_INERTIA = 1e-7
"""Smallest stable inertia: below it, contacts make an object jitter at 240 Hz [kg m^2]."""
MANY_TRIANGLES = 5000
"""Number of triangles above which rendering without a GPU becomes slow."""
FAR_M = 0.01
"""Largest distance between the visual and the collision surface, at 98 of 100 sampled points [m]."""
FIXTURE_KG = 10.0
"""Mass from which an object is a fixture of a scene, which nothing picks up [kg]."""
SAMPLES = 3000
TOUCHING_M = 0.002
"""Gap below which two collision shapes count as touching [m]."""
PAD_HALF_M = 0.01
"""Half the width and length of a finger's pad [m]."""
GRIP_SLACK_M = 0.012
"""How much wider than annotated a grasped part may be on either side, where an object bends or tapers [m]."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A defect of an object."""

    severity: str
    """``error`` or ``warning``."""
    message: str
    """What is wrong, what was expected, what to do."""


def check_object(file: Path, max_opening_m: float = 0.08) -> tuple[tuple[Finding, ...], ObjectModel | None]:
    """Check an object's YAML file and every file that it names.

    Args:
        file: The YAML file.
        max_opening_m: Total opening of the gripper that must grasp the object [m].

    Returns:
        The findings, errors first, and the object without modifiers (none if it cannot be loaded).
    """
    found: list[Finding] = []
    try:
        config = load_config(file, ObjectConfig)
        found += [f for path, scale in _mesh_files(config, file.parent) for f in check_mesh(path, scale)]
        if config.urdf:
            found += _urdf_inertias(file.parent / config.urdf)
        model = config.resolved(file.parent).model(file.stem, file.parent)
    except ConfigError as error:
        if not any(f.severity == "error" and f.message in str(error) for f in found):
            found.append(_error(str(error)))
        return _sorted(found), None
    try:
        found += [*_masses(model, config), *_extents(model, config), *_textures(model)]
        if not any(f.severity == "error" for f in found):
            solid = _outside(model)
            found += [*_grasps(model, solid, max_opening_m), *_likeness(model, solid)]
    except ConfigError as error:  # e.g. a shape that is too thin to have a volume
        found.append(_error(str(error)))
    return _sorted(found), model


def check_mesh(path: Path, scale: float = 1.0) -> list[Finding]:
    """Check a mesh file.

    Args:
        path: The file.
        scale: Factor on its coordinates.
    """
    if not path.is_file():
        return [_error(f"cannot read the mesh {path}: no such file; paths are relative to the YAML file's folder")]
    found = _missing_images(path)
    try:
        mesh = load_mesh(path)
    except ConfigError as error:
        return [*found, _error(str(error))]
    size = np.ptp(mesh.bounds, axis=0) * scale
    longest = float(size.max())
    size_text = " x ".join(f"{v:.3g}" for v in size)
    if longest > LARGEST_M:
        found.append(
            _error(
                f"{path.name} would be {size_text} m large: its units look like millimetres; give it a scale of 0.001"
            )
        )
    elif longest < SMALLEST_M:
        found.append(_error(f"{path.name} would be {size_text} m large, too small to grasp; give it a larger scale"))
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not mesh.is_watertight:
        found.append(_warning(f"{path.name} is not watertight: close its holes; otherwise some sides look transparent"))
    elif mesh.volume < 0:
        found.append(_warning(f"{path.name} is inside out: flip its faces; otherwise it is invisible from outside"))
    if len(mesh.faces) > MANY_TRIANGLES:
        found.append(
            _warning(
                f"{path.name} has {len(mesh.faces)} triangles, which makes rendering without a GPU slow; "
                f"`roboxim assets simplify {path.name}` gives it fewer (about 1500 are enough at 256 x 256 pixels)"
            )
        )
    return found


def _error(message: str) -> Finding:
    return Finding(severity="error", message=message)


def _warning(message: str) -> Finding:
    return Finding(severity="warning", message=message)


def _sorted(found: list[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(dict.fromkeys(found), key=lambda finding: finding.severity != "error"))


def _mesh_files(config: ObjectConfig, folder: Path) -> list[tuple[Path, float]]:
    """Return the meshes that the object's file names, with their scales; a URDF's meshes are found when it is read."""
    files = [(config.mesh, config.mesh_scale)]
    links = config.links
    if config.urdf:
        try:
            links = config.resolved(folder).links
        except ConfigError:
            return []
    for link in links:
        files += [(shape.mesh, shape.scale) for shape in link.collision]
        files += [(visual.mesh, max(map(abs, visual.scale))) for visual in link.visual]
    return list(dict.fromkeys(((folder / name).resolve(), scale) for name, scale in files if name))


def _missing_images(path: Path) -> list[Finding]:
    """Return the missing files that an OBJ or glTF names; the readers of other formats report them themselves."""
    kinds = {".mtl": "material file", ".bin": "buffer"}
    return [
        _error(f"{path.name} needs the {kinds.get(file.suffix, 'texture')} {name}: no such file")
        for name, file in mesh_references(path).items()
        if not file.is_file()
    ]


def _urdf_inertias(path: Path) -> list[Finding]:
    try:
        root = urdf_root(path)
    except ConfigError:
        return []  # loading the file reports the reason
    found = []
    for link in root.findall("link"):
        element = link.find("inertial/inertia")
        if element is None:
            continue
        try:
            xx, yy, zz, xy, xz, yz = (
                float(element.get(name, 0.0)) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
            )
        except ValueError as error:
            found.append(_error(f"link '{link.get('name')}': <inertia> must have numbers: {error}"))
            continue
        if not np.isfinite([xx, yy, zz, xy, xz, yz]).all():
            found.append(_error(f"link '{link.get('name')}': <inertia> must have finite numbers"))
            continue
        low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if low <= 0 or low + middle < high * (1 - 1e-6):
            found.append(
                _warning(
                    f"link '{link.get('name')}' has an impossible inertia ({low:.2g}, {middle:.2g}, {high:.2g}); "
                    "the inertia of its collision shapes is used instead"
                )
            )
    return found


def _masses(model: ObjectModel, config: ObjectConfig) -> list[Finding]:
    found = []
    for link in model.links:
        name = f"link '{link.name}'" if link.name else "the object"
        if link.mass <= 0:
            how = "`<inertial><mass value=.../></inertial>` in the URDF" if config.urdf else "`mass`"
            found.append(_error(f"{name} has no mass: give it {how} in kilograms"))
            continue
        if not link.collision:
            found.append(_error(f"{name} has a mass but no collision shape, hence no inertia: give it `collision`"))
            continue
        density = link.mass / sum(_volume(shape) for shape in link.collision)
        if not DENSITIES[0] <= density <= DENSITIES[1]:
            found.append(
                _warning(
                    f"{name} weighs {link.mass:g} kg, a density of {density:.3g} kg/m^3: masses are in kilograms "
                    f"(expected {DENSITIES[0]:g} to {DENSITIES[1]:g} kg/m^3)"
                )
            )
        bounds = np.array([shape_bounds(shape) for shape in link.collision])
        a, b, _ = np.sort(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0))
        inertia = link.mass * (a**2 + b**2) / 12
        if inertia < SMALLEST_INERTIA:
            found.append(
                _warning(
                    f"{name} has an inertia of only {inertia:.1e} kg m^2 about its long axis and will jitter: make its "
                    "collision shapes thicker or its mass larger"
                )
            )
    return found


def _volume(shape: Shape) -> float:
    if shape.kind == "hull":
        return float(_planes(shape)[1])
    if shape.kind == "box":
        return float(np.prod(shape.size))
    if shape.kind == "sphere":
        return float(4 / 3 * np.pi * shape.size[0] ** 3)
    radius, length = shape.size
    return float(np.pi * radius**2 * (length + (4 / 3 * radius if shape.kind == "capsule" else 0.0)))


def _extents(model: ObjectModel, config: ObjectConfig) -> list[Finding]:
    try:
        low, high = links_bounds(model.links, model.joints)
    except ValueError:
        return []
    found = []
    rest = -float(low[2])
    if config.rest_height is not None and abs(model.rest_height - rest) > 1e-3:
        found.append(
            _error(
                f"rest_height is {model.rest_height:g} but the collision shapes reach {rest:.4g} m below the base: it "
                f"would float or sink; leave rest_height out, or give {rest:.4g}"
            )
        )
    x, y, _ = 2 * np.maximum(-low, high)
    size = (float(x), float(y), float(high[2] - low[2]))
    if config.size is not None and np.abs(np.subtract(model.size, size)).max() > 2e-3:
        size_text = ", ".join(f"{value:.4g}" for value in size)
        found.append(
            _error(f"size is {list(model.size)} but the shapes' is [{size_text}]; remove size, or set it to that")
        )
    return found


def _textures(model: ObjectModel) -> list[Finding]:
    found = []
    for link in model.links:
        for visual in link.visual:
            try:
                for part in visual_parts(visual):
                    pixels(part.material.texture)
            except ConfigError as error:
                found.append(_error(str(error)))
            except OSError as error:
                found.append(_error(f"cannot read a texture: {error}"))
    return found


def _grasps(model: ObjectModel, points: Array, max_opening_m: float) -> list[Finding]:
    grasps = [*model.grasps, *(grasp for handle in model.handles for grasp in handle.grasps)]
    fixture = sum(link.mass for link in model.links) >= FIXTURE_KG
    if not grasps and not fixture and not {"support", "pressable", "flippable"} & set(model.affordances):
        return [_warning("no grasps: nothing can pick it up; give it `grasps` and the affordance graspable")]
    if model.grasps and "graspable" not in model.affordances:
        return [_warning("has grasps but not the affordance graspable: no task will pick it up")]
    return [finding for grasp in grasps for finding in _grasp(grasp, model, points, max_opening_m)]


def _grasp(grasp: GraspAnnotation, model: ObjectModel, points: Array, max_opening_m: float) -> list[Finding]:
    if not 0 < grasp.width_m < max_opening_m:
        return [
            _error(f"grasp '{grasp.name}': width_m is {grasp.width_m:g}, but the gripper opens to {max_opening_m:g} m")
        ]
    tcp = object_link_poses(model, {})[grasp.link or model.links[0].name] @ grasp.pose
    local = tcp.inverse().apply(points)
    reach_m = min(grasp.opening_m, max_opening_m) / 2
    between = local[(np.abs(local) < (PAD_HALF_M, reach_m, PAD_HALF_M)).all(axis=1)]
    if not len(between):
        return [_error(f"grasp '{grasp.name}' closes on nothing: its pose must be the tool centre point in the object")]
    if (reach := np.abs(between[:, 1]).max()) > grasp.width_m / 2 + GRIP_SLACK_M:
        return [
            _warning(
                f"grasp '{grasp.name}' closes on something that reaches {1e3 * reach:.0f} mm from its middle, but "
                f"width_m is {1e3 * grasp.width_m:.0f} mm"
            )
        ]
    return []


def _likeness(model: ObjectModel, solid: Array) -> list[Finding]:
    """Compare the visual with the collision surface at points sampled on both."""
    from scipy.spatial import KDTree

    seen, _ = _samples(model, seen=True)
    poses = object_link_poses(model, {})
    loose = np.ones(len(seen), dtype=bool)
    for link in model.links:
        for shape in link.collision:
            loose &= ~_inside(seen, shape, poses[link.name])
    solids, seens = KDTree(solid), KDTree(seen)
    beyond = float(np.quantile(np.where(loose, solids.query(seen)[0], 0.0), 0.98))
    empty = float(np.quantile(seens.query(solid)[0], 0.98))
    # Points sampled on one surface are as far apart as the samples are spaced.
    scatter = [float(np.quantile(tree.query(tree.data, k=2)[0][:, 1], 0.98)) for tree in (seens, solids)]
    found = []
    if empty > FAR_M + scatter[0]:
        found.append(
            _warning(
                f"the collision shapes fill up to {1e3 * empty:.0f} mm that look empty (a hull fills every cavity): "
                "give several hulls, primitives or rings instead"
            )
        )
    if beyond > FAR_M + scatter[1]:
        found.append(_warning(f"up to {1e3 * beyond:.0f} mm of the visual have no collision shape: add shapes there"))
    return found


def _outside(model: ObjectModel) -> Array:
    """Return points on the outer collision surface in the base frame, shape (N, 3) [m]."""
    points, owners = _samples(model, seen=False)
    poses = object_link_poses(model, {})
    outside = np.ones(len(points), dtype=bool)
    shapes = [(poses[link.name], shape) for link in model.links for shape in link.collision]
    for number, (pose, shape) in enumerate(shapes):
        outside &= (owners == number) | ~_inside(points, shape, pose)
    return points[outside]


def _inside(points: Array, shape: Shape, pose: Pose) -> npt.NDArray[np.bool_]:
    """Tell which points are in a shape or touch it; ``pose`` is its link's."""
    planes, _ = _planes(shape)
    local = (pose @ shape.pose).inverse().apply(points)
    return np.asarray((local @ planes[:, :3].T + planes[:, 3] < TOUCHING_M).all(axis=1))


def _samples(model: ObjectModel, *, seen: bool) -> tuple[Array, npt.NDArray[np.int64]]:
    """Sample points on all visuals or collision shapes in the base frame, shape (N, 3) [m], and their shape indices."""
    poses = object_link_poses(model, {})
    meshes = []
    for link in model.links:
        for visual in link.visual if seen else map(_shown, link.collision):
            meshes.append([(part.mesh, poses[link.name]) for part in visual_parts(visual)])
    total = sum(_area(mesh) for group in meshes for mesh, _ in group)
    if total == 0.0:
        raise ConfigError(f"the {'visuals' if seen else 'collision shapes'} have no surface: all triangles are lines")
    rng = np.random.default_rng(0)
    points, numbers = [], []
    for number, group in enumerate(meshes):
        for mesh, pose in group:
            if _area(mesh) == 0.0:
                continue
            count = max(30, round(SAMPLES * (1 if seen else 2) * _area(mesh) / total))
            points.append(pose.apply(_on_surface(mesh, count, rng)))
            numbers.append(np.full(count, number))
    return np.concatenate(points), np.concatenate(numbers)


def _shown(shape: Shape) -> Visual:
    return Visual(kind=shape.kind, size=shape.size, mesh=shape.mesh, scale=(shape.scale,) * 3, pose=shape.pose)


def _area(mesh: TriangleMesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(float), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _on_surface(mesh: TriangleMesh, count: int, rng: np.random.Generator) -> Array:
    corners = mesh.vertices[mesh.faces].astype(float)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(corners), count, p=doubled / doubled.sum())]
    return np.asarray(np.einsum("ij,ijk->ik", rng.dirichlet([1.0, 1.0, 1.0], count), chosen))


def _planes(shape: Shape) -> tuple[Array, float]:
    """Return the half-spaces of a convex shape in its own frame, shape (M, 4), and its volume [m^3]."""
    from scipy.spatial import ConvexHull, QhullError

    bare = Visual(kind=shape.kind, size=shape.size, mesh=shape.mesh, scale=(shape.scale,) * 3)
    points = np.concatenate([part.mesh.vertices for part in visual_parts(bare)]).astype(float)
    try:
        hull = ConvexHull(points)
    except QhullError:
        raise ConfigError(f"a collision shape of kind {shape.kind} has no volume") from None
    return np.asarray(hull.equations), float(hull.volume)
