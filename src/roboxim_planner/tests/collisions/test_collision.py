from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.errors import InvalidRequestError
from roboxim_core.models.description import Shape
from roboxim_core.poses import Pose
from roboxim_planner.collisions.checker import EXACT_RESOLUTION_M, CollisionWorld
from roboxim_planner.collisions.sweep import Sweep
from roboxim_planner.pipeline import Planner
from roboxim_planner.scene import AllowedContact, Attached, Body, PlanningScene, PointHull, TriangleMesh, box

Down = Callable[..., Pose]
EYE = tuple((float(i), float(j), float(k)) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1))


def test_contact_names_the_pair_and_its_depth(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    joints = planner.ik.nearest(tcp_down(0.5, 0.0, -0.01), planner.named_state("home"))
    contact = CollisionWorld(planner.robot, table).contacts(joints)[0]
    assert "table" in (contact.body_a, contact.body_b)
    assert "finger" in contact.body_a + contact.body_b
    assert 0.005 < contact.depth < 0.03
    assert contact.position[2] == pytest.approx(0.0, abs=0.03)


def test_self_collision_is_found(planner: Planner) -> None:
    folded = np.array([0.0, 1.7, 0.0, -3.0, 0.0, 0.0, 0.0])
    assert CollisionWorld(planner.robot, PlanningScene()).contacts(folded)


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder", "capsule", "points"])
def test_padding_and_pose_hold_for_every_shape(tcp_down: Down, planner: Planner, kind: str) -> None:
    """A body 20 mm below the fingers touches with 25 mm of padding, and not with 15 mm, wherever the robot stands."""
    base = Pose(position=(1.0, 2.0, 0.5), quat_xyzw=(0.0, 0.0, np.sin(0.4), np.cos(0.4)))
    joints = planner.ik.nearest(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))
    size = {"box": (0.1, 0.1, 0.1), "sphere": (0.05,), "cylinder": (0.05, 0.1), "capsule": (0.02, 0.06)}.get(kind)
    points = tuple((0.05 * x, 0.05 * y, 0.05 * z) for x, y, z in EYE)
    shape = PointHull(points=points) if size is None else Shape(kind=kind, size=size)
    tip = min(o[2] for o in _finger_points(planner, joints))
    body = Body(name="thing", shapes=(shape,), pose=base @ Pose(position=(0.5, 0.04, tip - 0.07)))
    scene = PlanningScene(robot_pose=base, bodies=(body,))
    assert CollisionWorld(planner.robot, scene, padding=0.015).is_free(joints)
    assert not CollisionWorld(planner.robot, scene, padding=0.025).is_free(joints)


def _finger_points(planner: Planner, joints: np.ndarray) -> list[np.ndarray]:
    import pinocchio as pin

    robot = planner.robot
    data, geometry_data = robot.model.createData(), robot.geometry.createData()
    pin.updateGeometryPlacements(robot.model, data, robot.geometry, geometry_data, robot.full(joints))
    corners = []
    for item, placement in zip(robot.geometry.geometryObjects, geometry_data.oMg, strict=True):
        if "finger" in item.name:
            corners += [placement.act(np.array(eye) * item.geometry.halfSide) for eye in EYE]
    return corners


@pytest.mark.parametrize(
    ("size", "thickness", "words"),
    [(1.0, 0.0, "no convex hull"), (0.1, 1e-15, "thick"), (0.1, 5e-7, "thick"), (50.0, 2e-6, "thick")],
)
def test_flat_hull_is_refused_instead_of_crashing(planner: Planner, size: float, thickness: float, words: str) -> None:
    turn = Rotation.identity() if thickness == 0.0 else Rotation.from_rotvec([0.3, 0.5, 0.7])
    corners = turn.apply(0.5 * np.array(EYE) * [size, size, thickness])
    flat = Body(name="flat", shapes=(PointHull(points=tuple(map(tuple, corners.tolist()))),))
    for scene in (PlanningScene(bodies=(flat,)), PlanningScene(attached=(Attached(body=flat),))):
        with pytest.raises(InvalidRequestError, match=f"body 'flat': .*{words}"):
            CollisionWorld(planner.robot, scene)
    empty = Body(name="empty", shapes=(PointHull(points=()),))
    with pytest.raises(InvalidRequestError, match="0 points span no convex hull"):
        CollisionWorld(planner.robot, PlanningScene(bodies=(empty,)))


def test_attached_body_spares_only_the_gripper(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    joints = planner.ik.nearest(tcp_down(0.5, 0.0, 0.1), planner.named_state("home"))
    stick = Attached(body=box("stick", (0.02, 0.02, 0.16), Pose(position=(0.0, 0.0, 0.05))))
    contacts = CollisionWorld(planner.robot, table.holding(stick)).contacts(joints)
    assert [{c.body_a, c.body_b} for c in contacts] == [{"table", "stick"}]
    long = Attached(body=box("long", (0.02, 0.02, 0.9)))
    assert not CollisionWorld(planner.robot, PlanningScene().holding(long)).is_free(joints)


def test_allowed_contacts_by_link_group_and_wildcard(tcp_down: Down, planner: Planner, table: PlanningScene) -> None:
    joints = planner.ik.nearest(tcp_down(0.5, 0.0, -0.01), planner.named_state("home"))
    for pair in (("table", "gripper"), ("robot", "table"), ("table", "")):
        allowed = AllowedContact(body_a=pair[0], body_b=pair[1])
        assert CollisionWorld(planner.robot, table.with_contacts([allowed])).is_free(joints)
    one = AllowedContact(body_a="panda_leftfinger", body_b="table")
    assert not CollisionWorld(planner.robot, table.with_contacts([one])).is_free(joints)
    with pytest.raises(InvalidRequestError, match="did you mean 'table'"):
        CollisionWorld(planner.robot, table.with_contacts([AllowedContact(body_a="tabel")]))


def test_gripper_opening_moves_the_fingers(tcp_down: Down, planner: Planner) -> None:
    joints = planner.ik.nearest(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))
    cube = box("cube", (0.03, 0.03, 0.03), Pose(position=(0.5, 0.0, 0.3)))
    assert CollisionWorld(planner.robot, PlanningScene(bodies=(cube,))).is_free(joints)
    assert not CollisionWorld(planner.robot, PlanningScene(bodies=(cube,), gripper_opening=0.0)).is_free(joints)


def test_edge_through_a_thin_wall_is_not_free(planner: Planner, walled: PlanningScene, left: np.ndarray) -> None:
    right = left * [-1, 1, -1, 1, -1, 1, -1]
    world = CollisionWorld(planner.robot, walled)
    assert world.is_free(left)
    assert world.is_free(right)
    assert not world.edge_is_free(left, right, 0.02)
    assert world.edge_is_free(left, left + 0.02, 0.02)


@pytest.mark.parametrize("aside", [0.0, 0.03, 0.06, 0.2])
def test_sweep_finds_what_lies_between_sparse_samples(planner: Planner, left: np.ndarray, aside: float) -> None:
    """A 2 mm needle in or beside the way of the hand: two samples far apart give coal's answer on dense ones."""
    right = left * [-1, 1, -1, 1, -1, 1, -1]
    x, y, z = planner.robot.fk(0.5 * (left + right), "panda_hand").position
    needle = box("needle", (0.002, 0.002, 0.002), Pose(position=(x + aside, y, z)))
    sweep = Sweep(planner.robot, PlanningScene(bodies=(needle,)))
    places = np.linspace(0.0, 1.0, 3000)
    touching = [not sweep.exact.coal.is_free(left + place * (right - left)) for place in places]
    assert any(touching) == (aside < 0.1)
    hit = sweep.exact.first_hit(np.stack([left, right]))
    assert hit == pytest.approx(places[int(np.argmax(touching))] if any(touching) else -1.0, abs=1e-3)


def cluttered(seed: int) -> PlanningScene:
    """A scene with every kind of shape in random poses around the arm, and in half of them a stick in the hand."""
    rng = np.random.default_rng(seed)

    def pose() -> Pose:
        return Pose.from_arrays(rng.uniform([0.2, -0.6, 0.0], [0.8, 0.6, 0.8]), Rotation.random(random_state=rng))

    shapes = [Shape(kind="box", size=(0.2, 0.1, 0.05)), Shape(kind="sphere", size=(0.05,)),
              Shape(kind="cylinder", size=(0.04, 0.2)), Shape(kind="capsule", size=(0.03, 0.15)),
              PointHull(points=tuple(map(tuple, rng.uniform(-0.08, 0.08, (12, 3)).tolist()))), ring()]  # fmt: skip
    bodies = [Body(name=f"body{i}", shapes=(shape,), pose=pose()) for i, shape in enumerate(shapes)]
    stick = Attached(body=box("stick", (0.02, 0.02, 0.12), Pose(position=(0.0, 0.0, 0.03))))
    return PlanningScene(bodies=tuple(bodies), attached=(stick,) if seed % 2 else (), gripper_opening=0.5)


def ring() -> TriangleMesh:
    """A ring of triangles with a hole that an arm fits through: far from convex."""
    angles = np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(20)])
    vertices = np.concatenate([0.25 * around, 0.3 * around]).tolist()
    quads = [(i, (i + 1) % 20, 20 + i, 20 + (i + 1) % 20) for i in range(20)]
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (b, d, c))]
    return TriangleMesh(vertices=tuple(map(tuple, vertices)), triangles=tuple(triangles))


@pytest.mark.parametrize("seed", range(6))
def test_native_kernel_agrees_with_coal(planner: Planner, seed: int) -> None:
    world = CollisionWorld(planner.robot, cluttered(seed))
    rng = np.random.default_rng(seed)
    states = rng.uniform(planner.robot.lower, planner.robot.upper, (300, planner.robot.dof))
    free = [world.is_free(q) for q in states]
    assert 30 < sum(free) < 290
    assert free == [world.coal.is_free(q) for q in states]
    for q in states[:20]:
        apart = world.clearance(q)
        assert (apart == 0.0) == bool(world.contacts(q))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.thorough
def test_free_edges_are_free_everywhere_and_others_are_not(planner: Planner, seed: int) -> None:
    """Edges against coal at 200 places each; where the kernel says that an edge collides, coal agrees at that place."""
    world = CollisionWorld(planner.robot, cluttered(seed))
    rng = np.random.default_rng(seed)
    for _ in range(20):
        a = rng.uniform(planner.robot.lower, planner.robot.upper)
        b = np.clip(a + rng.uniform(-0.6, 0.6, len(a)), planner.robot.lower, planner.robot.upper)
        hit = world.first_hit(np.stack([a, b]))
        assert world.edge_is_free(a, b, EXACT_RESOLUTION_M) == (hit < 0.0)
        if hit < 0.0:
            assert all(world.coal.is_free(a + s * (b - a)) for s in np.linspace(0.0, 1.0, 200))
        else:
            assert not world.coal.is_free(a + hit * (b - a))


@pytest.mark.parametrize("seed", range(4))
def test_what_is_proven_touches_nothing(planner: Planner, seed: int) -> None:
    """Straight lines, lines in many uneven steps, bent ones: what the kernel proves keeps apart wherever one looks."""
    world = CollisionWorld(planner.robot, cluttered(seed))
    rng = np.random.default_rng(seed)
    eased = np.linspace(0.0, 1.0, 200)[:, None] ** 2 * (3.0 - 2.0 * np.linspace(0.0, 1.0, 200)[:, None])
    proven = 0
    for k in range(30):
        a = rng.uniform(planner.robot.lower, planner.robot.upper)
        b, c = (np.clip(a + rng.normal(size=len(a)) * 0.3, planner.robot.lower, planner.robot.upper) for _ in range(2))
        path = (np.stack([a, b]), a + eased * (b - a), np.stack([a, b, c]))[k % 3]
        if world.is_proven(path):
            proven += 1
            places = rng.uniform(0.0, len(path) - 1.0, 200)
            states = [path[int(p)] + (p - int(p)) * (path[int(p) + 1] - path[int(p)]) for p in places]
            assert min(world.clearance(q, 0.01) for q in states) > 0.0
    assert proven > 3


def test_search_keeps_its_distance_but_where_the_ends_do_not(tcp_down: Down, planner: Planner) -> None:
    """A box 1 mm below the hand at the start is no hindrance to leave; one 3 mm below the middle of the way is."""
    start = planner.ik.nearest(tcp_down(0.5, 0.0, 0.3), planner.named_state("home"))
    end = start + [0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]

    def below(joints: np.ndarray, gap: float) -> CollisionWorld:
        x, y, z = planner.robot.fk(joints).position
        low, high = 0.0, 0.1
        while high - low > 1e-6:
            down = 0.5 * (low + high)
            block = box("block", (0.02, 0.02, 0.02), Pose(position=(x, y, z - down)))
            world = CollisionWorld(planner.robot, PlanningScene(bodies=(block,), gripper_opening=0.0))
            low, high = (down, high) if world.clearance(joints) < gap else (low, down)
        return world

    world = below(start, 0.001)
    assert not world.padded(0.005).is_free(start)
    assert world.eased(0.005, np.stack([start, end])).edge_is_free(start, end, 5e-4)
    world = below(0.5 * (start + end), 0.003)
    assert world.edge_is_free(start, end, 5e-4)
    assert not world.eased(0.005, np.stack([start, end])).edge_is_free(start, end, 5e-4)


def test_body_named_like_a_link_is_refused(planner: Planner) -> None:
    with pytest.raises(InvalidRequestError, match="name of a robot link"):
        CollisionWorld(planner.robot, PlanningScene(bodies=(box("panda_hand", (0.1, 0.1, 0.1)),)))
