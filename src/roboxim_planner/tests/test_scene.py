import pytest

from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, InvalidRequestError, PlannerError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import EntitySpec, RobotSpec, SceneSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_planner.scene import PlanningScene, box
from roboxim_planner.tracker import SceneTracker

HOME = (0.0, -0.2, 0.0, -2.2, 0.0, 2.0, 0.785)


def spec(scale: float = 1.0) -> SceneSpec:
    return SceneSpec(robot=RobotSpec(), entities=(EntitySpec(name="target", model="cube", modifiers={"scale": scale}),))


def state(episode: str, seq: int, x: float = 0.5) -> StateRecord:
    robot = RobotState(
        joint_names=tuple(f"panda_joint{i}" for i in range(1, 8)),
        joint_positions=HOME,
        joint_velocities=(0.0,) * 7,
        joint_commands=HOME,
        pose_tcp_measured=Pose(position=(0.5, 0.0, 0.36), quat_xyzw=(1.0, 0.0, 0.0, 0.0)),
        pose_tcp_commanded=IDENTITY,
        gripper_opening=1.02,
        gripper_command=1.0,
    )
    cube = EntityState(name="target", pose=Pose(position=(x, 0.1, 0.0225)))
    return StateRecord(episode_id=episode, seq=seq, stamp_ns=seq * 10**8, robot=robot, entities=(cube,))


def test_scene_follows_the_state() -> None:
    scene = PlanningScene.from_state(spec(1.2), state("e", 3, x=0.6), ModelLibrary())
    cube = next(body for body in scene.bodies if body.name == "target")
    assert scene.names == ("table", "target")
    assert cube.pose.position == (0.6, 0.1, 0.0225)
    assert cube.shapes[0].size == pytest.approx((0.054,) * 3)
    assert scene.gripper_opening == 1.0
    assert scene.joint_command == HOME


def test_attach_keeps_the_body_where_it_is() -> None:
    scene = PlanningScene.from_state(spec(), state("e", 0), ModelLibrary())
    held = scene.attach("target", scene.pose_tcp)
    assert held.names == ("table", "target")
    again = scene.pose_tcp @ held.attached[0].body.pose
    assert again.position == pytest.approx(scene.bodies[1].pose.position)
    with pytest.raises(InvalidRequestError, match="did you mean 'target'"):
        scene.attach("targt", scene.pose_tcp)


@pytest.mark.parametrize("size", [(0.1, 0.1), (0.1, 0.1, float("nan")), (0.1, 0.1, -1.0)])
def test_bad_sizes_are_refused(size: tuple[float, ...]) -> None:
    with pytest.raises(InvalidRequestError, match="body 'b'"):
        box("b", size)


def arrive(tracker: SceneTracker, scene: SceneSpec, record: StateRecord, sent_ns: int) -> None:
    tracker.state_arrived(record.episode_id, record.seq, digest(scene), lambda: record, sent_ns)


def test_tracker_answers_for_exactly_the_revision() -> None:
    tracker = SceneTracker(ModelLibrary())
    with pytest.raises(PlannerError, match="no scene yet") as caught:
        tracker.revision("e", 0)
    assert caught.value.code == ErrorCode.STALE_SCENE
    tracker.scene_arrived(spec(), 10)
    arrive(tracker, spec(), state("e", 0), 11)
    assert tracker.revision("e", 0) is tracker.revision("e", 0)
    arrive(tracker, spec(), state("e", 1, x=0.7), 12)
    with pytest.raises(PlannerError, match="has episode 'e', tick 1"):
        tracker.revision("e", 0, wait_s=30.0)
    assert tracker.revision("e", 1).bodies[1].pose.position[0] == 0.7


def test_tracker_never_pairs_a_state_with_another_scene() -> None:
    tracker = SceneTracker(ModelLibrary())
    tracker.scene_arrived(spec(1.0), 10)
    arrive(tracker, spec(1.0), state("e1", 0), 11)
    arrive(tracker, spec(1.2), state("e2", 0), 21)
    with pytest.raises(PlannerError, match="tick 0, whose scene has not arrived"):
        tracker.revision("e2", 0)
    tracker.scene_arrived(spec(1.2), 20)
    assert tracker.revision("e2", 0).bodies[1].shapes[0].size == pytest.approx((0.054,) * 3)


def test_interference_and_free_motion_need_no_new_scene() -> None:
    tracker = SceneTracker(ModelLibrary())
    tracker.scene_arrived(spec(), 10)
    for sent, record in enumerate((state("e", 0), state("e", 0, x=0.6), state("", 1, x=0.7)), start=11):
        arrive(tracker, spec(), record, sent)
        assert tracker.revision(record.episode_id, record.seq).bodies[1].pose == record.entities[0].pose
