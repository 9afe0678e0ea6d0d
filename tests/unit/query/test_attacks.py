"""What an independent review found wrong and silent, one test each."""

from __future__ import annotations

import math

import numpy as np
from support_between import lookup_between
from support_moving import BASE, ODOM, SCAN, T0, UTM, S, rover, truth, view

from modelserver.estimation.sensor_rig import SensorRig
from modelserver.geometry.builder import ModelBuilder
from modelserver.geometry.joint import Joint, JointType
from modelserver.joints import JointHistory
from modelserver.messages import Invalid, JointSample, JointsSample, Quality, SensorHeader, TimeQuery
from modelserver.query.batch import lookup_batch
from modelserver.query.path import compute_motion
from modelserver.query.view import complete
from modelserver.transforms.pose import Pose


def test_given_two_worlds_through_a_frame_of_the_vehicle_then_single_and_many_agree():
    platform = view(2.0)
    at, then = T0 + S, T0 + S + S // 2
    one = lookup_between(platform, UTM, at, ODOM, then, BASE)
    (row,) = complete(lookup_batch(platform, UTM, ODOM, np.array([at]), then, BASE)).vectors
    assert one.transformation.pose.is_close(Pose(row[:3], row[3:]), 1e-9, 1e-9)
    X_OB = platform.transformation(BASE, ODOM, TimeQuery(then)).transformation.pose
    X_UB = platform.transformation(BASE, UTM, TimeQuery(at)).transformation.pose
    assert one.transformation.pose.is_close(X_OB @ X_UB.inverse(), 1e-9, 1e-9)


def test_given_axes_behind_a_joint_never_received_then_a_motion_along_them_is_not_valid():
    platform = view(2.0)
    joints = JointHistory(platform.model.joints.values(), 60.0)
    platform = platform._replace(joints=joints)
    along = compute_motion(platform, BASE, UTM, SCAN, TimeQuery(T0 + S)).pose
    assert Invalid.JOINT_UNKNOWN in Invalid(along.transformation.invalid_reasons)
    assert Quality.JOINT_DEFAULT in along.quality
    assert compute_motion(platform, BASE, UTM, BASE, TimeQuery(T0 + S)).pose.transformation.is_valid


def test_given_a_joint_without_sigma_then_the_world_behind_it_has_no_covariance():
    builder = ModelBuilder()
    builder.add_body("Rover").add_frame("Base")
    builder.add_body("Laser").add_frame("Root").add_frame("Scan", Pose((5.0, 0.0, 0.0)))
    builder.add_constraint("Pan", BASE, "Laser:Root", joint=Joint(JointType.REVOLUTE))
    model = builder.build()
    joints = JointHistory(model.joints.values(), 60.0)
    for n in range(11):
        sample = JointsSample(SensorHeader(T0 + n * S // 10, "pan"), (JointSample("Pan", 0.1 * n),))
        joints, _ = joints.update(sample, sample.header.utime)
    platform = view(1.0)._replace(model=model, joints=joints)
    at = T0 + S // 2
    assert platform.transformation(SCAN, UTM, TimeQuery(at)).transformation.covariance is None
    assert platform.transformation(BASE, UTM, TimeQuery(at)).transformation.covariance is not None
    covariances = complete(lookup_batch(platform, SCAN, UTM, np.array([at]))).covariances
    assert covariances is None or np.isnan(covariances).all()


def test_given_a_frame_behind_a_joint_then_localization_does_not_use_it():
    rig = SensorRig(rover(), BASE)
    assert rig.find_problem(SCAN) == "on_joint"
    assert rig.find_problem("Rover:Mast") == ""
    assert rig.find_problem("Rover:Mats") == "frame"


def test_given_two_times_through_odom_then_the_way_between_is_the_true_one():
    platform = view(2.0)
    found = lookup_between(platform, SCAN, T0 + S, SCAN, T0 + S // 2).transformation.pose
    assert found.is_close(truth(SCAN, SCAN, 1.0, 0.5), 1e-3, math.radians(0.02))
