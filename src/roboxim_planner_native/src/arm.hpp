// A tree of one-degree-of-freedom joints with a tool centre point (TCP), and its inverse kinematics.
#pragma once

#include <cstdint>
#include <vector>

#include "geometry.hpp"

namespace roboxim {

struct Joint {
  int parent = -1;      // index of the parent joint, -1: the base
  Transform placement;  // in the parent joint's frame
  Vec3 axis;            // unit, in the joint's frame
  bool prismatic = false;
  double lower = 0.0, upper = 0.0;
};

struct Arm {
  std::vector<Joint> joints;  // parents before children
  int tcp_joint = -1;
  Transform tcp;                 // in tcp_joint's frame
  std::vector<char> moves_tcp;   // per joint

  int dof() const { return static_cast<int>(joints.size()); }

  // Poses of the joints' frames in the base.
  void forward(const double* q, Transform* frames) const {
    for (int j = 0; j < dof(); ++j) {
      const Joint& joint = joints[j];
      const Transform placed = joint.parent < 0 ? joint.placement : frames[joint.parent] * joint.placement;
      if (joint.prismatic) {
        frames[j] = {placed.r, placed.t + q[j] * (placed.r * joint.axis)};
      } else {
        frames[j] = {placed.r * rotation(joint.axis, q[j]), placed.t};
      }
    }
  }

  Transform tcp_pose(const Transform* frames) const { return tcp_joint < 0 ? tcp : frames[tcp_joint] * tcp; }

  // Jacobian of the TCP in the base's axes, 6 rows (linear first) of dof columns.
  void jacobian(const Transform* frames, const Vec3& tip, double* rows) const {
    const int n = dof();
    for (int j = 0; j < n; ++j) {
      Vec3 linear, angular;
      if (moves_tcp[j]) {
        const Vec3 axis = frames[j].r * joints[j].axis;
        linear = joints[j].prismatic ? axis : cross(axis, tip - frames[j].t);
        angular = joints[j].prismatic ? Vec3{} : axis;
      }
      const double column[6] = {linear.x, linear.y, linear.z, angular.x, angular.y, angular.z};
      for (int i = 0; i < 6; ++i) rows[i * n + j] = column[i];
    }
  }
};

struct IkSettings {
  double position_tolerance = 1e-6;
  double rotation_tolerance = 1e-5;
  int iterations = 60;
  int starts = 40;
  int enough = 1;  // solutions after which to stop
};

struct IkOutcome {
  std::vector<double> solutions;  // rows of dof
  double position_error = 1e300;  // of the best state that is not a solution
  double rotation_error = 1e300;
};

// Damped least squares from many starts: the reference, some near it, the rest uniform within the limits.
IkOutcome inverse_kinematics(const Arm& arm, const Transform& target, const double* reference, std::uint64_t seed,
                             const IkSettings& settings);

// Settings for following a moving target from one tick to the next.
struct FollowSettings {
  double position_tolerance = 1e-7;
  double rotation_tolerance = 1e-6;
  int iterations = 30;
};

struct FollowOutcome {
  std::vector<double> joints;  // the best found
  double position_error = 1e300;
  double rotation_error = 1e300;
};

// Damped least squares from one start, within bounds of each joint. `pull` (dof entries, or null) is added to the first
// step, without the part that would move the TCP.
FollowOutcome follow(const Arm& arm, const Transform& target, const double* start, const double* lower,
                     const double* upper, const double* pull, const FollowSettings& settings);

// SplitMix64 (Steele, Lea, Flood 2014): small, and the same on every platform.
struct Random {
  std::uint64_t state;

  std::uint64_t next() {
    std::uint64_t z = (state += 0x9e3779b97f4a7c15ULL);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return z ^ (z >> 31);
  }
  double uniform() { return static_cast<double>(next() >> 11) * 0x1.0p-53; }
};

}  // namespace roboxim
