"""Scalar quaternions against scipy's rotations."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from roboxim_core.poses import look_at
from roboxim_core.rotation.quaternions import (
    axes_of_quat,
    euler_from_quat,
    quat_about,
    quat_from_axes,
    quat_from_euler,
    quat_inverse,
    quat_product,
)

ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)


def angle_between(quat, rotation):
    return (Rotation.from_quat(quat) * rotation.inv()).magnitude()


@given(first=ANGLES, second=ANGLES)
def test_products_and_angles_are_scipys(first, second):
    a, b = (Rotation.from_euler("xyz", angles) for angles in (first, second))
    assert angle_between(quat_from_euler(*first), a) < 1e-7
    product = quat_product(quat_from_euler(*first), quat_inverse(quat_from_euler(*second)))
    assert angle_between(product, a * b.inv()) < 1e-7
    assert product[3] >= 0
    assert math.hypot(*product) == pytest.approx(1.0, abs=1e-12)


@given(angles=ANGLES)
def test_euler_angles_lead_back_to_the_rotation(angles):
    quat = quat_from_euler(*angles)
    assert angle_between(quat, Rotation.from_euler("xyz", euler_from_quat(quat))) < 1e-5


@pytest.mark.parametrize("pitch", [math.pi / 2, -math.pi / 2])
def test_a_pitch_of_a_right_angle_has_angles_too(pitch):
    quat = quat_from_euler(0.3, pitch, 0.5)
    assert angle_between(quat, Rotation.from_euler("xyz", euler_from_quat(quat))) < 1e-6


def bits(quat):
    return [float(value).hex() for value in quat]


@given(angles=ANGLES, scale=st.floats(0.999, 1.001))
def test_the_axes_of_a_quaternion_have_the_bits_of_scipys(angles, scale):
    quat = tuple(scale * value for value in quat_from_euler(*angles))
    assert bits(axes_of_quat(quat)) == bits(Rotation.from_quat(quat).as_matrix().T[:2].ravel())


@given(axis=st.sampled_from("xyz"), angle=st.floats(-7.0, 7.0))
@example(axis="x", angle=0.0)
@example(axis="y", angle=math.pi)
@example(axis="z", angle=-math.pi)
def test_a_rotation_about_an_axis_has_the_bits_of_scipys(axis, angle):
    assert bits(quat_about(axis, angle)) == bits(Rotation.from_euler(axis, angle).as_quat(canonical=True))


@given(angles=ANGLES)
@example(angles=(0.0, 0.0, 0.0))
@example(angles=(math.pi, 0.0, 0.0))
@example(angles=(0.0, math.pi, 0.0))
@example(angles=(0.0, 0.0, math.pi))
@example(angles=(math.pi / 2, 0.0, math.pi / 2))
def test_axes_give_the_bits_of_scipys(angles):
    matrix = Rotation.from_euler("xyz", angles).as_matrix()
    assert bits(quat_from_axes(*matrix.T)) == bits(Rotation.from_matrix(matrix).as_quat(canonical=True))


def test_a_camera_looks_at_its_target():
    pose = look_at((1.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    assert pose.apply((0.0, 0.0, math.sqrt(2))) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)
    assert pose.rotation.apply((0.0, -1.0, 0.0))[2] == pytest.approx(math.sqrt(0.5))
