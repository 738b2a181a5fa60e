// Paths that keep the tool upright. Two trees of upright states grow towards each other step by step; each step is
// projected back to the constraint (CBiRRT; Berenson, Srinivasa, Ferguson, Kuffner, ICRA 2009). OMPL's Python bindings
// do not support custom samplers, and rejection sampling finds no path at useful tolerances.
#include "world.hpp"

namespace roboxim {
namespace {

constexpr int kWatchEvery = 16;
constexpr int kProjections = 30;
constexpr double kInside = 0.7;  // fraction of the tolerance to which a state that is tilted too far is projected

struct Tree {
  int n;
  std::vector<double> states;
  std::vector<int> parents;

  int size() const { return static_cast<int>(parents.size()); }
  const double* at(int i) const { return &states[static_cast<std::size_t>(i) * n]; }
  int add(const double* q, int parent) {
    states.insert(states.end(), q, q + n);
    parents.push_back(parent);
    return size() - 1;
  }
  int nearest(const double* q) const {
    int best = 0;
    double least = 1e300;
    for (int i = 0; i < size(); ++i) {
      double sum = 0.0;
      for (int j = 0; j < n; ++j) sum += (at(i)[j] - q[j]) * (at(i)[j] - q[j]);
      if (sum < least) least = sum, best = i;
    }
    return best;
  }
};

double apart(const double* a, const double* b, int n) {
  double sum = 0.0;
  for (int j = 0; j < n; ++j) sum += (a[j] - b[j]) * (a[j] - b[j]);
  return std::sqrt(sum);
}

}  // namespace

double World::tilt_now() const {
  const Vec3 axis = arm_->tcp_pose(frames_.data()).r * upright.axis;
  return std::atan2(norm(cross(axis, upright.direction)), dot(axis, upright.direction));
}

double World::tilt(const double* q) {
  arm_->forward(q, frames_.data());
  return tilt_now();
}

// Projects a state to the constraint by damped least squares within the joint limits.
bool World::straighten(double* q) {
  const int n = arm_->dof();
  std::vector<double> jacobian(6 * static_cast<std::size_t>(n));
  for (int turn = 0; turn < kProjections; ++turn) {
    arm_->forward(q, frames_.data());
    const double tilted = tilt_now();
    if (tilted <= upright.tolerance) return true;
    const Transform tcp = arm_->tcp_pose(frames_.data());
    const Vec3 axis = tcp.r * upright.axis;
    Vec3 about = cross(axis, upright.direction);
    const double length = norm(about);
    about = length > 1e-9 ? (1.0 / length) * about : Vec3{1.0, 0.0, 0.0};
    arm_->jacobian(frames_.data(), tcp.t, jacobian.data());
    // one equation: the rotation about `about` must equal the excess
    double rows = 1e-4, along[64];
    for (int j = 0; j < n; ++j) {
      along[j] = about.x * jacobian[3 * n + j] + about.y * jacobian[4 * n + j] + about.z * jacobian[5 * n + j];
      rows += along[j] * along[j];
    }
    const double wanted = std::min(tilted - kInside * upright.tolerance, 0.6);
    for (int j = 0; j < n; ++j) {
      q[j] = std::clamp(q[j] + along[j] * wanted / rows, arm_->joints[j].lower, arm_->joints[j].upper);
    }
  }
  return false;
}

std::vector<double> World::connect_upright(const double* start, const double* goals, int goal_count,
                                           std::uint64_t seed, int iterations, double step, const Margins& margins,
                                           const std::function<void(int)>& watch) {
  const int n = arm_->dof();
  Random random{seed * 0x9e3779b97f4a7c15ULL + 0x3c6ef372fe94f82bULL};
  Tree trees[2] = {{n, {}, {}}, {n, {}, {}}};
  trees[0].add(start, -1);
  for (int g = 0; g < goal_count; ++g) trees[1].add(goals + g * n, -1);
  std::vector<double> edge(2 * static_cast<std::size_t>(n)), next(n), sample(n);
  // Grows a tree from a state towards a target as far as possible; returns the last state added, or `from`.
  const auto grow = [&](Tree& tree, int from, const double* target) {
    double left = apart(tree.at(from), target, n);
    for (int steps = 0; steps < 200 && left > 1e-9; ++steps) {
      const double part = std::min(1.0, step / left);
      for (int j = 0; j < n; ++j) next[j] = tree.at(from)[j] + part * (target[j] - tree.at(from)[j]);
      if (!straighten(next.data())) break;
      const double rest = apart(next.data(), target, n);
      if (rest > left - 0.05 * step && part < 1.0) break;  // the constraint leads away
      if (apart(next.data(), tree.at(from), n) > 2.0 * step) break;
      std::copy(tree.at(from), tree.at(from) + n, edge.begin());
      std::copy(next.begin(), next.end(), edge.begin() + n);
      if (!path_is_free(edge.data(), 2, margins)) break;
      from = tree.add(next.data(), from);
      left = rest;
    }
    return from;
  };
  for (int turn = 0; turn < iterations; ++turn) {
    if (turn % kWatchEvery == 0) watch(turn);
    Tree &near = trees[turn % 2], &far = trees[1 - turn % 2];
    if (turn < 2 * goal_count) {  // first straight to the goals, and from them to the start
      const double* q = turn % 2 == 0 ? trees[1].at(turn / 2) : start;
      std::copy(q, q + n, sample.begin());
    } else {
      for (int j = 0; j < n; ++j) {
        const Joint& joint = arm_->joints[j];
        sample[j] = joint.lower + random.uniform() * (joint.upper - joint.lower);
      }
      if (!straighten(sample.data())) continue;
    }
    const int reached = grow(near, near.nearest(sample.data()), sample.data());
    const std::vector<double> target(near.at(reached), near.at(reached) + n);
    const int met = grow(far, far.nearest(target.data()), target.data());
    if (apart(far.at(met), target.data(), n) > 1e-6) continue;
    std::vector<int> ahead, back;
    const int in_start = turn % 2 == 0 ? reached : met, in_goal = turn % 2 == 0 ? met : reached;
    for (int i = in_start; i >= 0; i = trees[0].parents[i]) ahead.push_back(i);
    for (int i = in_goal; i >= 0; i = trees[1].parents[i]) back.push_back(i);
    std::vector<double> path;
    for (auto i = ahead.rbegin(); i != ahead.rend(); ++i) path.insert(path.end(), trees[0].at(*i), trees[0].at(*i) + n);
    for (std::size_t i = 1; i < back.size(); ++i) path.insert(path.end(), trees[1].at(back[i]), trees[1].at(back[i]) + n);
    return path;
  }
  return {};
}

}  // namespace roboxim
