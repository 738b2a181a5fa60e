"""The robot as a PyBullet body, with its motors.

The constants below were tuned together for grasps that hold at 240 Hz; each comes with its reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from roboxim_core.errors import SimError
from roboxim_core.models.description import RobotModel
from roboxim_core.specs import RobotSpec
from roboxim_sim.bullet import BulletClient, pybullet
from roboxim_sim.physics_urdf import physics_urdf

FINGER_GAIN = 0.05
"""Position gain of the fingers: soft enough not to bounce off a hard object."""
FINGER_FRICTION, FINGER_SPINNING = 1.0, 0.1
FINGER_STIFFNESS, FINGER_DAMPING = 3e4, 1e3
GEAR_ERP, GEAR_FORCE_N = 0.1, 50.0
"""The fingers are coupled by a gear constraint; without it a held object drifts by up to 2 cm."""
FOLLOWER_GAIN, FOLLOWER_TORQUE = 1.0, 200.0
"""Motors of the joints that follow another, set anew in each step: a gear constraint gives way under 20 N."""
CONTACT_TURN_RAD = 0.05
"""Rotation of the hand [rad] after which one finger's contact points are renewed; see `RobotBody.after_step`."""

_COSINE_OF_CONTACT_TURN = math.cos(CONTACT_TURN_RAD / 2)
_FILTER_OF_LINKS = (1, -1)
"""Group and mask that PyBullet gives the moving links of a URDF."""


class RobotBody:
    """The robot in PyBullet, with its motors."""

    def __init__(self, client: BulletClient, model: RobotModel, spec: RobotSpec, joints: Sequence[float]) -> None:
        """Load the robot at the given joint positions.

        Args:
            client: PyBullet client.
            model: The robot.
            spec: Base pose and gripper opening.
            joints: Arm joint positions [rad].

        Raises:
            SimError: When PyBullet cannot load the URDF.
        """
        self._client, self._model = client, model
        urdf = physics_urdf(model.urdf, model.gripper)
        try:
            self.id = client.loadURDF(
                str(urdf.file),
                spec.pose.position,
                spec.pose.quat_xyzw,
                useFixedBase=True,
                flags=pybullet.URDF_IGNORE_VISUAL_SHAPES | pybullet.URDF_USE_INERTIA_FROM_FILE,
            )
        except pybullet.error as error:
            raise SimError(f"PyBullet cannot load {model.urdf}: {error}") from None
        index, self.link_names = {}, {-1: ""}
        for number in range(client.getNumJoints(self.id)):
            info = client.getJointInfo(self.id, number)
            index[info[1].decode()] = number
            self.link_names[number] = info[12].decode()
        self.arm = [index[name] for name in model.joint_names]
        gripper = model.gripper
        self.fingers = [index[name] for name in gripper.joint_names]
        self._followers = [index[follower.name] for follower in gripper.followers]
        self._leads = [(gripper.joint_names.index(row.leader), row.ratio) for row in gripper.followers]
        self._follower_motors = {
            "forces": [FOLLOWER_TORQUE] * len(self._followers),
            "positionGains": [FOLLOWER_GAIN] * len(self._followers),
            "velocityGains": [1.0] * len(self._followers),
        }
        number_of = {link: number for number, link in self.link_names.items()}
        number_of |= {link: number_of[whole] for link, whole in urdf.part_of.items()}
        self._tips = [number_of[link] for link in gripper.links[1:3]]
        for number, position in zip(self.arm, joints, strict=True):
            client.resetJointState(self.id, number, position)
        driven = [gripper.driven(spec.gripper_opening)] * len(self.fingers)
        for number, position in zip(self.fingers, driven, strict=True):
            client.resetJointState(self.id, number, position)
            self._make_soft(number)
        for number, position in zip(self._followers, gripper.followed(driven), strict=True):
            client.resetJointState(self.id, number, position)
        for link in gripper.links[1:]:
            if number_of[link] not in self.fingers:
                self._make_soft(number_of[link])
        if not gripper.one_jaw:
            self._couple_fingers()
        self._turn_of_contacts = self._finger_rotation()
        self._next_finger = 0
        self._gains = [model.position_gain] * len(self.arm)
        self._damping = [1.0] * len(self.arm)

    def drive_arm(self, positions: Sequence[float], velocities: Sequence[float]) -> None:
        """Set the arm's target positions [rad] and velocities [rad/s] for the next physics step."""
        self._client.setJointMotorControlArray(
            self.id,
            self.arm,
            pybullet.POSITION_CONTROL,
            targetPositions=positions,
            targetVelocities=velocities,
            forces=self._model.motor_force,
            positionGains=self._gains,
            velocityGains=self._damping,
        )

    def drive_gripper(self, opening: float, force_n: float | None = None) -> None:
        """Set the fingers' target opening.

        Args:
            opening: 1 = open, 0 = closed.
            force_n: Maximum force of each finger [N]; none: the model's.
        """
        gripper = self._model.gripper
        limit = {"maxVelocity": gripper.speed_m_s / gripper.lever} if gripper.keeps_speed else {}
        for number in self.fingers:
            self._client.setJointMotorControl2(
                self.id,
                number,
                pybullet.POSITION_CONTROL,
                targetPosition=gripper.driven(opening),
                force=(gripper.force_n if force_n is None else force_n) * gripper.arm_m,
                positionGain=FINGER_GAIN,
                **limit,
            )

    def after_step(self) -> None:
        """Drive the followers, and renew contact points. Call after each physics step."""
        if self._followers:
            self._lead_followers()
        self._renew_contacts()

    def _renew_contacts(self) -> None:
        """Renew the contact points of one finger if the hand has rotated.

        A friction anchor keeps a contact point until it slips, and with it the point's initial normal in the world.
        When the hand rotates with a held object, these normals become wrong: after half a turn they hold the fingers
        closed. Re-inserting a finger's broad-phase proxy drops its contact points. The fingers alternate, so that
        the other finger's anchors carry the object meanwhile.
        """
        now = self._finger_rotation()
        cosine = abs(sum(a * b for a, b in zip(now, self._turn_of_contacts, strict=True)))  # cosine of half the angle
        if cosine >= _COSINE_OF_CONTACT_TURN:
            return
        self._client.setCollisionFilterGroupMask(self.id, self._tips[self._next_finger], *_FILTER_OF_LINKS)
        self._turn_of_contacts = now
        self._next_finger = 1 - self._next_finger

    def read_joints(self) -> tuple[list[float], list[float], list[float]]:
        """Return positions, velocities and last motor efforts of the joints: the arm's first, then the fingers'."""
        states = self._client.getJointStates(self.id, self.arm + self.fingers)
        return [s[0] for s in states], [s[1] for s in states], [s[3] for s in states]

    def _finger_rotation(self) -> tuple[float, ...]:
        """Return a finger tip's rotation in the world as a quaternion: the hand's, since tips are parallel or fixed."""
        rotation: tuple[float, ...] = self._client.getLinkState(self.id, self._tips[0])[1]
        return rotation

    def _lead_followers(self) -> None:
        """Drive the followers to where the driven joints are now."""
        states = self._client.getJointStates(self.id, self.fingers)
        self._client.setJointMotorControlArray(
            self.id,
            self._followers,
            pybullet.POSITION_CONTROL,
            targetPositions=[ratio * states[leader][0] for leader, ratio in self._leads],
            targetVelocities=[ratio * states[leader][1] for leader, ratio in self._leads],
            **self._follower_motors,
        )

    def _make_soft(self, number: int) -> None:
        """Give a link of a finger the contact parameters that hold an object."""
        self._client.changeDynamics(
            self.id,
            number,
            lateralFriction=FINGER_FRICTION,
            spinningFriction=FINGER_SPINNING,
            frictionAnchor=1,
            contactStiffness=FINGER_STIFFNESS,
            contactDamping=FINGER_DAMPING,
        )

    def _couple_fingers(self) -> None:
        first, second = self.fingers
        gear = self._client.createConstraint(
            self.id,
            first,
            self.id,
            second,
            pybullet.JOINT_GEAR,
            jointAxis=[1, 0, 0],
            parentFramePosition=[0, 0, 0],
            childFramePosition=[0, 0, 0],
        )
        self._client.changeConstraint(gear, gearRatio=-1, erp=GEAR_ERP, maxForce=GEAR_FORCE_N)
